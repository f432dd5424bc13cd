"""Signed distances (negative inside) and their smooth unions: the clay that the head is sculpted from.

All functions take points [P, 3] and return [P] in the unit of the points. An ellipsoid's distance is the
usual first-order approximation; it is exact on the surface, which is all that the mesher needs.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

Vector = Sequence[float]


def _vector(values: Vector) -> np.ndarray:
    return np.asarray(values, dtype=np.float32)


def sphere(points: np.ndarray, centre: Vector, radius: float) -> np.ndarray:
    """Distance to a sphere."""
    return np.linalg.norm(points - _vector(centre), axis=-1) - np.float32(radius)


def ellipsoid(points: np.ndarray, centre: Vector, radii: Vector) -> np.ndarray:
    """First-order distance to an axis-aligned ellipsoid."""
    offset = (points - _vector(centre)) / _vector(radii)
    length = np.sqrt(np.einsum("pc,pc->p", offset, offset))
    offset /= _vector(radii)
    slope = np.sqrt(np.einsum("pc,pc->p", offset, offset))
    return length * (length - 1.0) / np.maximum(slope, 1e-6)


def round_cone(points: np.ndarray, start: Vector, end: Vector, radii: tuple[float, float]) -> np.ndarray:
    """Distance to a capsule whose radius goes from `radii[0]` to `radii[1]` (good for mild tapers)."""
    axis = _vector(end) - _vector(start)
    offset = points - _vector(start)
    along = np.clip(offset @ axis / np.float32(axis @ axis), 0.0, 1.0)
    away = offset - along[:, None] * axis
    radius = np.float32(radii[0]) + np.float32(radii[1] - radii[0]) * along
    return np.sqrt(np.einsum("pc,pc->p", away, away)) - radius


def capsule(points: np.ndarray, start: Vector, end: Vector, radius: float) -> np.ndarray:
    """Distance to a line segment thickened by `radius`."""
    return round_cone(points, start, end, (radius, radius))


def _fillet(first: np.ndarray, second: np.ndarray, width: float) -> np.ndarray:
    gap = np.maximum(np.float32(width) - np.abs(first - second), 0.0)
    return gap * gap * np.float32(0.25 / width)


def smooth_union(first: np.ndarray, second: np.ndarray, width: float) -> np.ndarray:
    """Union with a fillet of about `width` (quadratic smooth minimum)."""
    return np.minimum(first, second) - _fillet(first, second, width)


def smooth_subtract(body: np.ndarray, tool: np.ndarray, width: float) -> np.ndarray:
    """`body` without `tool`, the edge rounded over about `width`."""
    return np.maximum(body, -tool) + _fillet(body, -tool, width)


def smooth_step(values: np.ndarray, low: float, high: float) -> np.ndarray:
    """0 below `low`, 1 above `high`, smooth between (also for `low` > `high`: then falling)."""
    t = np.clip((values - np.float32(low)) / np.float32(high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def bump(values: np.ndarray, centre: float, width: float) -> np.ndarray:
    """Gaussian bump of height 1 at `centre` with standard deviation `width`."""
    return np.exp(-0.5 * ((values - np.float32(centre)) / np.float32(width)) ** 2)
