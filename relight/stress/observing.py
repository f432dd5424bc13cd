"""The cloud that is made of the given one, and what is read of the frames at its points."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
import torch
from torch import Tensor

from relight.cloud import CloudConfig, SurfaceCloud, prepare_cloud
from relight.errors import PlanError
from relight.observations import observe_points, sample_bilinear
from relight.stress import captures
from relight.stress.captures import FilmedScene
from relight.stress.case import Case, Measured, Stage, at_most, epsilons, gradients_of
from relight.stress.subject import AXES_M, Floats, arc, normals_at, surface_points

CLOUD = Stage("cloud", (torch.float32,), "clouds are float32 by contract; planes are fitted in float64")
OBSERVE = Stage(
    "observe", (torch.float64, torch.float32), "bf16 has 8 bits: beyond 256 pixels it cannot name one"
)

_SMOOTHED = at_most(0.02)  # of the ellipsoid: a smoothing disc as wide as a quarter of it flattens it
_ONLY = (torch.float32,)


def cases() -> Iterator[Case]:
    """All cases of this module."""
    for stressed, points in _HEADS.items():
        yield Case(CLOUD, stressed, partial(_head, points), _SMOOTHED)
    for stressed, points in _NO_HEADS.items():
        yield Case(CLOUD, stressed, partial(_any_surface, points))
    for stressed, points in _NO_SURFACES.items():
        yield Case(CLOUD, stressed, partial(_any_surface, points), refused=PlanError)
    yield Case(
        CLOUD, "a million points", partial(_head, partial(surface_points, 1_000_000)), _SMOOTHED, long=True
    )
    yield Case(OBSERVE, "bilinear sample of a constant image", _constant_sample, epsilons(4))
    yield Case(OBSERVE, "bilinear sample on, beside and far outside the border", _border_sample, epsilons(4))
    yield Case(OBSERVE, "bilinear sample of a 1 x 1 image", _single_pixel_sample, epsilons(4))
    nan = partial(captures.of_constant_images, np.nan)
    for stressed, scene in (
        ("frames of NaN", nan),
        ("frames of Inf", partial(captures.of_constant_images, np.inf)),
        ("cloud behind the cameras", captures.behind_the_cameras),
        ("a camera a millimetre from the surface", captures.from_the_skin),
        ("empty masks", captures.with_empty_masks),
    ):
        yield Case(OBSERVE, stressed, partial(_observed, scene), dtypes=_ONLY)


def _half_broken() -> Floats:
    points = surface_points(6000)
    points[::4], points[1::4] = np.nan, np.inf
    return points


def _edge_on() -> Floats:
    side = np.linspace(-0.1, 0.1, 40)
    y, z = np.meshgrid(side, side)
    return np.stack([np.zeros(1600), y.ravel(), z.ravel()], axis=1)


_HEADS: dict[str, Callable[[], Floats]] = {
    "usual": lambda: surface_points(3000),
    "half of it NaN and Inf": _half_broken,
    "every point ten times": lambda: np.repeat(surface_points(3000), 10, axis=0),
}
_NO_HEADS: dict[str, Callable[[], Floats]] = {
    "a plane seen edge on": _edge_on,
    "points on a line": lambda: np.linspace([0.0, -0.1, 0.0], [0.0, 0.1, 0.0], 500),
}
_NO_SURFACES: dict[str, Callable[[], Floats]] = {
    "one point": lambda: surface_points(1),
    "copies of one point": lambda: np.zeros((1000, 3)),
    "no number": lambda: np.full((1000, 3), np.nan),
}


def _prepared(points: Floats) -> tuple[SurfaceCloud, Measured]:
    surface = prepare_cloud(points.astype(np.float32), None, arc(6), CloudConfig(max_points=2000))
    values = {
        "points": torch.from_numpy(surface.points),
        "normals": torch.from_numpy(surface.normals_world),
        "spacing and noise": torch.tensor([surface.spacing, surface.noise]),
    }
    return surface, Measured(values)


def _any_surface(points: Callable[[], Floats], dtype: torch.dtype) -> Measured:
    return _prepared(points())[1]


def _head(points: Callable[[], Floats], dtype: torch.dtype) -> Measured:
    """The error is how far the worst hundredth of the points lies off the ellipsoid, relative to it."""
    surface, measured = _prepared(points())
    off = np.abs(np.linalg.norm(surface.points.astype(np.float64) / AXES_M, axis=1) - 1.0)
    return Measured(measured.values, error=float(np.quantile(off, 0.99)))


def _constant_sample(dtype: torch.dtype) -> Measured:
    image = torch.full((3, 7, 9), 0.7, dtype=dtype)
    places = torch.tensor([[0.5, 0.5], [3.3, 2.9], [8.999, 6.999], [0.0, 0.0]], dtype=dtype)
    samples = sample_bilinear(image, places)
    return Measured({"samples": samples}, error=float((samples / image[0, 0, 0] - 1.0).abs().max()))


def _border_sample(dtype: torch.dtype) -> Measured:
    image = torch.rand(2, 6, 5, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    image = image.to(dtype).requires_grad_()
    rows = [[0.0, 0.0], [5.0, 6.0], [-3.0, 2.0], [1e6, 2.0], [2.5, -1e12], [2.5, 3.5]]
    places = torch.tensor(rows, dtype=dtype, requires_grad=True)
    samples = sample_bilinear(image, places)
    return Measured({"samples": samples}, gradients_of(samples, image=image, places=places))


def _single_pixel_sample(dtype: torch.dtype) -> Measured:
    image = torch.full((1, 1, 1), 0.3, dtype=dtype, requires_grad=True)
    samples = sample_bilinear(image, torch.tensor([[0.5, 0.5], [7.0, -1.0]], dtype=dtype))
    return Measured({"samples": samples}, gradients_of(samples, image=image))


def _observed(scene: Callable[[], FilmedScene], dtype: torch.dtype) -> Measured:
    points = surface_points(2000)
    normals = normals_at(points)
    surface = SurfaceCloud(points.astype(np.float32), normals.astype(np.float32), 0.008, 0.0)
    found = vars(observe_points(scene(), surface))
    return Measured({name: value for name, value in found.items() if isinstance(value, Tensor)})
