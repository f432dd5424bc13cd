"""A pinhole with the lens of Brown (1971) in OpenCV's form, and its derivatives.

    x = X/Z, y = Y/Z, r^2 = x^2 + y^2, s = 1 + k1 r^2 + k2 r^4 + k3 r^6
    u = fx (x s + 2 p1 x y + p2 (r^2 + 2 x^2)) + cx
    v = fy (y s + p1 (r^2 + 2 y^2) + 2 p2 x y) + cy

`lens` below is the vector [9] fx, fy, cx, cy, k1, k2, p1, p2, k3; pixel centres at 0.5.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calib.lens.terms import LENS_NAMES

Floats = NDArray[np.float64]

LENS_SIZE = len(LENS_NAMES)
# Points nearer to the camera's plane than this share of their distance do not project; they are put there.
_NEAREST_Z = 1e-6


def project(lens: Floats, points_cam: Floats) -> Floats:
    """[..., 2] pixels of points [..., 3] in camera axes."""
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = lens
    z = np.maximum(points_cam[..., 2], _NEAREST_Z)
    x, y = points_cam[..., 0] / z, points_cam[..., 1] / z
    r2 = x * x + y * y
    s = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    pixels = np.empty((*x.shape, 2))
    pixels[..., 0] = fx * (x * s + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + cx
    pixels[..., 1] = fy * (y * s + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) + cy
    return pixels


def project_with_slopes(lens: Floats, points_cam: Floats) -> tuple[Floats, Floats, Floats]:
    """Pixels of points, and how they change.

    Args:
        lens: [9].
        points_cam: [..., 3] in front of the camera.

    Returns:
        Pixels [..., 2]; their derivatives by the lens [..., 2, 9] and by the point [..., 2, 3].
    """
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = lens
    Z = np.maximum(points_cam[..., 2], _NEAREST_Z)
    x, y = points_cam[..., 0] / Z, points_cam[..., 1] / Z
    r2 = x * x + y * y
    s = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    ds = k1 + r2 * (2 * k2 + 3 * r2 * k3)  # by r^2
    tx, ty = r2 + 2 * x * x, r2 + 2 * y * y
    bent_x = x * s + 2 * p1 * x * y + p2 * tx
    bent_y = y * s + p1 * ty + 2 * p2 * x * y
    pixels = np.stack([fx * bent_x + cx, fy * bent_y + cy], axis=-1)

    by_lens = np.zeros((*x.shape, 2, LENS_SIZE))
    by_lens[..., 0, 0], by_lens[..., 1, 1] = bent_x, bent_y
    by_lens[..., 0, 2] = by_lens[..., 1, 3] = 1.0
    along = np.stack([fx * x, fy * y], axis=-1)
    for column, power in ((4, r2), (5, r2 * r2), (8, r2 * r2 * r2)):
        by_lens[..., column] = along * power[..., None]
    across = 2 * x * y
    by_lens[..., 0, 6], by_lens[..., 0, 7] = fx * across, fx * tx
    by_lens[..., 1, 6], by_lens[..., 1, 7] = fy * ty, fy * across
    xx = fx * (s + 2 * x * x * ds + 2 * p1 * y + 6 * p2 * x)
    cross = 2 * x * y * ds + 2 * p1 * x + 2 * p2 * y
    yy = fy * (s + 2 * y * y * ds + 6 * p1 * y + 2 * p2 * x)
    xy, yx = fx * cross, fy * cross
    by_point = np.empty((*x.shape, 2, 3))
    by_point[..., 0, 0], by_point[..., 0, 1], by_point[..., 0, 2] = xx, xy, -(xx * x + xy * y)
    by_point[..., 1, 0], by_point[..., 1, 1], by_point[..., 1, 2] = yx, yy, -(yx * x + yy * y)
    by_point /= Z[..., None, None]
    return pixels, by_lens, by_point


def rays_of(lens: Floats, pixels: Floats) -> Floats:
    """[..., 3] directions with z = 1 of pixels [..., 2]; NaN where the lens sends no ray there.

    Newton's iteration on the projection, from the undistorted guess.
    """
    fx, fy, cx, cy = lens[:4]
    start = (pixels - [cx, cy]) / [fx, fy]
    flat = start.copy()
    for _ in range(30):
        points = np.concatenate([flat, np.ones((*flat.shape[:-1], 1))], axis=-1)
        found, _, slope = project_with_slopes(lens, points)
        a, b, c, d = (slope[..., i, j] for i in (0, 1) for j in (0, 1))
        determinant = a * d - b * c
        determinant = np.where(np.abs(determinant) < 1e-12, np.nan, determinant)
        off = pixels - found
        step = np.stack([d * off[..., 0] - b * off[..., 1], a * off[..., 1] - c * off[..., 0]], axis=-1)
        step /= determinant[..., None]
        step = np.clip(step, -0.2, 0.2)  # one that overshoots the fold would end on its other side
        flat = flat + step
        if not np.nanmax(np.abs(step), initial=0.0) > 1e-13:
            break
    rays = np.concatenate([flat, np.ones((*flat.shape[:-1], 1))], axis=-1)
    rays[~(np.abs(project(lens, rays) - pixels).max(-1) < 1e-6 * max(fx, fy))] = np.nan
    return rays


def fold_radius(lens: Floats) -> float:
    """Tangent of the angle from the axis at which the lens model folds back; infinite where it does not.

    Beyond it, things farther out are drawn farther in: no lens does that, and no pixel has one ray any more.
    """
    k1, k2, k3 = lens[4], lens[5], lens[8]
    roots = np.roots(np.trim_zeros(np.array([7 * k3, 5 * k2, 3 * k1, 1.0]), "f"))
    real = roots[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)].real
    return float(np.sqrt(real.min())) if len(real) else float("inf")


def free_entries(names: Sequence[str]) -> list[int]:
    """Places in `lens` of the pinhole and the named distortion terms."""
    return [0, 1, 2, 3, *(LENS_NAMES.index(name) for name in names)]
