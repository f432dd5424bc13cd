"""Frames out of a `cv2.VideoCapture`: with a timeout, in order, counted as far as their stamps allow.

OpenCV's `read` waits as long as its back end likes (ten seconds in V4L2), so a thread does the waiting. It
has no sequence numbers either: frames are counted here, and more time than usual between two stamps is a gap.
"""

from __future__ import annotations

import statistics
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as FutureTimeoutError
from contextlib import suppress
from typing import Any, Protocol, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from capture.devices.bench import Bench
from capture.devices.camera import CapturedFrame
from capture.devices.opencv_controls import Properties
from capture.errors import CameraEndedError, CameraError, CameraGoneError, CameraTimeoutError

T = TypeVar("T")
_HANGING_S = 10.0  # V4L2 gives up after as long
_RETRY_S = 0.05
_GAP = 1.5  # usual intervals between two stamps from which on a frame is missing
_KNOWN_AFTER = 5  # intervals, before what is usual is known


class Capture(Properties, Protocol):
    """The part of `cv2.VideoCapture` that is used."""

    def read(self) -> tuple[bool, Any]:
        """Waits for a frame: (True, BGR picture) or (False, None)."""

    def release(self) -> None:
        """Lets go."""

    def isOpened(self) -> bool:
        """Whether there is anything to read from."""

    def getBackendName(self) -> str:
        """ "V4L2", "DSHOW", "MSMF", "AVFOUNDATION", "FFMPEG", ..."""


class FrameReader:
    """The frames of a capture.

    Attributes:
        stamped: Whether frames carry the stamps of OpenCV; else the times of their arrival, by which no gap
            can be found.
        ended: Whether a file has no further frame.
    """

    def __init__(self, url: str, capture: Capture, bench: Bench, *, is_file: bool, stamped: bool) -> None:
        """Starts a thread that does nothing until a frame is asked for."""
        self.stamped = stamped
        self.ended = False
        self._url = url
        self._capture = capture
        self._bench = bench
        self._is_file = is_file
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="opencv")
        self._pending: Future[tuple[NDArray[Any] | None, float, float]] | None = None
        self._sequence = -1
        self._last_s: float | None = None
        self._intervals_s: deque[float] = deque(maxlen=31)

    @property
    def waiting(self) -> bool:
        """Whether the thread still waits for a frame that came too late for a timeout."""
        return self._pending is not None

    def restart(self) -> None:
        """Forgets how the frames came, because the stream starts anew."""
        self._last_s = None
        self._intervals_s.clear()

    def next(self, timeout_s: float) -> CapturedFrame:
        """The next frame.

        Raises:
            CameraTimeoutError: None came in time; the next call goes on waiting for it.
            CameraEndedError: The file is over (`ended`).
            CameraGoneError: The camera stopped.
        """
        while True:
            picture, stamp_s, arrival_s = self._take(timeout_s)
            if picture is None:
                if self._is_file:
                    self.ended = True
                    raise CameraEndedError(f"{self._url} has ended; its last frame has been read.")
                raise CameraGoneError(
                    f"{self._url} gives no frames any more; it was unplugged, or another program took it."
                )
            usual_s = self._usual_interval_s()
            estimated = False
            if not self.stamped:
                stamp_s = arrival_s
            elif self._last_s is not None and stamp_s <= self._last_s:
                if usual_s is None:
                    continue  # nothing is known of its time: left out
                stamp_s, estimated = self._last_s + usual_s, True
            self._count(stamp_s, usual_s)
            return CapturedFrame(
                stamp_s=stamp_s,
                sequence=self._sequence,
                data=_as_rgb(picture, self._url),
                arrival_s=arrival_s,
                stamp_estimated=estimated,
            )

    def _take(self, timeout_s: float) -> tuple[NDArray[Any] | None, float, float]:
        if self._pending is None:
            self._pending = self._thread.submit(self._grab)
        try:
            taken = self._pending.result(timeout_s)
        except FutureTimeoutError as error:
            raise CameraTimeoutError(
                f"{self._url} gave no frame within {timeout_s:g} s; another program may use the camera."
            ) from error
        except cv2.error as error:
            self._pending = None
            raise CameraError(f"OpenCV failed to read from {self._url}: {error.err}.") from error
        self._pending = None
        return taken

    def _grab(self) -> tuple[NDArray[Any] | None, float, float]:
        """(picture or None, its stamp, its arrival); in the thread. A camera is forgiven one failure."""
        for last in (self._is_file, True):
            ok, picture = self._capture.read()
            if ok and picture is not None:
                return picture, self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1e3, self._bench.clock.now_s()
            if last:
                break
            self._bench.clock.sleep(_RETRY_S)
        return None, 0.0, 0.0

    def _usual_interval_s(self) -> float | None:
        """Between frames, measured: in a dim room a camera need not keep to the rate that it promises."""
        return statistics.median(self._intervals_s) if len(self._intervals_s) >= _KNOWN_AFTER else None

    def _count(self, stamp_s: float, usual_s: float | None) -> None:
        """Counts a frame, and those that are missing before it."""
        step = 1
        if self._last_s is not None:
            passed_s = stamp_s - self._last_s
            if self.stamped and usual_s is not None and passed_s > _GAP * usual_s:
                step = round(passed_s / usual_s)
            self._intervals_s.append(passed_s / step)
        self._sequence += step
        self._last_s = stamp_s

    def run(self, work: Callable[[], T]) -> T:
        """Does something with the capture in the thread, which OpenCV does not let two do at once.

        Raises:
            CameraTimeoutError: The thread hangs in OpenCV.
        """
        try:
            return self._thread.submit(work).result(_HANGING_S)
        except FutureTimeoutError as error:
            raise CameraTimeoutError(
                f"OpenCV hangs with {self._url}, waiting for a frame; unplug the camera and plug it in again."
            ) from error

    def close(self) -> None:
        """Releases the capture; one that hangs in its driver, when that gives up."""
        released = self._thread.submit(self._capture.release)
        self._thread.shutdown(wait=False)
        with suppress(FutureTimeoutError, cv2.error):
            released.result(_HANGING_S)


def _as_rgb(picture: NDArray[Any], url: str) -> NDArray[Any]:
    if picture.ndim == 2:
        return np.asarray(cv2.cvtColor(picture, cv2.COLOR_GRAY2RGB))
    if picture.ndim == 3 and picture.shape[2] in (3, 4) and picture.dtype in (np.uint8, np.uint16):
        code = cv2.COLOR_BGR2RGB if picture.shape[2] == 3 else cv2.COLOR_BGRA2RGB
        return np.asarray(cv2.cvtColor(picture, code))
    raise CameraError(
        f"{url} gives frames of shape {list(picture.shape)} and {picture.dtype}, not pictures; ask for "
        "another pixel format."
    )
