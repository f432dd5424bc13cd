"""A cloud of stereo completed by the visual hull of masks, where stereo saw too little.

A point of the hull is taken where there is no point of the cloud near, where it does not stand over
or before what the cloud shows (the hull bridges hollows), and where cameras look at it, not only past it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from capture.cameras import Camera
from capture.session import Session
from relight.head_region import HeadRegion, find_head_region
from relight.raster import NEAR_M, project
from relight.stereo.config import DenseCloud
from relight.stereo.frames import GreyFrames
from relight.stereo.hull import VisualHull, visual_hull
from relight.stereo.views import directions_from, spread_out

_NEAR = 3.0  # spacings of the cloud within which it needs no completion
_ABOVE = 0.6  # sine of the angle at which a point stands over the nearest of the cloud, not beside it
_FAR = 25.0  # spacings from which on nearest points say nothing of that
_FINER = 1.3  # spacings of the cloud between the points that are added
_BEFORE = 6.0  # spacings by which a point may lie before the cloud
_FACING = 0.12  # cosine to the cameras that look at a point
_FEWEST_FACING = 2
_MOST_VIEWS = 24
_CELL = 4.0  # spacings: width of the cells of the z-buffer, so that none between points is empty


def complete_with_masks(
    session: Session, cameras: Mapping[int, Camera], cloud: DenseCloud, region: HeadRegion | None = None
) -> DenseCloud:
    """The cloud with what the session's masks add to it; as it is where there are too few masks.

    Args:
        session: Only read.
        cameras: By frame index.
        cloud: Of stereo.
        region: The head's sphere; found when not given.

    Returns:
        A cloud whose added points have confidence 0. Its report tells their number as "from_masks".
    """
    frames = GreyFrames(session, cameras, torch.device("cpu"), 1)
    region = find_head_region(session, cameras) if region is None else region
    hull = visual_hull(frames, region)
    return cloud if hull is None else completed(cloud, hull, frames)


def completed(cloud: DenseCloud, hull: VisualHull, frames: GreyFrames) -> DenseCloud:
    """The cloud with the points of a hull that it lacks."""
    spacing = _spacing(cloud.points)
    cameras = list(frames.cameras.values())
    directions = directions_from(np.asarray(hull.points.mean(axis=0), np.float64), cameras)
    views = [cameras[place] for place in spread_out(directions, _MOST_VIEWS)]
    tree, reach = cKDTree(cloud.points), _FAR * spacing
    # Most of the hull is where no camera looked: its coarse points tell, which spares most of the fine ones.
    distance, _ = tree.query(hull.points, distance_upper_bound=reach, workers=-1)
    _, facing = _seen(hull.points, hull.normals_world, cloud, views, spacing)
    chosen = (distance > _NEAR * spacing - 0.5 * hull.spacing) & (facing > 0)
    points, normals = hull.resampled(chosen, _FINER * spacing)
    distance, nearest = tree.query(points, distance_upper_bound=reach, workers=-1)
    far = ~np.isfinite(distance)
    nearest = np.where(far, 0, nearest)
    height = ((points - cloud.points[nearest]) * cloud.normals_world[nearest]).sum(axis=1)
    beside = far | ((distance > _NEAR * spacing) & (np.abs(height) < _ABOVE * distance))
    points, normals = points[beside], normals[beside]
    before, facing = _seen(points, normals, cloud, views, spacing)
    taken = ~before & (facing >= _FEWEST_FACING)
    points, normals = hull.to_outline(points[taken], normals[taken]), normals[taken]
    return DenseCloud(
        np.concatenate([cloud.points, points]),
        np.concatenate([cloud.normals_world, normals]),
        np.concatenate([cloud.confidence, np.zeros(len(points), np.float32)]),
        {**cloud.report, "from_masks": len(points), "points": len(cloud.points) + len(points)},
        cloud.warnings,
    )


def _seen(
    points: NDArray[np.float32],
    normals: NDArray[np.float32],
    cloud: DenseCloud,
    views: Sequence[Camera],
    spacing: float,
) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """[P] whether points hide what the cloud shows to some camera, and how many look at each."""
    before, facing = np.zeros(len(points), bool), np.zeros(len(points), np.int64)
    for camera in views if len(points) else ():
        hides, hidden = _against_cloud(points, cloud, camera, spacing)
        before |= hides
        towards = camera.centre_world - points
        cosine = (towards * normals).sum(axis=1) / np.linalg.norm(towards, axis=1).clip(1e-12)
        facing += (cosine > _FACING) & ~hidden
    return before, facing


def _against_cloud(
    points: NDArray[np.float32], cloud: DenseCloud, camera: Camera, spacing: float
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """[P] whether points hide what the cloud shows to a camera, and whether the camera does not see them.

    Only what of the cloud faces the camera counts: through its gaps the far side shows from within.
    """
    towards = torch.from_numpy(camera.centre_world).float() - torch.from_numpy(cloud.points)
    facing = (torch.from_numpy(cloud.normals_world) * towards).sum(dim=1) > 0
    _, z = project(torch.from_numpy(points), camera)
    if not (z > NEAR_M).any():
        return np.zeros(len(points), bool), np.ones(len(points), bool)
    cell_px = max(2.0, _CELL * spacing * float(camera.K[0, 0]) / float(z[z > NEAR_M].median()))
    place, depth, _ = _cells(torch.from_numpy(cloud.points)[facing], camera, cell_px)
    own, z, outside = _cells(torch.from_numpy(points), camera, cell_px)
    nearest = torch.full((int(max(place.max() if len(place) else 0, own.max())) + 1,), torch.inf)
    nearest.scatter_reduce_(0, place, depth, "amin")
    seen = nearest[own]
    hides = ~outside & torch.isfinite(seen) & (z < seen - _BEFORE * spacing)
    hidden = outside | (z > seen + _BEFORE * spacing)
    return np.asarray(hides.numpy(), bool), np.asarray(hidden.numpy(), bool)


def _cells(
    points: torch.Tensor, camera: Camera, cell_px: float
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Cell of the z-buffer [P], depth [P] (infinite outside of the picture) and whether outside [P]."""
    uv_px, z = project(points, camera)
    inside = (z > NEAR_M) & (uv_px >= 0).all(dim=1)
    inside &= (uv_px[:, 0] < camera.width) & (uv_px[:, 1] < camera.height)
    u, v = ((uv_px[:, axis] / cell_px).where(inside, torch.zeros_like(z)).long() for axis in (0, 1))
    place = v * (int(camera.width / cell_px) + 1) + u
    return place, torch.where(inside, z, torch.inf), ~inside


def _spacing(points: NDArray[np.float32]) -> float:
    sample = points[:: max(1, len(points) // 4000)]
    distances, _ = cKDTree(points).query(sample, k=[min(9, len(points))], workers=-1)
    return float(np.median(distances)) * float(np.sqrt(np.pi / 9.0))
