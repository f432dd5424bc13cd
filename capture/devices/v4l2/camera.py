"""A V4L2 camera behind the interface of `capture.devices.camera`."""

from __future__ import annotations

import errno
import logging
from types import TracebackType
from typing import Self

from capture.devices.bench import Clock
from capture.devices.camera import (
    CameraInfo,
    CameraProfile,
    CapturedFrame,
    ControlReport,
    LockReport,
    StreamFormat,
)
from capture.devices.pixel_formats import frame_bytes
from capture.devices.v4l2.choice import Choice, choose_mode, stream_format
from capture.devices.v4l2.controls import Controls
from capture.devices.v4l2.kernel import Kernel
from capture.devices.v4l2.locking import ControlLock
from capture.devices.v4l2.node import Mode, VideoNode
from capture.devices.v4l2.stamps import Stamps
from capture.devices.v4l2.stream import RawFrame, Stream
from capture.errors import CameraError, CameraGoneError

_log = logging.getLogger(__name__)

#: The first frame of a stream takes a webcam up to two seconds; the others come at their rate.
_FIRST_FRAME_S, _FRAME_S = 5.0, 5.0
#: Modes that are given up one after the other while the bus has no bandwidth for them.
_BANDWIDTH_TRIES = 4


class V4l2Camera:
    """A camera behind a video node."""

    def __init__(self, kernel: Kernel, path: str, url: str, back_end: str, clock: Clock) -> None:
        """Opens it and changes nothing.

        Args:
            kernel: The system's, or a double of it.
            path: Of the node.
            url: That names it to the user.
            back_end: Likewise.
            clock: The one that the driver stamps with.

        Raises:
            CameraError: It is not there, not permitted, no camera, or in use.
        """
        self._clock = clock
        self._url = url
        self._back_end = back_end
        self._node = VideoNode(kernel, path)
        self._about = self._node.describe()
        self._stream = Stream(self._node, clock)
        self._controls = Controls(self._node)
        self._lock = ControlLock(self._controls, self._next_for_lock, lambda: self.format)
        self._choice: Choice | None = None
        self._format: StreamFormat | None = None
        self._stamps = Stamps(None)
        self._first: RawFrame | None = None
        self._whole = 0

    @property
    def info(self) -> CameraInfo:
        """Who it is; how it stamps is known once it streams."""
        return CameraInfo(
            url=self._url,
            name=self._about["card"] or self._about["path"],
            back_end=self._back_end,
            details=dict(self._about),
            clock="monotonic",
            stamp_at=self._stamp_at(),
        )

    @property
    def format(self) -> StreamFormat:
        """What it delivers.

        Raises:
            CameraError: It is not locked yet.
        """
        if self._format is None:
            raise CameraError(f"{self._node.path} has no format yet; lock the camera first.")
        return self._format

    def lock(self, profile: CameraProfile) -> LockReport:
        """Format, rate, stream, settle, automatics off, controls, read-back, light.

        Raises:
            CameraError: No such mode, no bandwidth, no frames, or the device fails.
        """
        choice = choose_mode(self._node.modes(), profile, self._node.path)
        fresh = not self._stream.running or self._choice is None or _differ(choice, self._choice)
        if fresh:
            choice = self._start(choice, profile)
            for _ in range(profile.settle_frames):
                self._next_for_lock()
        self._choice = choice
        controls, warnings = self._lock.lock(profile, fresh)
        return LockReport(
            controls=(self._rate_report(profile), *controls),
            warnings=(*choice.warnings, *self._timing_warnings(profile, controls), *warnings),
        )

    def read(self, timeout_s: float) -> CapturedFrame:
        """The next frame, in order.

        Raises:
            CameraTimeoutError: None in time.
            CameraGoneError: It is not there any more.
        """
        raw = self._stream.read(timeout_s)
        self._first = self._first or raw
        stamp_s, estimated = self._stamps.time_s(raw)
        if estimated:
            _log.info("%s: frame %d was stamped %.6f s", self._node.path, raw.sequence, raw.stamp_s)
        return CapturedFrame(
            stamp_s=stamp_s,
            sequence=raw.sequence,
            data=raw.data,
            arrival_s=raw.arrival_s,
            damaged=raw.damaged or len(raw.data) < self._whole,
            stamp_estimated=estimated,
        )

    def check(self) -> tuple[ControlReport, ...]:
        """Controls that are not any more what the lock left."""
        return self._lock.check()

    def restore(self) -> tuple[str, ...]:
        """Puts the controls back to what they were before the first lock; a camera that is gone says so."""
        try:
            return self._lock.restore()
        except CameraGoneError as error:
            return (f"The camera's controls could not be put back: {error}",)

    def close(self) -> None:
        """Stops and lets go; harmless when repeated or when the device is gone."""
        self._stream.stop()
        self._node.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _start(self, choice: Choice, profile: CameraProfile) -> Choice:
        """Streams in a mode; in a lesser one where the bus lacks bandwidth and the profile leaves it open."""
        modes = self._node.modes()
        said_before: tuple[str, ...] = ()
        for attempt in range(_BANDWIDTH_TRIES):
            try:
                self._start_mode(choice)
                return choice
            except CameraError as error:
                cause = error.__cause__
                full = isinstance(cause, OSError) and cause.errno == errno.ENOSPC
                modes = _lesser(modes, choice.mode)
                if not full or attempt == _BANDWIDTH_TRIES - 1 or not modes:
                    raise
                given_up = choice.mode
                try:
                    choice = choose_mode(modes, profile, self._node.path)
                except CameraError:
                    raise error from cause
                if profile.width is not None and _size(choice.mode) != _size(given_up):
                    raise error from cause
                said = (
                    f"The USB bus has no bandwidth for {given_up.width} x {given_up.height} "
                    f"{given_up.pixel_format}; {choice.mode.width} x {choice.mode.height} "
                    f"{choice.mode.pixel_format} was taken."
                )
                said_before += (said,)
                choice = Choice(choice.mode, choice.fps, (*choice.warnings, *said_before))
        raise CameraError(f"{self._node.path} cannot start to stream.")

    def _start_mode(self, choice: Choice) -> None:
        self._stream.stop()
        self._first = None
        try:
            self._configure(choice)
        except CameraError as error:
            cause = error.__cause__
            if not (isinstance(cause, OSError) and cause.errno in (errno.EBUSY, errno.EIO)):
                raise
            # After a stream that failed to start, some drivers need the node opened again.
            self._node.reopen()
            self._configure(choice)

    def _configure(self, choice: Choice) -> None:
        pix = self._node.set_format(choice.mode.pixel_format, choice.mode.width, choice.mode.height)
        fps = self._node.rate() if choice.fps is None else self._node.set_rate(choice.fps)
        self._format = stream_format(pix, fps)
        if self._format.pixel_format != choice.mode.pixel_format:
            raise CameraError(
                f"{self._node.path} lists {choice.mode.pixel_format} pictures, but gives "
                f"{self._format.pixel_format}; ask for a pixel format by name."
            )
        self._stamps = Stamps(1 / fps if fps else None)
        self._whole = frame_bytes(self._format) or 0
        self._stream.start()

    def _next_for_lock(self) -> CapturedFrame:
        return self.read(_FRAME_S if self._first else _FIRST_FRAME_S)

    def _rate_report(self, profile: CameraProfile) -> ControlReport:
        fps = self.format.fps
        note = "the device does not tell it" if fps is None else ""
        if fps is not None and profile.fps is not None and abs(fps - profile.fps) > 0.02 * profile.fps:
            note = f"{profile.fps:g} was asked, the device promises {fps:g}"
        return ControlReport(name="fps", requested=profile.fps, read_back=fps, note=note)

    def _timing_warnings(
        self, profile: CameraProfile, controls: tuple[ControlReport, ...]
    ) -> tuple[str, ...]:
        fps, warnings = self.format.fps, []
        report = self._rate_report(profile)
        if report.note and report.read_back is not None:
            warnings.append(f"fps: {report.note}.")
        size = (self.format.width, self.format.height)
        if self._choice is not None and size != (self._choice.mode.width, self._choice.mode.height):
            warnings.append(f"The driver gives pictures of {size[0]} x {size[1]} instead of what was asked.")
        exposure_s = next((one.read_back for one in controls if one.name == "exposure_s"), None)
        if fps and exposure_s and exposure_s > 1.01 / fps:
            warnings.append(
                f"exposure_s is {exposure_s:g}, longer than the {1 / fps:.4g} s from frame to frame: the "
                "camera will be slower, or expose for less."
            )
        return tuple(warnings)

    def _stamp_at(self) -> str:
        if self._first is None:
            return "unknown"
        if not self._first.monotonic:
            return "arrival"
        return "start of exposure" if self._first.stamped_at_start else "end of frame"


def _size(mode: Mode) -> tuple[int, int]:
    return mode.width, mode.height


def _differ(choice: Choice, other: Choice) -> bool:
    ours, theirs = choice.mode, other.mode
    return (ours.pixel_format, ours.width, ours.height, choice.fps) != (
        theirs.pixel_format,
        theirs.width,
        theirs.height,
        other.fps,
    )


def _lesser(modes: tuple[Mode, ...], mode: Mode) -> tuple[Mode, ...]:
    """The modes that need less of the bus: other formats, and smaller pictures of this one."""
    return tuple(
        one
        for one in modes
        if one.pixel_format != mode.pixel_format or one.width * one.height < mode.width * mode.height
    )
