"""The world's frame: what the cameras agree on as up, as the middle, and as the front."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from capture.cameras import Camera
from relight.alignment import Similarity

Floats = NDArray[np.float64]

TYPICAL_DISTANCE = 0.55
"""Median distance from the cameras to what they look at where no length is known: a phone at arm's length."""

# Up in camera axes by the clockwise turn that shows the pictures upright.
_UP_CAM = {
    0: np.array([0.0, -1.0, 0.0]),
    90: np.array([-1.0, 0.0, 0.0]),
    180: np.array([0.0, 1.0, 0.0]),
    270: np.array([1.0, 0.0, 0.0]),
}
_ROUNDS = 10
_LEAST_CONVERGENCE = 1e-3  # least eigenvalue of the mean projector across the axes: sin^2 of 1.8 degrees


def canonical_world(
    cameras: Sequence[Camera], points: Floats, rotation_deg: int, metres_per_unit: float | None
) -> Similarity:
    """The similarity from a reconstruction's world to one with up, middle and front.

    +Y is the mean of the cameras' up, the origin where they look, +Z level from it towards the middle of the
    cameras' path.

    Args:
        cameras: In the order of capture, at least two.
        points: [P, 3] that they see.
        rotation_deg: Clockwise turn that shows the frames upright.
        metres_per_unit: Of the reconstruction's unit; None = the unit is chosen for `TYPICAL_DISTANCE`.
    """
    turns = np.array([camera.cam_from_world[:3, :3] for camera in cameras])
    centres = np.array([camera.centre_world for camera in cameras])
    axes = turns[:, 2]
    up = _unit(
        (np.swapaxes(turns, 1, 2) @ _UP_CAM[rotation_deg % 360]).sum(axis=0), np.array([0.0, 1.0, 0.0])
    )
    origin = look_point(centres, axes, points)
    level = (centres - origin) - np.outer((centres - origin) @ up, up)
    lengths = np.linalg.norm(level, axis=1, keepdims=True)
    front = (level / np.maximum(lengths, 1e-12)).sum(axis=0)
    if np.linalg.norm(front) < 0.1 * len(cameras):  # all around: no side is the middle but that of mid-time
        front = level[len(cameras) // 2]
    fallback = np.cross(up, [0.0, 0.0, 1.0] if abs(up[2]) < 0.9 else [1.0, 0.0, 0.0])
    front = _unit(front, fallback / np.linalg.norm(fallback))
    rotation = np.array([np.cross(up, front), up, front])
    distance = float(np.median(np.linalg.norm(centres - origin, axis=1)))
    scale = TYPICAL_DISTANCE / max(distance, 1e-12) if metres_per_unit is None else metres_per_unit
    return Similarity(scale, rotation, -scale * rotation @ origin)


def look_point(centres: Floats, axes: Floats, points: Floats) -> Floats:
    """[3] the point nearest to the cameras' optical axes, robustly.

    Where the axes are as good as parallel they meet nowhere; then it is the middle of the cameras' view at
    the median depth of the points.

    Args:
        centres: [N, 3].
        axes: [N, 3] unit.
        points: [P, 3].
    """
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    weights = np.ones(len(centres))
    if np.linalg.eigvalsh(across.mean(axis=0))[0] < _LEAST_CONVERGENCE:
        centre, axis = centres.mean(axis=0), _unit(axes.sum(axis=0), axes[0])
        depth = float(np.median((points - centre) @ axis)) if len(points) else 1.0
        return np.asarray(centre + max(depth, 1e-6) * axis)
    point = np.zeros(3)
    for _ in range(_ROUNDS):
        normal = (weights[:, None, None] * across).sum(axis=0)
        point = np.linalg.solve(normal, np.einsum("n,nij,nj->i", weights, across, centres))
        away = np.linalg.norm(np.einsum("nij,nj->ni", across, point - centres), axis=1)
        weights = 1.0 / np.maximum(away, 0.02 * max(float(np.median(away)), 1e-12) + 1e-12)
        weights /= weights.sum()
    return np.asarray(point)


def _unit(vector: Floats, fallback: Floats) -> Floats:
    length = float(np.linalg.norm(vector))
    return np.asarray(vector / length if length > 1e-9 else fallback, np.float64)
