"""Maps and shadows of portraits and views that nobody would take, and of ten million points.

Whether a light reaches a point is yes or no: a point at a shadow's edge may change sides with a rounding. So
the error of shadows is the mean over all points.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from capture.cameras import Camera
from relight.lighting import DirectionalLight, PointLight, shade
from relight.maps import Maps, render_maps
from relight.portrait import Portrait
from relight.raster import gather_descriptors, rasterize_ids
from relight.shadows import ShadowCaster
from relight.stress.case import Case, Measured, Stage, at_most
from relight.stress.projecting import NO_PLACES, PLACES, around
from relight.stress.subject import Floats, looking_at_origin, portrait, sphere_points

MAPS = Stage("maps", PLACES, NO_PLACES)
SHADOWS = Stage("shadows", PLACES, NO_PLACES)

_CAMERA = looking_at_origin([0.1, 0.05, 0.5], 64)
_MANY = 10_000_000
_DRAWN = at_most(1e-3)  # splats fall off like exp(-u^2) of a place u that is known to 1e-5 of a pixel
_EDGE = at_most(0.01)
_ONLY = (torch.float32,)
Made = Callable[[torch.dtype], Portrait]
"""A portrait in a precision."""


def cases() -> Iterator[Case]:
    """All cases of this module."""
    for stressed, made in PORTRAITS.items():
        yield Case(MAPS, stressed, partial(_mapped, made, _CAMERA), _DRAWN)
    for stressed, camera in _VIEWS.items():
        yield Case(MAPS, stressed, partial(_mapped, _usual, camera), _DRAWN)
    yield Case(MAPS, "ten million points", partial(_many, _many_mapped), dtypes=_ONLY, long=True)
    for stressed, lit in _LIT.items():
        yield Case(SHADOWS, stressed, partial(_shadowed, _usual, lit), _EDGE)
    for stressed, points in HARDLY_A_HEAD.items():
        for name in ("lamp before the head", "distant light", "many lights"):
            shadowed = partial(_shadowed, partial(of_points, points), _LIT[name])
            yield Case(SHADOWS, f"{stressed}, {name}", shadowed, _EDGE)
    yield Case(SHADOWS, "ten million points", partial(_many, _many_shadowed), dtypes=_ONLY, long=True)


def _usual(dtype: torch.dtype) -> Portrait:
    return portrait(dtype=dtype)


def of_points(points: Floats, dtype: torch.dtype) -> Portrait:
    """A portrait of some points."""
    return portrait(dtype=dtype, points=points)


def _times(dtype: torch.dtype, **factors: float) -> Portrait:
    made = portrait(dtype=dtype)
    return replace(made, **{name: factor * getattr(made, name) for name, factor in factors.items()})


def _spaced(spacing: float, dtype: torch.dtype) -> Portrait:
    return replace(portrait(dtype=dtype), spacing=spacing)


PORTRAITS: dict[str, Made] = {
    "usual": _usual,
    "one point": partial(of_points, np.array([[0.0, 0.0, 0.1]])),
    "points behind, at and beside the camera": partial(of_points, around(_CAMERA)),
    "every point ten times": partial(of_points, np.repeat(0.1 * sphere_points(1000), 10, axis=0)),
    "no point in the picture": partial(of_points, 0.1 * sphere_points(500) + np.array([0.0, 0.0, 9.0])),
    "zero normals": partial(_times, normals_world=0.0),
    "black": partial(_times, albedo=0.0, room_radiance=0.0),
    "intensities times 1e-6": partial(_times, room_radiance=1e-6),
    "intensities times 1e+6": partial(_times, room_radiance=1e6),
    "spacing of 1e-9 m": partial(_spaced, 1e-9),
    "spacing of 10 m": partial(_spaced, 10.0),
}
"""Such as nobody would take, by name."""

_VIEWS = {
    "a camera within the head": looking_at_origin([0.0, 0.0, 1e-3], 64),
    "a camera a millimetre from a point": looking_at_origin([0.0, 0.0, 0.101], 64),
    "a head of a pixel": looking_at_origin([0.0, 0.0, 20.0], 64),
    "a picture of one pixel": looking_at_origin([0.1, 0.05, 0.5], 1),
}

HARDLY_A_HEAD = {
    "one point": np.array([[0.0, 0.0, 0.1]]),
    "copies of one point": np.zeros((50, 3)),
    "points on a line to the lamp": np.linspace([0.0, 0.0, 0.0], [0.0, 0.6, 0.8], 50),
}
"""Points that make no surface, by name."""


def _mapped(made: Made, camera: Camera, dtype: torch.dtype) -> Measured:
    return Measured(_values(render_maps(made(dtype), camera)))


def _values(maps: Maps) -> dict[str, Tensor]:
    tensors = {name: value for name, value in vars(maps).items() if isinstance(value, Tensor)}
    return {name: value for name, value in tensors.items() if value.dtype.is_floating_point}


def _lit(position: list[float], caster: ShadowCaster) -> Tensor:
    made = caster.portrait
    return caster.point(made.points.new_tensor(position)).visible(made.points, made.normals_world)


def _lit_at_a_point(caster: ShadowCaster) -> Tensor:
    return _lit(caster.portrait.points[5].tolist(), caster)


def _lit_from(to_light: list[float], caster: ShadowCaster) -> Tensor:
    made = caster.portrait
    return caster.directional(made.points.new_tensor(to_light)).visible(made.points, made.normals_world)


def _lit_by_many(strength: float, caster: ShadowCaster) -> Tensor:
    directions = torch.from_numpy(sphere_points(12)).to(caster.portrait.points)
    return caster.environment(directions, strength * torch.ones_like(directions))


_LIT: dict[str, Callable[[ShadowCaster], Tensor]] = {
    "lamp before the head": partial(_lit, [0.2, 0.3, 0.8]),
    "lamp within the head": partial(_lit, [0.0, 0.0, 0.0]),
    "lamp at a point": _lit_at_a_point,
    # Further away a float32 tells places apart less finely than points are; distant lights are for that.
    "lamp a kilometre away": partial(_lit, [0.0, 300.0, 1000.0]),
    "distant light": partial(_lit_from, [0.0, 0.6, 0.8]),
    "distant light straight down": partial(_lit_from, [0.0, 1.0, 0.0]),
    "many lights": partial(_lit_by_many, 1.0),
    "many lights without light": partial(_lit_by_many, 0.0),
}


def _shadowed(made: Made, lit: Callable[[ShadowCaster], Tensor], dtype: torch.dtype) -> Measured:
    share = lit(ShadowCaster(made(dtype)))
    exact = share if dtype == torch.float64 else lit(ShadowCaster(made(torch.float64)))
    return Measured({"share": share}, error=float((share.double() - exact).abs().mean()))


def _many(work: Callable[[Portrait], dict[str, Tensor]], dtype: torch.dtype) -> Measured:
    with torch.no_grad():
        return Measured(work(portrait(_MANY, dtype)))


def _many_mapped(made: Portrait) -> dict[str, Tensor]:
    camera = looking_at_origin([0.1, 0.05, 0.5], 512)
    ids = rasterize_ids(made.points, camera, 4).ids[0]
    maps = render_maps(made, camera)
    lit = shade(DirectionalLight((0.0, 0.6, 0.8)), maps)
    return _values(maps) | {"radiance": lit, "raw image": gather_descriptors(made.albedo, ids)}


def _many_shadowed(made: Portrait) -> dict[str, Tensor]:
    maps = render_maps(made, looking_at_origin([0.1, 0.05, 0.5], 512))
    visibility = ShadowCaster(made).of_view(maps)
    return {"radiance": shade(PointLight((0.2, 0.3, 0.8)), maps, visibility=visibility)}
