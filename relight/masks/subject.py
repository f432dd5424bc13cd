"""The points of a dense cloud that may be the subject, before any mask: without strays and without the room.

Stereo leaves single points in the air and pieces of the walls. Strays have no neighbours; what is left falls
into pieces that do not touch, and the subject's is the largest near the point that the cameras look at.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from capture.cameras import Camera
from relight.cloud import spacing_and_noise
from relight.errors import GeometryError

FEWEST_POINTS = 200
_NEIGHBOURS = 8
_STRAY = 3.0  # times the median distance to the eighth neighbour
_LINK = 5.0  # points closer than so many spacings belong together
_LARGEST_GRID = 160  # cells along a side of the grid that tells pieces apart
_ATTACHED = 0.06  # of the distance to the cameras: pieces this near the subject's are its own (hair, an ear)
_REACH = 0.5  # of the distance to the cameras: how far from where they look the subject is sought


@dataclass(frozen=True, eq=False)
class SubjectCloud:
    """The part of a cloud that is taken for the subject.

    Attributes:
        points: [Q, 3] float32, world.
        chosen: [P] bool, which of the given points these are.
        spacing: Typical distance of neighbours, world units.
        noise: Standard deviation about the surface, world units.
        distance: Median distance from cameras to points, world units.
    """

    points: NDArray[np.float32]
    chosen: NDArray[np.bool_]
    spacing: float
    noise: float
    distance: float


def find_subject(points: NDArray[np.floating], cameras: Sequence[Camera]) -> SubjectCloud:
    """The subject's piece of a cloud.

    Args:
        points: [P, 3] world; what is not finite is left out.
        cameras: At least one.

    Raises:
        GeometryError: Too few points are left for a silhouette.
    """
    finite = np.flatnonzero(np.isfinite(points).all(axis=1))
    if len(finite) < FEWEST_POINTS:
        raise GeometryError(
            f"The cloud has {len(finite)} points of {FEWEST_POINTS} that a silhouette needs at least; make a "
            "dense cloud first, or give one with `relight import --points`."
        )
    cloud = np.ascontiguousarray(points[finite], dtype=np.float32)
    tree = cKDTree(cloud)
    reach = tree.query(cloud, k=[_NEIGHBOURS + 1], workers=-1)[0][:, 0]
    typical = float(np.median(reach))
    spacing = max(typical * math.sqrt(math.pi / _NEIGHBOURS), 1e-12)
    centre, distance = looked_at(cameras, cloud)
    near = np.linalg.norm(cloud - centre, axis=1) < 3.0 * distance
    dense = np.flatnonzero(near & (reach <= _STRAY * typical))
    if len(dense) >= FEWEST_POINTS:
        dense = dense[_subject_piece(cloud[dense], spacing, centre, distance)]
    if len(dense) < FEWEST_POINTS:
        raise GeometryError(
            f"Only {len(dense)} of {len(points)} points of the cloud lie together near where the cameras "
            f"look, {FEWEST_POINTS} are needed; check that cloud and poses are in the same coordinates."
        )
    chosen = np.zeros(len(points), bool)
    chosen[finite[dense]] = True
    kept = cloud[dense]
    centres = np.array([camera.centre_world for camera in cameras])
    distance = float(np.median(np.linalg.norm(centres - np.median(kept, axis=0), axis=1)))
    return SubjectCloud(kept, chosen, spacing, spacing_and_noise(kept)[1], distance)


def looked_at(cameras: Sequence[Camera], cloud: NDArray[np.float32]) -> tuple[NDArray[np.float64], float]:
    """The point nearest to all optical axes, and the median distance of the cameras from it.

    With parallel axes (or one camera) that point does not exist; it is then taken on them at the depth of the
    nearer part of the cloud.
    """
    centres = np.array([camera.centre_world for camera in cameras])
    axes = np.array([camera.cam_from_world[2, :3] for camera in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    normal = across.sum(axis=0)
    values = np.linalg.eigvalsh(normal)
    if values[0] > 1e-3 * len(cameras):
        point = np.linalg.solve(normal, (across @ centres[..., None])[..., 0].sum(axis=0))
        ahead = ((point - centres) * axes).sum(axis=1)
        if np.median(ahead) > 0:
            return point, float(np.median(ahead))
    centre, axis = centres.mean(axis=0), axes.mean(axis=0)
    depths = (cloud - centre) @ axis
    ahead_depths = depths[depths > 0]
    distance = float(np.percentile(ahead_depths, 25)) if len(ahead_depths) else 1.0
    return centre + distance * axis, max(distance, 1e-9)


def _subject_piece(
    cloud: NDArray[np.float32], spacing: float, centre: NDArray[np.float64], distance: float
) -> NDArray[np.int64]:
    """Indices of the points of the piece that is the subject's, and of pieces attached to it."""
    low, high = cloud.min(axis=0), cloud.max(axis=0)
    cell = max(_LINK * spacing / 2.0, float((high - low).max()) / _LARGEST_GRID)
    lattice = ((cloud - low) / cell).astype(np.int64)
    grid = np.zeros(lattice.max(axis=0) + 1, bool)
    grid[tuple(lattice.T)] = True
    labels, count = ndimage.label(grid, structure=np.ones((3, 3, 3), int))
    of_point = labels[tuple(lattice.T)]
    from_centre = np.linalg.norm(cloud - centre, axis=1)
    weight = np.exp(-0.5 * (from_centre / (_REACH * distance)) ** 2)
    score = np.bincount(of_point, weight, minlength=count + 1)
    main = int(np.argmax(score))
    # Other pieces of some size, a quarter of which lies as good as on it.
    body = cKDTree(cloud[of_point == main])
    kept = of_point == main
    for label in np.flatnonzero(np.bincount(of_point, minlength=count + 1) >= 0.001 * len(cloud)):
        if label != main:
            piece = of_point == label
            sample = cloud[piece][:: max(1, int(piece.sum()) // 500)]
            gap = np.percentile(body.query(sample)[0], 25)
            if gap < _ATTACHED * distance:
                kept |= piece
    return np.flatnonzero(kept)
