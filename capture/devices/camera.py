"""What a camera is to the controller: locked, read frame by frame, checked, put back as it was.

with open_camera(url, bench) as camera:
    report = camera.lock(CameraProfile(exposure_s=0.005))
    frame = camera.read(timeout_s=1.0)
    drifted = camera.check()
    camera.restore()
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from types import TracebackType
from typing import Any, Protocol, Self, runtime_checkable

from numpy.typing import NDArray

from capture.cameras import Camera
from capture.ply import PointCloud


@dataclass(frozen=True, kw_only=True)
class CameraProfile:
    """What a capture asks of a camera; None leaves a setting to the back end, which says what it chose.

    Attributes:
        width: Pixels, with `height`.
        height: Pixels.
        fps: Frame rate.
        pixel_format: Four characters: "MJPG", "YUYV", "NV12", ...
        exposure_s: Exposure time of a row.
        gain: In the device's own units.
        white_balance_k: Colour temperature, kelvin.
        focus: In the device's own units.
        mains_hz: Frequency of the mains, 50 or 60, for the camera's own flicker filter; 0 turns it off.
        settle_frames: Frames that are dropped after the stream starts, before anything is set.
    """

    width: int | None = None
    height: int | None = None
    fps: float | None = None
    pixel_format: str | None = None
    exposure_s: float | None = None
    gain: float | None = None
    white_balance_k: float | None = None
    focus: float | None = None
    mains_hz: int | None = None
    settle_frames: int = 12

    def __post_init__(self) -> None:
        """Checks the numbers, not whether a device can do them."""
        if (self.width is None) != (self.height is None):
            raise ValueError("width and height go together; give both or neither")
        for name in ("width", "height", "fps", "exposure_s", "white_balance_k"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} is {value}; it must be a positive number")
        for name in ("gain", "focus"):
            value = getattr(self, name)
            if value is not None and not math.isfinite(value):
                raise ValueError(f"{name} is {value}; it must be a finite number")
        if self.mains_hz not in (None, 0, 50, 60):
            raise ValueError(f"mains_hz is {self.mains_hz}; it must be 50, 60 or 0")


@dataclass(frozen=True, kw_only=True)
class StreamFormat:
    """What the camera delivers once it is locked.

    Attributes:
        width: Pixels, sensor orientation.
        height: Pixels.
        pixel_format: Four characters, as in `CameraProfile`; "RGB3" for [H, W, 3] RGB.
        fps: Frame rate that the device promises; None = it does not say.
        transfer: Transfer function of the decoded pictures (`capture.transfer`).
        matrix: Of Y'CbCr formats: "bt601" or "bt709".
        full_range: Whether Y'CbCr codes span 0..255; False = 16..235.
        rotation_deg: Clockwise turn that shows the pictures upright.
        stride_bytes: From one line to the next where the format has lines; 0 = no padding.
    """

    width: int
    height: int
    pixel_format: str
    fps: float | None
    transfer: str = "srgb"
    matrix: str = "bt601"
    full_range: bool = False
    rotation_deg: int = 0
    stride_bytes: int = 0


@dataclass(frozen=True, kw_only=True)
class ControlReport:
    """One control after a lock or a check: what was wanted, what the device says, what the light says.

    Attributes:
        name: "exposure_s", "gain", "white_balance_k", "focus", "mains_hz", "fps", or the device's own name of
            a control that was neutralised ("backlight_compensation", ...).
        requested: None = recorded as it was found.
        read_back: None = the device does not tell.
        verified: True: checked beyond the read-back (by the light); False: that check failed; None: no check.
        note: A clamp, a rounding, a refusal, in words; empty = as requested.
    """

    name: str
    requested: float | None
    read_back: float | None
    verified: bool | None = None
    note: str = ""

    def to_json(self) -> dict[str, Any]:
        """For session.json."""
        return asdict(self)


@dataclass(frozen=True, kw_only=True)
class LockReport:
    """How a lock went.

    Attributes:
        controls: Everything that was set or recorded.
        warnings: Sentences for the user: clamps, controls that are missing, checks that failed.
    """

    controls: tuple[ControlReport, ...]
    warnings: tuple[str, ...] = ()

    def value(self, name: str) -> float | None:
        """What the device says of a control; None = it has none of that name, or does not tell."""
        return next((control.read_back for control in self.controls if control.name == name), None)


@dataclass(frozen=True, kw_only=True)
class CameraInfo:
    """What a camera says of itself before it is locked.

    Attributes:
        url: That opens it.
        name: For a person.
        back_end: "v4l2", "uvc", "opencv", "replay", "sim", ...
        details: Driver, bus, serial number, firmware: plain values for session.json.
        clock: What the frames' stamps count: "monotonic" (the host's CLOCK_MONOTONIC) or "own".
        stamp_at: What of a frame happens at its stamp: "start of exposure", "end of frame", "arrival",
            "unknown". The light tells the constant in between.
    """

    url: str
    name: str
    back_end: str
    details: Mapping[str, Any]
    clock: str
    stamp_at: str


@dataclass(frozen=True, kw_only=True, eq=False)
class CapturedFrame:
    """A frame as the device gives it, not decoded.

    Attributes:
        stamp_s: By the camera's clock (`CameraInfo.clock`).
        sequence: The device's own count; a gap is a lost frame.
        data: The device's bytes in `StreamFormat.pixel_format`, or for "RGB3" a picture [H, W, 3] RGB, uint8
            or uint16.
        arrival_s: Host clock when it was handed over.
        damaged: The device says that the frame is incomplete.
        stamp_estimated: The device's stamp could not be (not later than the one before, or in the future);
            this one is what the frames before it promise.
        exposure_s: Of this very frame, from devices that say it.
        gain: Likewise.
        camera: Its pose, from a simulated rig.
    """

    stamp_s: float
    sequence: int
    data: bytes | NDArray[Any]
    arrival_s: float
    damaged: bool = False
    stamp_estimated: bool = False
    exposure_s: float | None = None
    gain: float | None = None
    camera: Camera | None = None


class CameraDevice(Protocol):
    """A camera. Opening it changes nothing on the device; a context manager that closes it.

    Every method may raise `CameraError` and its kinds (`capture.errors`): `CameraGoneError` when the device
    is not there any more, `CameraTimeoutError` from `read`.
    """

    @property
    def info(self) -> CameraInfo:
        """Who it is."""

    @property
    def format(self) -> StreamFormat:
        """What it delivers; known after `lock`."""

    def lock(self, profile: CameraProfile) -> LockReport:
        """Sets format and rate, starts the stream, turns every automatic off, sets and reads back the rest.

        Afterwards the camera streams. Called again, it sets only what is different.
        """

    def read(self, timeout_s: float) -> CapturedFrame:
        """The next frame, in order; never one twice."""

    def check(self) -> tuple[ControlReport, ...]:
        """The locked controls that are not any more what the lock left: none while all is well."""

    def restore(self) -> tuple[str, ...]:
        """Puts the controls back to what they were before `lock`; sentences about those that would not go."""

    def close(self) -> None:
        """Stops the stream and lets go of the device; harmless when repeated or when the device is gone."""

    def __enter__(self) -> Self:
        """Itself."""

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Closes it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class KnownScene:
    """What a rig that knows its scene says beyond its frames' poses.

    Attributes:
        flash_offset_cam_m: [3] where the flash sits, in the camera's axes.
        cloud: The scene's points; None = it does not tell.
    """

    flash_offset_cam_m: tuple[float, float, float]
    cloud: PointCloud | None


@runtime_checkable
class KnowsScene(Protocol):
    """A camera that knows what it films, as a simulated one does."""

    def known_scene(self) -> KnownScene | None:
        """What it tells; None = it keeps it to itself."""
