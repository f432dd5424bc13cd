"""Frames as the masks' stages read them: undistorted, at full size or small, few at a time in memory.

Masks are made in the undistorted picture and turned back into the frame's own pixels when they are written:
a session's masks lie over its frames as they are.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass, replace
from threading import Lock

import cv2
import numpy as np
from numpy.typing import NDArray

from capture.cameras import Camera
from capture.frame_record import FrameRecord
from capture.session import Session
from relight.errors import GeometryError

Floats = NDArray[np.float32]

_WIDEST_MARGIN = 0.25  # of a side: what a lens shows beyond that is repeated from the border
_KEPT_SMALL = 48  # small pictures in memory: more than the neighbours of the frames in hand
_CENTRES = np.array([[1.0, 0.0, -0.5], [0.0, 1.0, -0.5], [0.0, 0.0, 1.0]])  # to OpenCV's integer centres


@dataclass(frozen=True, eq=False)
class Frame:
    """A frame for which a mask is wanted.

    Attributes:
        index: The frame's number in the session.
        camera: Without distortion, full size; somewhat larger than the frame where its lens sees more.
        small: The same camera in the size of the small pictures.
        flash: 1, 0, or None = partial or unknown.
    """

    index: int
    camera: Camera
    small: Camera
    flash: int | None


class FrameSource:
    """The frames of a session that have a camera, those kept for validation left out.

    Attributes:
        frames: By index, in the order of the index.
        rotation_deg: Clockwise turn that shows the pictures upright.
    """

    def __init__(self, session: Session, cameras: Mapping[int, Camera], working_px: int) -> None:
        """Looks at records only.

        Args:
            session: Is read.
            cameras: By index of the frame.
            working_px: Longest side of the small pictures.

        Raises:
            GeometryError: No frame is left.
        """
        self._session = session
        self._records: dict[int, FrameRecord] = {}
        self._distorted: dict[int, Camera] = {}
        self.frames: dict[int, Frame] = {}
        self.rotation_deg = int(session.info["image"].get("rotation_deg", 0))
        self._cache: OrderedDict[int, Floats] = OrderedDict()
        self._lock = Lock()
        for record in sorted(session.frames, key=lambda record: record.index):
            camera = cameras.get(record.index)
            if camera is None or record.file is None or record.split == "val":
                continue
            if camera.distortion.any():
                self._distorted[record.index] = camera
                camera = straight_camera(camera)
            camera = replace(camera, distortion=np.zeros(0), flash=record.flash)
            small = camera.scaled(min(1.0, working_px / max(camera.width, camera.height)))
            self._records[record.index] = record
            self.frames[record.index] = Frame(record.index, camera, small, record.flash)
        if not self.frames:
            raise GeometryError(
                f"None of the {len(session.frames)} frames of {session.path} has a pose and a picture to "
                "find a mask in; find the poses first."
            )

    def radiance(self, frame: Frame) -> Floats:
        """[H, W, 3] linear, undistorted, finite, not negative."""
        radiance = self._session.load_radiance(self._records[frame.index])
        # Noise about a calibrated dark level is negative half of the time; here logarithms are taken.
        radiance = np.maximum(np.nan_to_num(radiance, nan=0.0, posinf=1.0, neginf=0.0), np.float32(0.0))
        if frame.index in self._distorted:
            radiance = self._straightened(radiance, frame)
        return radiance

    def small(self, frame: Frame) -> Floats:
        """[h, w, 3] linear, undistorted, averaged down to the size of `frame.small`."""
        with self._lock:
            if frame.index in self._cache:
                self._cache.move_to_end(frame.index)
                return self._cache[frame.index]
        picture = shrunk(self.radiance(frame), frame.small)
        with self._lock:
            self._cache[frame.index] = picture
            while len(self._cache) > _KEPT_SMALL:
                self._cache.popitem(last=False)
        return picture

    def in_frame_pixels(self, mask: Floats, frame: Frame) -> Floats:
        """A mask [H, W] of the undistorted picture, in the pixels of the frame as it is stored."""
        distorted = self._distorted.get(frame.index)
        if distorted is None:
            return mask
        width, height = distorted.width, distorted.height
        pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1) + 0.5
        straight = _straight_px(pixels.reshape(-1, 2), distorted, frame.camera.K)
        places = (straight.reshape(height, width, 2) - 0.5).astype(np.float32)
        result = cv2.remap(
            mask, places[..., 0], places[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        return np.asarray(result, np.float32)

    def _straightened(self, radiance: Floats, frame: Frame) -> Floats:
        """The frame resampled to the pinhole; what lies outside of the lens's picture repeats its border."""
        distorted = self._distorted[frame.index]
        grid = cv2.initUndistortRectifyMap(
            _CENTRES @ distorted.K,
            distorted.opencv_distortion,
            np.eye(3),
            _CENTRES @ frame.camera.K,
            (frame.camera.width, frame.camera.height),
            cv2.CV_32FC1,
        )
        result = cv2.remap(radiance, *grid, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(result, np.float32)


def straight_camera(distorted: Camera) -> Camera:
    """The pinhole whose picture holds all that a lens shows, its focal length and scale kept."""
    width, height = distorted.width, distorted.height
    along, across = np.linspace(0, width, 33), np.linspace(0, height, 33)
    border = [np.stack(np.meshgrid(along, [0.0, height]), axis=-1).reshape(-1, 2)]
    border += [np.stack(np.meshgrid([0.0, width], across), axis=-1).reshape(-1, 2)]
    seen = _straight_px(np.concatenate(border), distorted, distorted.K)
    most = _WIDEST_MARGIN * max(width, height)
    left, top = (int(np.clip(np.ceil(-low), 0, most)) for low in seen.min(axis=0))
    right, bottom = (
        int(np.clip(np.ceil(high - side), 0, most))
        for high, side in zip(seen.max(axis=0), (width, height), strict=True)
    )
    shift = np.array([[0.0, 0.0, left], [0.0, 0.0, top], [0.0, 0.0, 0.0]])
    return replace(
        distorted,
        width=width + left + right,
        height=height + top + bottom,
        K=distorted.K + shift,
        distortion=np.zeros(0),
    )


def _straight_px(
    pixels: NDArray[np.floating], distorted: Camera, K: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Where pixels [N, 2] of a lens's picture are in that of a pinhole K; centres at 0.5 in both."""
    straight = cv2.undistortPoints(
        np.ascontiguousarray(pixels).reshape(-1, 1, 2), distorted.K, distorted.opencv_distortion, P=K
    )
    return np.nan_to_num(np.asarray(straight, np.float64).reshape(-1, 2), posinf=0.0, neginf=0.0)


def shrunk(picture: Floats, small: Camera) -> Floats:
    """A picture [H, W, ...] averaged down to a camera's size."""
    if picture.shape[:2] == (small.height, small.width):
        return picture
    result = cv2.resize(picture, (small.width, small.height), interpolation=cv2.INTER_AREA)
    return np.asarray(result, np.float32)
