"""A camera through OpenCV, the last resort on any system: `opencv:0`, `opencv:0;backend=dshow`.

    backend=NAME     v4l2, dshow, msmf, avfoundation, ...; default by system (V4L2, DirectShow, AVFoundation)
    controls=leave   sets no control, for a stream whose controls are set by another way

What OpenCV cannot tell: no sequence number (frames are counted here, and gaps are found from the stamps where
the back end has stamps), no flag of a damaged frame, not whether a control took effect (`opencv_controls`).
The light decides. A file (`opencv:film.mp4`) is played as a camera, for trying things out; `replay:` reads
one by its own colour tags, OpenCV takes every video for BT.601.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import cv2
import numpy as np

from capture.devices.bench import Bench
from capture.devices.camera import (
    CameraInfo,
    CameraProfile,
    CapturedFrame,
    ControlReport,
    LockReport,
    StreamFormat,
)
from capture.devices.light_check import LightCheck, skip_latency, verify_exposure
from capture.devices.opencv_controls import OpenCvControls
from capture.devices.opencv_reader import Capture, FrameReader
from capture.devices.url_options import parse_options
from capture.errors import CameraError, CameraGoneError, CameraTimeoutError

_DEFAULT_BACKENDS = {"linux": "v4l2", "win32": "dshow", "darwin": "avfoundation"}
_STAMPED = frozenset({"V4L2", "MSMF", "AVFOUNDATION", "FFMPEG", "GSTREAMER"})  # POS_MSEC is the frame's own
_PROBED = 4  # indices that `list_cameras` tries
_START_TIMEOUT_S, _FRAME_TIMEOUT_S = 10.0, 5.0


class OpenCvCamera:
    """A `cv2.VideoCapture` as a camera."""

    def __init__(
        self, url: str, capture: Capture, bench: Bench, *, is_file: bool = False, set_controls: bool = True
    ) -> None:
        """Takes over the capture, and releases it.

        Args:
            url: That opens it.
            capture: Opened.
            bench: Its clock stamps the arrivals.
            is_file: Its end is no failure, and none of its frames is dropped to settle.
            set_controls: Whether `lock` touches exposure, gain and the like.
        """
        self._capture = capture
        self._is_file = is_file
        self._back_end = capture.getBackendName()
        self._controls = OpenCvControls(capture, self._back_end) if set_controls else None
        self._url = url
        self._reader = FrameReader(url, capture, bench, is_file=is_file, stamped=self._back_end in _STAMPED)
        self._format: StreamFormat | None = None
        self._asked: tuple[Any, ...] | None = None
        self._verdict: tuple[float, LightCheck] | None = None
        self._ahead: CapturedFrame | None = None
        self._closed = False

    @property
    def ended(self) -> bool:
        """Of a file: whether `read` has found no further frame, which it says with `CameraEndedError`."""
        return self._reader.ended

    @property
    def info(self) -> CameraInfo:
        """What OpenCV says, which is little; after `lock` also whether its stamps can be used."""
        own = self._reader.stamped and self._back_end != "V4L2"  # V4L2 stamps with the host's CLOCK_MONOTONIC
        return CameraInfo(
            url=self._url,
            name=f"{self._url} ({self._back_end})",
            back_end="opencv",
            details={"opencv_backend": self._back_end, "opencv": cv2.__version__},
            clock="own" if own else "monotonic",
            stamp_at="unknown" if self._reader.stamped else "arrival",
        )

    @property
    def format(self) -> StreamFormat:
        """What the frames are like; known after `lock`."""
        if self._format is None:
            raise CameraError(f"The format of {self._url} is known once it is locked; lock it first.")
        return self._format

    def lock(self, profile: CameraProfile) -> LockReport:
        """Sets the format, looks at some frames, then sets the controls.

        Raises:
            CameraError: No frame comes.
        """
        self._require_open()
        asked = (profile.width, profile.height, profile.fps, profile.pixel_format)
        warnings: list[str] = []
        fresh = self._format is None or (asked != self._asked and not self._is_file)
        if fresh:
            self._start(profile)
            self._asked = asked
        stream = self.format
        if profile.width is not None and (profile.width, profile.height) != (stream.width, stream.height):
            warnings.append(
                f"Asked for {profile.width} x {profile.height}, but {self._url} delivers {stream.width} x "
                f"{stream.height}; ask for a size that it has."
            )
        reports = [self._fps_report(profile)]
        if self._controls is not None:
            reports += self._controls.lock(profile, fresh)
            warnings += [f"{report.name}: {report.note}." for report in reports if report.note]
            warnings += self._check_light(self._controls, reports)
        if not self._reader.stamped:
            warnings.append(
                f"OpenCV gives no time stamps through {self._back_end}; the times of arrival are used, by "
                "which lost frames cannot be found."
            )
        return LockReport(controls=tuple(reports), warnings=tuple(warnings))

    def _check_light(self, controls: OpenCvControls, reports: list[ControlReport]) -> list[str]:
        """Puts the light's verdict into the report of an exposure that is new; gives warnings."""
        place = next((at for at, report in enumerate(reports) if report.name == "exposure_s"), None)
        if place is None or not controls.sets_exposure:
            return []
        report = reports[place]
        exposure_s = report.requested if report.read_back is None else report.read_back
        if exposure_s is None or exposure_s <= 0:
            return []
        if self._verdict is None or self._verdict[0] != exposure_s:

            def frame() -> CapturedFrame:
                return self._reader.next(_FRAME_TIMEOUT_S)

            check = verify_exposure(frame, lambda: self.format, controls.set_exposure, exposure_s)
            skip_latency(frame)
            self._verdict = (exposure_s, check)
        check = self._verdict[1]
        note = "; ".join(filter(None, (report.note, check.note)))
        reports[place] = replace(report, verified=check.verified, note=note)
        return [] if check.verified else [f"exposure_s: {check.note}."]

    def _start(self, profile: CameraProfile) -> None:
        capture = self._capture
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
        if profile.pixel_format is not None:
            code = cv2.VideoWriter.fourcc(*profile.pixel_format.ljust(4)[:4])
            capture.set(cv2.CAP_PROP_FOURCC, code)
        if profile.width is not None and profile.height is not None:
            capture.set(cv2.CAP_PROP_FRAME_WIDTH, profile.width)
            capture.set(cv2.CAP_PROP_FRAME_HEIGHT, profile.height)
        if profile.fps is not None:
            capture.set(cv2.CAP_PROP_FPS, profile.fps)
        capture.set(cv2.CAP_PROP_CONVERT_RGB, 1)
        self._ahead = self._verdict = None
        self._reader.restart()
        fps = capture.get(cv2.CAP_PROP_FPS)
        stamps = []
        for _ in range(1 if self._is_file else max(2, profile.settle_frames)):
            frame = self._reader.next(_START_TIMEOUT_S)
            stamps.append(frame.stamp_s)
        if self._is_file:
            self._ahead = frame
        elif self._reader.stamped and not all(late > early for early, late in pairwise(stamps)):
            self._reader.stamped = False
            self._reader.restart()
        height, width = np.shape(frame.data)[:2]
        self._format = StreamFormat(
            width=width, height=height, pixel_format="RGB3", fps=float(fps) if fps > 0 else None
        )

    def _fps_report(self, profile: CameraProfile) -> ControlReport:
        fps = self.format.fps
        note = ""
        if profile.fps is not None and (fps is None or abs(fps - profile.fps) > 0.01 * profile.fps):
            note = "OpenCV does not tell it" if fps is None else f"OpenCV says {fps:g}"
        return ControlReport(name="fps", requested=profile.fps, read_back=fps, note=note)

    def read(self, timeout_s: float) -> CapturedFrame:
        """The next frame.

        Raises:
            CameraTimeoutError: None came in time; the next call goes on waiting for it.
            CameraEndedError: The file is over (`ended`).
            CameraGoneError: The camera stopped, or it is closed.
        """
        self._require_open()
        if self._format is None:
            raise CameraError(f"{self._url} does not stream yet; lock it first.")
        if self._ahead is not None:
            frame, self._ahead = self._ahead, None
            return frame
        return self._reader.next(timeout_s)

    def check(self) -> tuple[ControlReport, ...]:
        """What OpenCV says of the controls, for what it is worth."""
        self._require_open()
        if self._controls is None or self._reader.waiting:  # OpenCV does not let two at a capture
            return ()
        return self._controls.check()

    def restore(self) -> tuple[str, ...]:
        """Puts the controls back."""
        if self._closed or self._controls is None:
            return ()
        try:
            return self._reader.run(self._controls.restore)
        except CameraTimeoutError as error:
            return (f"The controls could not be put back: {error}",)

    def close(self) -> None:
        """Releases the camera; when OpenCV still waits for a frame, as soon as it has given up."""
        if not self._closed:
            self._closed = True
            self._reader.close()

    def _require_open(self) -> None:
        if self._closed:
            raise CameraGoneError(f"{self._url} is closed; open it again to use it.")

    def __enter__(self) -> Self:
        """Itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Closes it."""
        self.close()


