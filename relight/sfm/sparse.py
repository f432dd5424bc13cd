"""A reconstruction as arrays: cameras by frame, points, and which frame saw which point where."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from numpy.typing import NDArray

from capture.cameras import Camera, nearest_rotation
from relight.sfm.lenses import lens_of
from relight.sfm.survey import Look

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Sparse:
    """Poses and points of one reconstruction.

    Attributes:
        cameras: By position in the list of frames that were mapped, at the frames' full size.
        points: [P, 3] world.
        error_px: [P] mean reprojection error at the size at which frames were looked at.
        observations: [O, 3] position of the frame, its feature, the point; ordered by point.
        model: The lens model's name.
    """

    cameras: dict[int, Camera]
    points: Floats
    error_px: Floats
    observations: Integers
    model: str

    @property
    def track_length(self) -> Integers:
        """[P] number of frames in which a point was found."""
        return np.bincount(self.observations[:, 2], minlength=len(self.points)).astype(np.int64)

    def point_of_feature(self, position: int, count: int) -> Integers:
        """[count] the point of each feature of a frame, -1 = none."""
        points = np.full(count, -1, np.int64)
        rows = self.observations[self.observations[:, 0] == position]
        points[rows[:, 1]] = rows[:, 2]
        return points

    def without(self, positions: Sequence[int]) -> Sparse:
        """The same without some of the cameras, and without points that fewer than two others saw."""
        gone = set(positions)
        kept = self.observations[~np.isin(self.observations[:, 0], list(gone))]
        enough = np.bincount(kept[:, 2], minlength=len(self.points)) >= 2
        number = np.cumsum(enough) - 1
        kept = kept[enough[kept[:, 2]]]
        kept = np.column_stack([kept[:, :2], number[kept[:, 2]]])
        cameras = {position: camera for position, camera in self.cameras.items() if position not in gone}
        return replace(
            self,
            cameras=cameras,
            points=self.points[enough],
            error_px=self.error_px[enough],
            observations=kept,
        )


def sparse_of(model: pycolmap.Reconstruction, looks: Sequence[Look]) -> Sparse:
    """The arrays of a COLMAP reconstruction of some frames, of which the n-th is image n + 1."""
    cameras = {}
    for number in sorted(model.reg_image_ids()):
        image, record = model.images[number], looks[number - 1].record
        K, distortion = lens_of(model.cameras[image.camera_id], record.width, record.height)
        cam_from_world = np.eye(4)
        cam_from_world[:3] = np.asarray(image.cam_from_world().matrix())
        cam_from_world[:3, :3] = nearest_rotation(cam_from_world[:3, :3])
        cameras[number - 1] = Camera(
            camera_name(look=looks[number - 1]),
            record.width,
            record.height,
            K,
            cam_from_world,
            distortion,
            record.flash,
        )
    model.update_point_3d_errors()
    numbers = sorted(model.point3D_ids())
    points, errors, observations = [], [], []
    for position, number in enumerate(numbers):
        point = model.points3D[number]
        points.append(point.xyz)
        errors.append(point.error)
        observations += [(e.image_id - 1, e.point2D_idx, position) for e in point.track.elements]
    return Sparse(
        cameras,
        np.array(points, np.float64).reshape(-1, 3),
        np.array(errors, np.float64),
        np.array(observations, np.int64).reshape(-1, 3),
        next(iter(model.cameras.values())).model_name,
    )


def camera_name(look: Look) -> str:
    """The stem of a frame's file."""
    return str(look.record.file).rsplit("/", 1)[-1].rsplit(".", 1)[0]
