"""Cameras and flashes by URL: a lazy table of back ends, of which the simulated one is an ordinary entry.

A URL is a scheme, a colon, and what the back end makes of the rest: `sim:`, `sim:seed=3`. A back end
module has `open_rig(camera, flash, duration_s)`, which is given the rests of both URLs.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from capture.cameras import Camera
from capture.errors import DeviceError
from capture.ply import PointCloud

_BACK_ENDS = {"sim": "capture.sim.device"}


@dataclass(frozen=True, eq=False)
class CapturedFrame:
    """A frame as a camera gives it.

    Attributes:
        pts_s: Start of its first row's exposure, by the camera's clock.
        sequence: The camera's own count; a gap is a lost frame.
        rgb: [H, W, 3] uint8, display-referred, sensor orientation.
        camera: Its pose, from a rig that knows it.
    """

    pts_s: float
    sequence: int
    rgb: NDArray[np.uint8]
    camera: Camera | None = None


@dataclass(frozen=True, eq=False)
class RigDescription:
    """What a rig says of itself before the first frame.

    Attributes:
        width: Pixels.
        height: Pixels.
        transfer: Of the frames.
        rotation_deg: Clockwise turn that shows the frames upright.
        device: The camera and its locked controls, for session.json.
        flash_schedule: What the flash was told to do.
        duration_s: Length of the recording.
        flash_offset_cam_m: [3] where the flash sits, when that is known.
        cloud: The scene's points, from a rig that knows them.
    """

    width: int
    height: int
    transfer: str
    rotation_deg: int
    device: Mapping[str, Any]
    flash_schedule: Mapping[str, Any]
    duration_s: float
    flash_offset_cam_m: tuple[float, float, float] | None = None
    cloud: PointCloud | None = None


class CaptureRig(Protocol):
    """A camera and a flash that are ready to record."""

    @property
    def description(self) -> RigDescription:
        """What is known beforehand."""

    def frames(self) -> Iterator[CapturedFrame]:
        """The recording; the flash blinks while it is consumed and is off when it ends, however it ends."""


def open_rig(camera_url: str, flash_url: str, duration_s: float) -> CaptureRig:
    """The rig of two URLs.

    Raises:
        DeviceError: A scheme has no back end, the two do not go together, or the device does not answer.
    """
    (camera_scheme, camera), (flash_scheme, flash) = (_split(url) for url in (camera_url, flash_url))
    for scheme, url in ((camera_scheme, camera_url), (flash_scheme, flash_url)):
        if scheme not in _BACK_ENDS:
            raise DeviceError(
                f"{url} cannot be opened: real cameras and flashes come with a later release, and today "
                "there is only sim: (to use a phone's film, run `relight import VIDEO --out SESSION`)."
            )
    if camera_scheme != flash_scheme:
        raise DeviceError(f"{camera_url} and {flash_url} do not go together; use {camera_scheme}: for both.")
    rig: CaptureRig = importlib.import_module(_BACK_ENDS[camera_scheme]).open_rig(camera, flash, duration_s)
    return rig


def _split(url: str) -> tuple[str, str]:
    scheme, colon, rest = url.partition(":")
    return (scheme, rest) if colon else ("", url)
