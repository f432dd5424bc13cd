"""Every light on hostile points: over 12 decades, without distance, normal, albedo or mask, beside NaN.

Bounds are in epsilons, because nothing but rounding may part a precision from float64: a radiance is a chain
of about ten products and sums. Beside a lamp the difference of two places has fewer digits than either; there
values are only asked to be finite.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from relight.lighting import (
    CapturedLight,
    DirectionalLight,
    EnvironmentLight,
    FlashLight,
    Light,
    PointLight,
    RoomLight,
    SphericalHarmonicsLight,
    SumLight,
    shade,
)
from relight.panorama import panorama_to_sh
from relight.reflectance import Reflectance
from relight.stress.case import Case, Measured, Stage, epsilons, gradients_of
from relight.stress.subject import looking_at_origin, sphere_points

LIGHTS = Stage("lights")

_DECADES = (-6, 0, 6)
_LAMP = (0.2, 0.3, 0.4)
_CAMERA = looking_at_origin([0.05, 0.1, 0.5], 64, flash=1)
_COLOUR = (0.9, 1.0, 1.1)
_ROUNDINGS = epsilons(4)


@dataclass(frozen=True)
class Points:
    """Points as maps that can be shaded; all [P, ...]."""

    albedo: Tensor
    normals_world: Tensor
    shading: Tensor
    mask: Tensor
    points_world: Tensor

    def to(self, dtype: torch.dtype) -> Points:
        """In another precision."""
        return Points(**{name: value.to(dtype) for name, value in vars(self).items()})


def points(count: int = 64) -> Points:
    """Of a sphere of ten centimetres, in float64; all within the mask."""
    normals = torch.from_numpy(sphere_points(count))
    spread = torch.linspace(0.0, 1.0, count, dtype=torch.float64)
    return Points(
        albedo=0.2 + 0.6 * torch.stack([spread, spread**2, 1.0 - spread], dim=1),
        normals_world=normals,
        shading=0.1 + 0.8 * spread,
        mask=torch.ones(count, dtype=torch.float64),
        points_world=0.1 * normals,
    )


@cache
def panorama() -> np.ndarray:
    """[16, 32, 3] of smooth colour with a sun of 1e4 in one cell."""
    i, j = np.mgrid[0:16, 0:32]
    radiance = 0.5 + 0.4 * np.sin(i[..., None] / 3.0 + np.arange(3)) * np.cos(j[..., None] / 5.0)
    radiance[4, 20] = 1e4
    return radiance


def kinds(gain: float = 1.0) -> dict[str, Light]:
    """A light of every kind, of a strength; room and flash take theirs from the capture."""
    colour = (0.9 * gain, 1.0 * gain, 1.1 * gain)
    return {
        "captured": CapturedLight(),
        "room": RoomLight(),
        "flash": FlashLight(),
        "directional": DirectionalLight((0.3, 0.4, 0.8), 0.2, colour),
        "point": PointLight(_LAMP, colour),
        "environment": _environment(gain, "exact"),
        "environment by sh": _environment(gain, "sh"),
        "sh of 9": SphericalHarmonicsLight(gain * panorama_to_sh(panorama(), 3)),
        "sh of 16": SphericalHarmonicsLight(gain * panorama_to_sh(panorama(), 4)),
        "sum": SumLight((RoomLight(), PointLight(_LAMP, colour))),
    }


@cache
def _environment(gain: float, method: str) -> EnvironmentLight:
    return EnvironmentLight(panorama(), gain=gain, method=method)  # its table is made once


def cases() -> Iterator[Case]:
    """All cases of this module."""
    for name in kinds():
        for stressed, run in _HAZARDS.items():
            yield Case(LIGHTS, f"{name}: {stressed}", partial(run, name), _ROUNDINGS)
    for name in ("captured", "flash", "point", "sum"):
        yield Case(LIGHTS, f"{name}: d from 1e-30 to 1e6 m", partial(_over_distances, name, None))
        yield Case(LIGHTS, f"{name}: glossy, the same", partial(_over_distances, name, _GLOSSY))


_GLOSSY = Reflectance(0.5, 0.12, 0.04)


def _shaded(name: str, maps: Points, gain: float = 1.0, reflectance: Reflectance | None = None) -> Measured:
    """Radiance, and gradients in all that a fit would optimise."""
    dtype = maps.albedo.dtype
    inputs = {
        field: getattr(maps, field).clone().requires_grad_()
        for field in ("albedo", "normals_world", "shading", "points_world")
    }
    colours: dict[str, Any] = {
        key: torch.tensor(_COLOUR, dtype=dtype).mul(gain).requires_grad_() for key in ("c_room", "c_flash")
    }
    radiance = shade(
        kinds(gain)[name],
        replace(maps, **inputs),
        camera=_CAMERA,
        flash_offset_cam_m=(0.015, -0.01, 0.0),
        reflectance=reflectance,
        **colours,
    )
    return Measured({"radiance": radiance}, gradients_of(radiance, **inputs, **colours))


def _over_decades(name: str, dtype: torch.dtype) -> Measured:
    parts = {exponent: _shaded(name, points().to(dtype), 10.0**exponent) for exponent in _DECADES}
    return _joined({f"1e{exponent:+d}": part for exponent, part in parts.items()})


def _joined(parts: dict[str, Measured]) -> Measured:
    values = {f"{key} {name}": value for key, part in parts.items() for name, value in part.values.items()}
    gradients = {
        f"{key} {name}": value for key, part in parts.items() for name, value in part.gradients.items()
    }
    return Measured(values, gradients)


def _singular() -> Points:
    """Points that are black, that have no normal, and whose normals graze the lights of `kinds`."""
    maps = points()
    albedo, normals = maps.albedo.clone(), maps.normals_world.clone()
    albedo[::4] = 0.0
    normals[1::4] = 0.0
    towards = [torch.tensor(_LAMP, dtype=torch.float64), torch.from_numpy(_CAMERA.centre_world)]
    for first, lamp in ((2, towards[0]), (6, towards[1])):
        to_light = lamp - maps.points_world[first::8]
        across = torch.linalg.cross(to_light, torch.tensor([0.3, 0.5, -0.7]).double().expand_as(to_light))
        normals[first::8] = torch.nn.functional.normalize(across, dim=1)
    return replace(maps, albedo=albedo, normals_world=normals)


def _unmasked(name: str, dtype: torch.dtype) -> Measured:
    maps = points().to(dtype)
    return _shaded(name, replace(maps, mask=torch.zeros_like(maps.mask)))


def _beside_nan(name: str, dtype: torch.dtype) -> Measured:
    """Only the other points are looked at; they have to be what they are without the broken ones."""
    maps = points()
    if dtype != torch.float64:
        broken = {
            field: getattr(maps, field).clone() for field in ("albedo", "normals_world", "points_world")
        }
        broken["albedo"][3], broken["normals_world"][9] = torch.nan, torch.inf
        broken["points_world"][17] = torch.nan
        maps = replace(maps, **broken)
    measured = _shaded(name, maps.to(dtype))
    others = torch.ones(64, dtype=torch.bool)
    others[[3, 9, 17]] = False
    gradients = {
        key: value[others] for key, value in measured.gradients.items() if key not in ("c_room", "c_flash")
    }
    return Measured({"radiance": measured.values["radiance"][others]}, gradients)


def _over_distances(name: str, reflectance: Reflectance | None, dtype: torch.dtype) -> Measured:
    """From within the lamp to a kilometre of kilometres away, before and behind it."""
    lamp = torch.tensor(_LAMP, dtype=torch.float64)
    camera = torch.from_numpy(_CAMERA.centre_world)
    flash = camera + torch.from_numpy(_CAMERA.cam_from_world[:3, :3].T @ np.array([0.015, -0.01, 0.0]))
    along = torch.tensor([0.36, 0.48, 0.8], dtype=torch.float64)
    distances = [0.0, 1e-30, 1e-12, 1e-6, 1e-4, 1e-3, 0.1, 1e3, 1e6]
    places = torch.stack(
        [at + sign * d * along for at in (lamp, camera, flash) for d in distances for sign in (1.0, -1.0)]
    )
    maps = points(len(places))
    maps = replace(maps, points_world=places, normals_world=along.expand_as(places))
    return _shaded(name, maps.to(dtype), reflectance=reflectance)


def _usual(name: str, dtype: torch.dtype) -> Measured:
    return _shaded(name, points().to(dtype))


def _of_singular(name: str, dtype: torch.dtype) -> Measured:
    return _shaded(name, _singular().to(dtype))


def _of_one_point(name: str, dtype: torch.dtype) -> Measured:
    return _shaded(name, points(1).to(dtype))


_HAZARDS: dict[str, Callable[[str, torch.dtype], Measured]] = {
    "usual": _usual,
    "intensities over 12 decades": _over_decades,
    "black, zero and grazing normals": _of_singular,
    "one point": _of_one_point,
    "empty mask": _unmasked,
    "NaN and Inf in a point stay there": _beside_nan,
}
