"""Frames as stereo sees them: undistorted grey pictures at a level of a pyramid, read when they are needed.

Only a few are kept in memory, so what is held does not grow with the number of frames.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from capture.cameras import Camera
from capture.frame_record import FrameRecord
from capture.session import Session

_ENCODING = 0.45  # power of the radiance: noise is about as large in the dark as in the light, as in sRGB
_MOST_RADIANCE = 1.5  # of float frames: what is brighter is a lamp


class GreyFrames:
    """Grey pictures of a session's posed frames, with a small memory.

    Attributes:
        cameras: By frame index, without distortion: pictures are undistorted when they are read.
        flash: By frame index, F.
    """

    def __init__(
        self, session: Session, cameras: Mapping[int, Camera], device: torch.device, most_kept: int
    ) -> None:
        """Opens the usable training frames that have a pose.

        Args:
            session: Only read.
            cameras: By frame index.
            device: Where pictures shall be.
            most_kept: Pictures held at a time, all levels together.
        """
        self._session = session
        self._records: dict[int, FrameRecord] = {
            record.index: record
            for record in session.frames
            if record.usable and record.split != "val" and record.index in cameras
        }
        self._given = {index: cameras[index] for index in self._records}
        self.cameras = {index: replace(given, distortion=np.zeros(0)) for index, given in self._given.items()}
        self.flash = {index: int(record.flash or 0) for index, record in self._records.items()}
        self._device = device
        self._most_kept = most_kept
        self._kept: OrderedDict[tuple[int, float], torch.Tensor] = OrderedDict()

    def grey(self, index: int, scale: float = 1.0) -> torch.Tensor:
        """[H, W] float32 about 0..1: radiance to the power 0.45, of the picture resized by a factor.

        Pixels are those of `cameras[index].scaled(scale)`.
        """
        key = (index, scale)
        if key not in self._kept:
            self._kept[key] = self._load(index) if scale == 1.0 else self._reduced(index, scale)
            while len(self._kept) > self._most_kept:
                self._kept.popitem(last=False)
        self._kept.move_to_end(key)
        return self._kept[key]

    def has_mask(self, index: int) -> bool:
        """Whether the session has a mask of a frame."""
        return self._session.mask_path(index).is_file()

    def mask(self, index: int) -> NDArray[np.float32] | None:
        """[H, W] 0..1 coverage of the subject, undistorted; None where the session has no mask."""
        coverage = self._session.load_mask(self._records[index])
        if coverage is None:
            return None
        return self._undistorted(index, coverage.astype(np.float32) / np.float32(255.0))

    def _load(self, index: int) -> torch.Tensor:
        radiance = self._session.load_radiance(self._records[index])
        grey = np.nan_to_num(radiance @ np.array([0.3, 0.5, 0.2], np.float32), posinf=_MOST_RADIANCE)
        encoded = np.clip(grey, 0.0, _MOST_RADIANCE) ** np.float32(_ENCODING)
        return torch.from_numpy(self._undistorted(index, encoded)).to(self._device)

    def _reduced(self, index: int, scale: float) -> torch.Tensor:
        camera = self.cameras[index].scaled(scale)
        size = (camera.height, camera.width)
        full = self.grey(index)[None, None]
        return torch.nn.functional.interpolate(
            full, size=size, mode="bilinear", antialias=True, align_corners=False
        )[0, 0].contiguous()

    def _undistorted(self, index: int, image: NDArray[np.float32]) -> NDArray[np.float32]:
        given = self._given[index]
        if not given.distortion.any():
            return np.ascontiguousarray(image, np.float32)
        integer_centres = given.K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
        grid = cv2.initUndistortRectifyMap(
            integer_centres,
            given.opencv_distortion,
            np.eye(3),
            integer_centres,
            (given.width, given.height),
            cv2.CV_32FC1,
        )
        return np.asarray(cv2.remap(image, *grid, cv2.INTER_LINEAR), np.float32)
