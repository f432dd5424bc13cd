"""A camera of two halves: its controls by USB requests, its pictures through another back end.

The stream is locked first, with the format alone; then the controls (`control_lock`); last the light is asked
whether the exposure is what it says, which also shows that the stream is this very camera's.
"""

from __future__ import annotations

from dataclasses import replace
from types import TracebackType
from typing import Self

from capture.devices.camera import (
    CameraDevice,
    CameraInfo,
    CameraProfile,
    CapturedFrame,
    ControlReport,
    LockReport,
    StreamFormat,
)
from capture.devices.light_check import LightCheck, skip_latency, verify_exposure
from capture.devices.uvc.control_lock import ControlLock
from capture.devices.uvc.usb_link import UsbLink

_FRAME_TIMEOUT_S = 2.0


class UvcCamera:
    """Controls over USB beside a stream of another back end; `open_camera` puts them together."""

    def __init__(self, info: CameraInfo, link: UsbLink, controls: ControlLock, stream: CameraDevice) -> None:
        """Takes over the link and the stream, and closes them."""
        self.info = info
        self._link = link
        self._controls = controls
        self._stream = stream
        self._verdict: tuple[float, LightCheck] | None = None

    @property
    def format(self) -> StreamFormat:
        """Of the stream."""
        return self._stream.format

    def lock(self, profile: CameraProfile) -> LockReport:
        """See the module for the order.

        Raises:
            CameraError: The stream does not start, or the camera does not answer.
        """
        fresh = self._controls.begin()
        streamed = self._stream.lock(
            CameraProfile(
                width=profile.width,
                height=profile.height,
                fps=profile.fps,
                pixel_format=profile.pixel_format,
                settle_frames=profile.settle_frames if fresh else 0,
            )
        )
        reports = self._controls.lock(profile, fresh)
        warnings = [*streamed.warnings, *self._warnings(reports)]
        exposure_s = self._controls.exposure_s
        if exposure_s is not None:
            if fresh or self._verdict is None or self._verdict[0] != exposure_s:
                self._verdict = (exposure_s, self._verified(exposure_s))
            warnings += self._with_light(reports, self._verdict[1])
        fps = [report for report in streamed.controls if report.name == "fps"]
        return LockReport(controls=(*fps, *reports), warnings=tuple(warnings))

    def _warnings(self, reports: list[ControlReport]) -> list[str]:
        warnings = [f"{report.name}: {report.note}." for report in reports if report.note]
        if self._controls.shut:
            warnings.append(f"The shutter of the {self._link.device} is shut; open it.")
        exposure_s, fps = self._controls.exposure_s, self._stream.format.fps
        if exposure_s is None:
            warnings.append(
                f"The {self._link.device} has no exposure time that can be set over USB; light the room "
                "evenly and check that its pictures do not change by themselves, or use another camera."
            )
        elif fps and exposure_s * fps > 1:
            warnings.append(
                f"An exposure of {exposure_s:g} s is longer than the {1 / fps:.4g} s from frame to frame at "
                f"{fps:g} fps; the camera will cut it or slow down."
            )
        return warnings

    def _verified(self, exposure_s: float) -> LightCheck:
        """What the light says; a failure has a second try."""
        check = self._ask_light(exposure_s)
        if check.verified is False:
            self._controls.force_manual()
            self._controls.set_exposure(exposure_s)
            check = self._ask_light(exposure_s)
        return check

    def _ask_light(self, exposure_s: float) -> LightCheck:
        def read() -> CapturedFrame:
            return self._stream.read(_FRAME_TIMEOUT_S)

        check = verify_exposure(read, lambda: self.format, self._controls.set_exposure, exposure_s)
        skip_latency(read)
        return check

    def _with_light(self, reports: list[ControlReport], check: LightCheck) -> list[str]:
        """Puts the light's verdict into the report of the exposure; gives warnings."""
        index = next(index for index, report in enumerate(reports) if report.name == "exposure_s")
        notes = [note for note in (reports[index].note, check.note) if note]
        reports[index] = replace(reports[index], verified=check.verified, note="; ".join(notes))
        if check.verified:
            return []
        doubt = ""
        if check.verified is False:
            source = self._stream.info.url
            doubt = f"; see that {source} is this very camera (stream=...) and no other program sets it"
        return [f"exposure_s: {check.note}{doubt}."]

    def read(self, timeout_s: float) -> CapturedFrame:
        """The next frame of the stream."""
        return self._stream.read(timeout_s)

    def check(self) -> tuple[ControlReport, ...]:
        """What other programs or the firmware have changed since the lock."""
        return (*self._controls.check(), *self._stream.check())

    def restore(self) -> tuple[str, ...]:
        """Puts back what `lock` found."""
        return (*self._stream.restore(), *self._controls.restore())

    def close(self) -> None:
        """Stops the stream and lets go of both halves."""
        try:
            self._stream.close()
        finally:
            self._link.close()

    def __enter__(self) -> Self:
        """Itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Closes it."""
        self.close()