def open_camera(rest: str, bench: Bench) -> OpenCvCamera:
    """The camera of `INDEX;backend=...;controls=leave`, or a file.

    Raises:
        CameraError: It cannot be opened, or a setting is not understood.
    """
    url = f"opencv:{rest}"
    target, _, text = rest.partition(";")
    settings = parse_options(text, {"backend": str, "controls": str}, CameraError, scheme="opencv")
    if settings.get("controls", "leave") != "leave":
        raise CameraError(f"controls={settings['controls']} of {url} is not understood; it is leave.")
    is_file = not target.isdecimal()
    if is_file and not Path(target).is_file():
        raise CameraError(f"{url} names no camera; give the number of one, from 0 on, or a video file.")
    default = "any" if is_file else _DEFAULT_BACKENDS.get(sys.platform, "any")
    capture = _open(target if is_file else int(target), settings.get("backend", default), url)
    if not capture.isOpened():
        capture.release()
        raise CameraError(
            f"OpenCV cannot open {url}; plug the camera in, close other programs that use it, allow this "
            "one to use the camera, or try another number."
        )
    return OpenCvCamera(url, capture, bench, is_file=is_file, set_controls="controls" not in settings)


def list_cameras() -> tuple[str, ...]:
    """Cameras by trying numbers, which switches them on for a moment; none on Linux, where V4L2 has them."""
    if sys.platform.startswith("linux"):
        return ()
    urls = []
    for index in range(_PROBED):
        try:
            open_camera(str(index), Bench()).close()
        except CameraError:
            break
        urls.append(f"opencv:{index}")
    return tuple(urls)


def _open(target: int | str, backend: str, url: str) -> Any:
    known = {
        cv2.videoio_registry.getBackendName(code).lower(): code for code in cv2.videoio_registry.getBackends()
    }
    if backend != "any" and backend not in known:
        raise CameraError(
            f"backend={backend} of {url} is not in this OpenCV; it has {', '.join(sorted(known))}."
        )
    log = cv2.utils.logging
    level = log.getLogLevel()
    log.setLogLevel(log.LOG_LEVEL_SILENT)  # it prints a complaint for each way that it tries
    try:
        return cv2.VideoCapture(target, known.get(backend, cv2.CAP_ANY))
    finally:
        log.setLogLevel(level)
