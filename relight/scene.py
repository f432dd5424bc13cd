"""What a fit reads from a session: undistorted cameras, the cloud, and frames in linear radiance on demand.

Frames are read one at a time and only when asked for, so memory does not grow with their number.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from calib.calibration import Calibration, session_calibration
from capture.cameras import Camera
from capture.frame_record import FrameRecord
from capture.ply import read_ply
from capture.radiometry import Radiometry
from capture.session import Session
from relight.errors import PlanError
from relight.lamp import Lamp, lamp_of
from relight.stages import Progress, no_progress

CLIPPED_RADIANCE = 0.95
"""Integer pixels at or above this radiance in any channel are taken for clipped (sRGB code 249 of 255)."""

_FLOAT_SUFFIXES = (".exr", ".hdr")  # these keep what is above the white clip


@dataclass(frozen=True, eq=False)
class View:
    """A frame of the scene.

    Attributes:
        index: The frame's number in the session.
        camera: Without distortion: frames are undistorted when they are read.
        flash: Flag F, 1 or 0.
    """

    index: int
    camera: Camera
    flash: int


@dataclass(frozen=True, eq=False)
class Observation:
    """One frame's pixels.

    Attributes:
        radiance: [H, W, 3] float32, linear, 1.0 = white clip.
        valid: [H, W] float32, 1 where the pixel can be trusted, 0 where it is clipped, not finite or
            outside the lens.
        mask: [H, W] float32 0..1 coverage of the subject, None = not given.
        variance: [H, W] float32, of the noise of the channels' mean; None = no noise model is known.
    """

    radiance: torch.Tensor
    valid: torch.Tensor
    mask: torch.Tensor | None
    variance: torch.Tensor | None = None


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """The noise of a pixel: variance = read^2 + shot * exposure, by channel.

    Attributes:
        read: [3] standard deviation at black.
        shot: [3].
    """

    read: NDArray[np.float64]
    shot: NDArray[np.float64]

    def variance(self, exposure: NDArray[np.float32], radiometry: Radiometry) -> NDArray[np.float32]:
        """[H, W] of the mean of the channels of the radiance that an exposure [H, W, 3] becomes."""
        share = np.full(3, 1.0 / 3.0) if radiometry.colour is None else radiometry.colour.mean(axis=0)
        weights = (share**2 * self.shot).astype(np.float32)
        variance = np.maximum(exposure, 0.0) @ weights + np.float32((share**2) @ self.read**2)
        if radiometry.flat_field is not None:
            variance = variance / radiometry.passed(*variance.shape) ** 2
        return np.asarray(variance, np.float32)


class Scene:
    """A session as the fit sees it.

    Attributes:
        points: [P, 3] float32, world.
        normals_world: [P, 3] unit as the cloud brings them, or None.
        views: The frames to fit.
        flash_offset_cam_m: [3] lens to flash in camera axes; zero when unknown (the paper's co-located
            flash).
        lamp: How the flash shines, as far as it is known.
        device: Where the solve runs.
    """

    lamp: Lamp = Lamp()

    def __init__(
        self,
        session: Session,
        points: torch.Tensor,
        normals_world: torch.Tensor | None,
        views: tuple[View, ...],
        flash_offset_cam_m: NDArray[np.float64],
        device: torch.device,
        records: dict[int, FrameRecord],
        distorted: dict[int, Camera],
        lamp: Lamp,
        noise: NoiseModel | None,
    ) -> None:
        """For `load_scene` only."""
        self.points = points
        self.normals_world = normals_world
        self.views = views
        self.flash_offset_cam_m = flash_offset_cam_m
        self.device = device
        self._session = session
        self._records = records
        self._distorted = distorted
        self.lamp = lamp
        self._noise = noise

    @property
    def calibration_warnings(self) -> list[str]:
        """What of the calibration is not applied, and why: one sentence or none."""
        _, warning = self._session.read_calibration()
        return [] if warning is None else [warning]

    @property
    def rotation_deg(self) -> int:
        """Clockwise turn that shows the frames upright."""
        return int(self._session.info["image"]["rotation_deg"])

    def observe(self, view: View) -> Observation:
        """Reads, linearises and undistorts a frame and its mask."""
        record = self._records[view.index]
        radiometry = self._session.radiometry
        exposure = self._session.load_exposure(record)
        keeps_highlights = str(record.file).endswith(_FLOAT_SUFFIXES)
        limits = CLIPPED_RADIANCE * radiometry.white
        if keeps_highlights:
            limits = np.full(3, self._float_limit(), np.float32)
        # By channel: a maximum over the last axis takes several times as long. NaN fails every comparison.
        good = [np.abs(exposure[..., channel]) < limits[channel] for channel in range(3)]
        valid = (good[0] & good[1] & good[2]).astype(np.float32)
        radiance = radiometry.radiance(exposure)
        variance = None if self._noise is None else self._noise.variance(exposure, radiometry)
        if keeps_highlights:
            radiance = np.where(np.isfinite(radiance), radiance, np.float32(0.0))
        coverage = self._session.load_mask(record)
        mask = None if coverage is None else coverage.astype(np.float32) / np.float32(255.0)
        if view.index in self._distorted:
            grid = _undistortion_grid(self._distorted[view.index], view.camera)
            radiance, valid = _remapped(radiance, grid), _remapped(valid, grid)
            mask = None if mask is None else _remapped(mask, grid)
            variance = None if variance is None else _remapped(variance, grid)
        return Observation(
            torch.from_numpy(radiance).to(self.device),
            torch.from_numpy(valid).to(self.device),
            None if mask is None else torch.from_numpy(mask).to(self.device),
            None if variance is None else torch.from_numpy(variance).to(self.device),
        )

    def _float_limit(self) -> float:
        """Where float pixels are clipped: as the session says (RAW pictures), else nowhere."""
        return float(self._session.info["image"].get("clip_radiance", np.inf))


def load_scene(
    session: Session,
    *,
    frames: Sequence[int],
    undistort: bool = True,
    device: torch.device | str = "cpu",
    progress: Progress = no_progress,
) -> Scene:
    """Opens what a fit needs.

    Args:
        session: With poses and a cloud in its scene folder.
        frames: Indices to use; each has a pose and a flash flag.
        undistort: Whether frames are resampled to a pinhole; without, their distortion is taken for none.
        device: Where the solve shall run.
        progress: Told ("read", fraction).

    Raises:
        PlanError: A frame has no pose or no flag, or the cloud is empty.
    """
    device = torch.device(device)
    cameras = session.load_scene_cameras()
    records = {record.index: record for record in session.frames}
    views, distorted = [], {}
    for index in frames:
        camera = cameras.get(index)
        flash = records[index].flash if index in records else None
        if camera is None or flash is None:
            missing = "pose" if camera is None else "flash flag"
            raise PlanError(f"Frame {index} of {session.path} has no {missing}; leave it out of the fit.")
        if undistort and camera.distortion.any():
            distorted[index] = camera
        views.append(View(index, replace(camera, distortion=np.zeros(0), flash=flash), flash))
    progress("read", 0.5)
    cloud = read_ply(session.points_path)
    points = torch.from_numpy(np.ascontiguousarray(cloud.points, dtype=np.float32))
    normals = None
    if cloud.normals is not None:
        normals = torch.from_numpy(np.ascontiguousarray(cloud.normals, dtype=np.float32))
    if not len(points):
        raise PlanError(f"The cloud {session.points_path} has no points; a fit needs one.")
    calibration = session_calibration(session)
    offset = calibration.value("flash_offset_cam_m")
    assert offset is not None  # it has a fallback
    progress("read", 1.0)
    return Scene(
        session,
        points,
        normals,
        tuple(views),
        offset,
        device,
        {view.index: records[view.index] for view in views},
        distorted,
        lamp_of(calibration),
        noise_model_of(calibration),
    )


def noise_model_of(calibration: Calibration) -> NoiseModel | None:
    """The noise model of a calibration, where it has one."""
    read, shot = calibration.value("noise_read"), calibration.value("noise_shot")
    return None if read is None or shot is None else NoiseModel(read, shot)


def _undistortion_grid(
    distorted: Camera, straight: Camera
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """For cv2.remap: where each pixel of the straight picture lies in the distorted one, integer centres."""
    to_integer_centres = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])
    x, y = cv2.initUndistortRectifyMap(
        to_integer_centres @ distorted.K,
        distorted.opencv_distortion,
        np.eye(3),
        to_integer_centres @ straight.K,
        (straight.width, straight.height),
        cv2.CV_32FC1,
    )
    return np.asarray(x, np.float32), np.asarray(y, np.float32)


def _remapped(
    image: NDArray[np.float32], grid: tuple[NDArray[np.float32], NDArray[np.float32]]
) -> NDArray[np.float32]:
    """The image read at the grid's places; 0, that is invalid, outside of it."""
    return np.asarray(cv2.remap(image, *grid, cv2.INTER_LINEAR), np.float32)
