"""Projection, the z-buffer, what is looked up through it, and the filling of holes.

Places are compared in float64 and float32 only. Which point a pixel shows is compared with the plainest
z-buffer that there is, one point after the other in float64.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
import torch
from torch import Tensor

from capture.cameras import Camera
from relight.maps import pull_push
from relight.raster import gather_descriptors, project, rasterize_ids, rasterize_ids_reference
from relight.stress.case import Case, Measured, Stage, at_most, epsilons, gradients_of
from relight.stress.subject import Floats, looking_at_origin, sphere_points

PLACES = (torch.float64, torch.float32)
NO_PLACES = "bf16 has 8 bits: beyond 256 pixels it cannot name one"

PROJECTION = Stage("projection", PLACES, NO_PLACES)
DESCRIPTORS = Stage("descriptors")
PULL_PUSH = Stage("pull-push")

_CAMERA = looking_at_origin([0.1, 0.05, 0.5], 64)
_FULL = 0.05  # weight from which a pixel needs nothing of its surroundings
_ANOTHER_POINT = at_most(0.002)  # of the pixels: places that are a rounding from a pixel's border


def cases() -> Iterator[Case]:
    """All cases of this module."""
    for stressed, points in _CLOUDS.items():
        yield Case(PROJECTION, stressed, partial(_drawn, points, _CAMERA), _ANOTHER_POINT)
    for exponent in (-2, 3, 6):
        unit = 10.0**exponent
        far = looking_at_origin(unit * _CAMERA.centre_world, 64)
        drawn = partial(_drawn, partial(_head, 1500, unit), far)
        yield Case(PROJECTION, f"lengths times 1e{exponent:+d}", drawn, _ANOTHER_POINT)
    # Of the distance to the nearest point: the rest is lost when the camera's place is taken off.
    yield Case(PROJECTION, "d from 1 cm to 1e6 m", _near_and_far, epsilons(50))
    for stressed, count, ids in _LOOK_UPS:
        yield Case(DESCRIPTORS, stressed, partial(_gathered, count, torch.tensor(ids)), epsilons(1))
    for stressed, sums in _SUMS.items():
        yield Case(PULL_PUSH, stressed, partial(_filled, sums), epsilons(2))
    yield Case(PULL_PUSH, "constant stays constant", _constant, epsilons(2))


def around(camera: Camera) -> Floats:
    """A head, and points at the camera, just before and behind it, and far to its sides: [P, 3]."""
    eye, (right, down, forward) = camera.centre_world, camera.cam_from_world[:3, :3]
    axis = forward + 0.01 * right + 0.02 * down  # the optical axis itself goes through a corner of pixels
    near = [eye + z * axis for z in (0.0, 1e-12, -1e-12, 1e-4, -1e-4, 9.99e-4, 1.01e-3, -0.5, -1e6)]
    aside = [eye + s * right + t * down for s in (-1e6, 0.1) for t in (0.0, 1e3)]
    return np.concatenate([_head(1000), near, aside])


def _head(count: int, unit: float = 1.0) -> Floats:
    return 0.1 * unit * sphere_points(count)


def _broken() -> Floats:
    points = _head(1000)
    for first, value in enumerate((np.nan, np.inf, -np.inf, 1e38, -1e38)):
        points[first::40, first % 3] = value
    return points


_CLOUDS: dict[str, Callable[[], Floats]] = {
    "usual": lambda: _head(1500),
    "points behind, at and beside the camera": lambda: around(_CAMERA),
    "NaN, Inf and 1e38": _broken,
    "one point": lambda: np.zeros((1, 3)),
    "no point": lambda: np.zeros((0, 3)),
    "equal depths and copies": lambda: np.repeat(_head(150), 10, axis=0),
}

_LOOK_UPS: tuple[tuple[str, int, list[list[int]]], ...] = (
    ("over 12 decades", 5, [[0, 2, -1], [2, 2, 4], [-1, -1, 0]]),
    ("no pixel sees a point", 5, [[-1, -1], [-1, -1]]),
    ("one point, one pixel", 1, [[0]]),
)


def _drawn(points: Callable[[], Floats], camera: Camera, dtype: torch.dtype) -> Measured:
    """The error is the share of pixels that show another point than they should, at the worst scale."""
    pyramid = rasterize_ids(torch.from_numpy(points()).to(dtype), camera, 4)
    expected = rasterize_ids_reference(points(), camera, 4)
    wrong = [np.mean(ids.numpy() != truth) for ids, truth in zip(pyramid.ids, expected, strict=True)]
    levels = enumerate(zip(pyramid.ids, pyramid.depth_m, strict=True))
    return Measured({f"depth {t}": depth[ids >= 0] for t, (ids, depth) in levels}, error=float(max(wrong)))


def _near_and_far(dtype: torch.dtype) -> Measured:
    right, _, forward = torch.from_numpy(_CAMERA.cam_from_world[:3, :3])
    distances = torch.tensor([1e-2, 0.1, 1.0, 1e3, 1e6], dtype=torch.float64)
    places = torch.from_numpy(_CAMERA.centre_world) + distances[:, None] * (forward + 0.1 * right)
    points = places.to(dtype).requires_grad_()
    uv_px, z = project(points, _CAMERA)
    return Measured({"uv": uv_px, "z": z}, gradients_of(torch.cat([uv_px.flatten(), z]), points=points))


def _gathered(count: int, ids: Tensor, dtype: torch.dtype) -> Measured:
    descriptors = torch.logspace(-6, 6, count * 8, dtype=torch.float64).view(count, 8)
    descriptors = descriptors.to(dtype).requires_grad_()
    image = gather_descriptors(descriptors, ids)
    return Measured({"image": image}, gradients_of(image, descriptors=descriptors))


def _sparse(height: int, width: int, count: int) -> Tensor:
    """Sums [4, H, W] with weights in so many pixels."""
    sums = torch.zeros(4, height * width, dtype=torch.float64)
    where = torch.linspace(0, height * width - 1, count + 2)[1:-1].long()
    sums[:, where] = torch.tensor([0.2, 0.4, 0.6, 1.0], dtype=torch.float64)[:, None] * 0.03
    return sums.view(4, height, width)


def _steep() -> Tensor:
    random = torch.Generator().manual_seed(0)
    weight = 10.0 ** (12.0 * torch.rand(1, 20, 24, generator=random, dtype=torch.float64) - 6.0)
    values = torch.rand(3, 20, 24, generator=random, dtype=torch.float64)
    return torch.cat([values * weight, weight])


_SUMS: dict[str, Callable[[], Tensor]] = {
    "a lone weight in 33 x 17": lambda: _sparse(33, 17, 1),
    "weights over 12 decades": _steep,
    "no weight at all": lambda: torch.zeros(4, 13, 9, dtype=torch.float64),
    "one pixel": lambda: torch.full((4, 1, 1), 0.3, dtype=torch.float64),
    "a row of one pixel": lambda: _sparse(1, 37, 3),
}


def _filled(sums: Callable[[], Tensor], dtype: torch.dtype) -> Measured:
    given = sums().to(dtype).requires_grad_()
    image = pull_push(given, _FULL)
    return Measured({"image": image}, gradients_of(image, sums=given))


def _constant(dtype: torch.dtype) -> Measured:
    weight = _steep()[-1:].to(dtype)
    image = pull_push(torch.cat([0.5 * weight, weight]), _FULL)  # a power of two: the product is exact
    return Measured({"image": image}, error=float((image.double() / 0.5 - 1.0).abs().max()))
