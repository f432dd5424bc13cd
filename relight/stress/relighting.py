"""Portraits under new lights that have a size, cast shadows, bounce and shine: all of a view's light at once.

Whether a light reaches a pixel is yes or no, and so is what a surfel sees of the others: with a rounding some
change sides. So the error is the mean over the pixels, relative to the brightest.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache, partial

import numpy as np
import torch
from torch import Tensor

from relight.lighting import DirectionalLight, EnvironmentLight, Light, PointLight, shade
from relight.maps import render_maps
from relight.portrait import Portrait
from relight.shadows import ShadowCaster
from relight.stress.case import Case, Measured, Stage, at_most
from relight.stress.lights import panorama
from relight.stress.projecting import NO_PLACES, PLACES
from relight.stress.rendering import HARDLY_A_HEAD, PORTRAITS, Made, of_points
from relight.stress.subject import looking_at_origin

RELIT = Stage("relit views", PLACES, NO_PLACES)

_CAMERA = looking_at_origin([0.1, 0.05, 0.5], 64)
_CHANGED_SIDES = at_most(0.01)
_WHITE = (1.0, 1.0, 1.0)


def cases() -> Iterator[Case]:
    """All cases of this module."""
    for stressed in ("usual", "zero normals", "black"):
        yield Case(RELIT, stressed, partial(_relit, PORTRAITS[stressed], _usual_lights), _CHANGED_SIDES)
    for stressed, points in HARDLY_A_HEAD.items():
        relit = partial(_relit, partial(of_points, points), _usual_lights)
        yield Case(RELIT, stressed, relit, _CHANGED_SIDES)
    yield Case(
        RELIT, "lights of no size, and of half the sky", partial(_relit, _usual, _odd_sizes), _CHANGED_SIDES
    )
    yield Case(RELIT, "lights over 12 decades", partial(_relit, _usual, _decades), _CHANGED_SIDES)
    yield Case(RELIT, "a lamp within the head", partial(_relit, _usual, _within), _CHANGED_SIDES)


def _usual(dtype: torch.dtype) -> Portrait:
    return PORTRAITS["usual"](dtype)


@cache
def _usual_lights() -> dict[str, Light]:
    return {
        "lamp": PointLight((0.2, 0.3, 0.8), _WHITE, radius=0.05),
        "sun": DirectionalLight((0.0, 0.6, 0.8), 0.0, _WHITE, shadows=True, angle_deg=5.0),
        "panorama": EnvironmentLight(panorama(), shadow_lights=16),
    }


@cache
def _odd_sizes() -> dict[str, Light]:
    return {
        "point": PointLight((0.2, 0.3, 0.8)),
        "bulb as large as the room": PointLight((0.2, 0.3, 0.8), radius=2.0),
        "sun of 120 degrees": DirectionalLight((0.0, 1.0, 0.0), shadows=True, angle_deg=120.0),
        "one light": EnvironmentLight(panorama(), shadow_lights=1),
    }


@cache
def _decades() -> dict[str, Light]:
    lamps = {f"1e{k:+d}": PointLight((0.2, 0.3, 0.8), (10.0**k,) * 3) for k in (-6, 6)}
    return {
        **lamps,
        "black": PointLight((0.2, 0.3, 0.8), (0.0, 0.0, 0.0)),
        "night": EnvironmentLight(np.zeros((4, 8, 3))),
    }


@cache
def _within() -> dict[str, Light]:
    return {"lamp": PointLight((0.0, 0.0, 0.0)), "bulb": PointLight((0.0, 0.0, 0.0), radius=0.2)}


def _relit(made: Made, lights: Callable[[], dict[str, Light]], dtype: torch.dtype) -> Measured:
    found = _radiances(made(dtype), lights())
    if dtype == torch.float64:
        return Measured(found)
    exact = _radiances(made(torch.float64), lights())
    errors = [
        float((value.double() - exact[name]).abs().mean()) / (float(exact[name].abs().max()) or 1.0)
        for name, value in found.items()
    ]
    return Measured(found, error=max(errors))


def _radiances(portrait: Portrait, lights: dict[str, Light]) -> dict[str, Tensor]:
    maps = render_maps(portrait, _CAMERA)
    visibility = ShadowCaster(portrait).of_view(maps)
    return {
        name: shade(light, maps, camera=_CAMERA, visibility=visibility, reflectance=portrait.reflectance)
        for name, light in lights.items()
    }
