"""Poses of frames that the reconstruction was not made from, by the points that they see of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pycolmap

from capture.cameras import Camera, nearest_rotation
from relight.sfm.lenses import lens_of
from relight.sfm.mapping import quiet_colmap
from relight.sfm.matching import match_features
from relight.sfm.sparse import Sparse, camera_name
from relight.sfm.survey import Look

LEAST_INLIERS = 20
"""Points that must agree on a pose."""

_LEAST_SHARE = 0.35  # of the matches that agree
_NEIGHBOURS = 6  # posed frames, nearest in the order of capture, that a frame is compared with
_MAX_ERROR_PX = 3.0


def resect(
    look: Look,
    neighbours: Sequence[tuple[int, Look]],
    sparse: Sparse,
    colmap_camera: pycolmap.Camera,
    seed: int,
) -> Camera | str:
    """The pose of a frame, or what is missing.

    Args:
        look: The frame.
        neighbours: Posed frames with their positions, the likeliest first.
        sparse: The reconstruction.
        colmap_camera: The frame's lens at the size at which it was looked at.
        seed: Of the robust estimate.
    """
    point_of: dict[int, int] = {}
    for position, other in neighbours:
        points = sparse.point_of_feature(position, len(other.features))
        for mine, theirs in match_features(look.features, other.features).tolist():
            if points[theirs] >= 0:
                point_of.setdefault(mine, int(points[theirs]))
    if len(point_of) < LEAST_INLIERS:
        return f"it shares {len(point_of)} points with the frames around it (needed: {LEAST_INLIERS})"
    mine = np.array(sorted(point_of))
    estimation = pycolmap.AbsolutePoseEstimationOptions()
    estimation.ransac.max_error = _MAX_ERROR_PX
    estimation.ransac.random_seed = seed
    with quiet_colmap():
        found = pycolmap.estimate_and_refine_absolute_pose(
            look.features.places_px[mine],
            sparse.points[[point_of[int(i)] for i in mine]],
            colmap_camera,
            estimation,
        )
    agreeing = 0 if found is None else int(found["num_inliers"])
    if found is None or agreeing < LEAST_INLIERS or agreeing < _LEAST_SHARE * len(mine):
        return f"{agreeing} of its {len(mine)} points agree on a pose (needed: {LEAST_INLIERS})"
    record = look.record
    K, distortion = lens_of(colmap_camera, record.width, record.height)
    cam_from_world = np.eye(4)
    cam_from_world[:3] = np.asarray(found["cam_from_world"].matrix())
    cam_from_world[:3, :3] = nearest_rotation(cam_from_world[:3, :3])
    return Camera(camera_name(look), record.width, record.height, K, cam_from_world, distortion, record.flash)


def resect_all(
    looks: Sequence[Look],
    kept: Sequence[int],
    sparse: Sparse,
    lenses: Mapping[tuple[int, int], pycolmap.Camera],
    seed: int,
) -> tuple[dict[int, Camera], dict[int, str]]:
    """Poses of all frames that have none yet.

    Args:
        looks: All frames, in the order of capture.
        kept: Positions in `looks` of the frames that were mapped, in the order of the reconstruction's.
        sparse: The reconstruction.
        lenses: COLMAP's cameras by size at which frames were looked at.
        seed: Of the robust estimates.

    Returns:
        Cameras by position in `looks`; and by position, why there is none.
    """
    posed = {kept[position]: position for position in sparse.cameras}
    order = np.array(sorted(posed))
    cameras: dict[int, Camera] = {}
    failed: dict[int, str] = {}
    for i, look in enumerate(looks):
        if i in posed:
            continue
        if look.size not in lenses:
            failed[i] = f"no frame of its size {look.size[0]} x {look.size[1]} has a pose"
            continue
        nearest = order[np.argsort(np.abs(order - i), kind="stable")[:_NEIGHBOURS]]
        neighbours = [(posed[int(j)], looks[int(j)]) for j in nearest]
        outcome = resect(look, neighbours, sparse, lenses[look.size], seed)
        if isinstance(outcome, Camera):
            cameras[i] = outcome
        else:
            failed[i] = outcome
    return cameras, failed
