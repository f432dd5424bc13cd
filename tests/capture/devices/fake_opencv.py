"""A `cv2.VideoCapture` that lies as the real ones do, over a grey wall that its exposure makes bright.

    set() says True whatever happens; values are clamped in silence, and a gain under automatic has no effect
    MSMF's get() gives defaults; DSHOW has no stamps, and whole powers of two for an exposure

It does not model: formats (any size is taken), buffers of frames, the time that opening takes.
"""

from __future__ import annotations

import threading
from typing import Any

import cv2
import numpy as np

from capture.devices.bench import Bench
from capture.transfer import to_display

WIDTH, HEIGHT = 32, 24
#: By back end: the exposure's unit in seconds is 100 us or a power of two.
_AUTOMATIC = {"V4L2": 3.0, "DSHOW": 1.0, "MSMF": 1.0}


class LyingCapture:
    """30 frames a second of the bench's time.

    Attributes:
        lost: numbers of frames that never come.
        repeated: numbers of frames with the stamp of the one before.
        unplugged: no frame comes any more.
        hangs: an event that `read` waits for, when set to one.
        settings: every (property, value) that was set.
    """

    def __init__(
        self, bench: Bench, back_end: str = "V4L2", colour: tuple[int, int, int] | None = None
    ) -> None:
        self.back_end = back_end
        self.lost: set[int] = set()
        self.repeated: set[int] = set()
        self.unplugged = False
        self.released = False
        self.hangs: threading.Event | None = None
        self.deaf: set[int] = set()
        self.settings: list[tuple[int, float]] = []
        self.values: dict[int, float] = {
            cv2.CAP_PROP_FPS: 30.0,
            cv2.CAP_PROP_AUTO_EXPOSURE: _AUTOMATIC.get(back_end, 0.0),
            cv2.CAP_PROP_EXPOSURE: 333.0 if back_end == "V4L2" else -5.0,
            cv2.CAP_PROP_GAIN: 64.0,
            cv2.CAP_PROP_AUTO_WB: 1.0,
            cv2.CAP_PROP_WB_TEMPERATURE: 4600.0,
            cv2.CAP_PROP_WHITE_BALANCE_BLUE_U: 4600.0,
            cv2.CAP_PROP_AUTOFOCUS: 1.0,
            cv2.CAP_PROP_FOCUS: 30.0,
        }
        self.ranges: dict[int, tuple[float, float]] = {
            cv2.CAP_PROP_GAIN: (0, 255),
            cv2.CAP_PROP_WB_TEMPERATURE: (2000, 6500),
            cv2.CAP_PROP_EXPOSURE: (3, 2047) if back_end == "V4L2" else (-11, -2),
        }
        self._bench = bench
        self._colour = colour
        self._number = -1
        self._stamp_ms = 0.0
        self._pipeline: list[float] = []

    def isOpened(self) -> bool:
        return not self.released

    def getBackendName(self) -> str:
        return self.back_end

    def get(self, prop: int) -> float:
        if prop == cv2.CAP_PROP_POS_MSEC:
            return -1.0 if self.back_end == "DSHOW" else self._stamp_ms
        if self.back_end == "MSMF" and prop in (cv2.CAP_PROP_EXPOSURE, cv2.CAP_PROP_GAIN):
            return -6.0
        return self.values.get(prop, -1.0)

    def set(self, prop: int, value: float) -> bool:
        self.settings.append((prop, value))
        if prop in self.deaf:
            return True
        if self.back_end == "MSMF" and prop == cv2.CAP_PROP_AUTO_EXPOSURE and value == 0:
            self.values[cv2.CAP_PROP_EXPOSURE] = 0.0
        if prop == cv2.CAP_PROP_EXPOSURE:
            if self.back_end == "MSMF":
                self.values[cv2.CAP_PROP_AUTO_EXPOSURE] = 0.0
            elif self._automatic():
                return True
        low, high = self.ranges.get(prop, (-np.inf, np.inf))
        self.values[prop] = float(min(max(value, low), high))
        return True

    def _automatic(self) -> bool:
        return self.values[cv2.CAP_PROP_AUTO_EXPOSURE] == _AUTOMATIC.get(self.back_end)

    def exposure_s(self) -> float:
        value = self.values[cv2.CAP_PROP_EXPOSURE]
        if self._automatic():
            return 0.0333
        return value / 1e4 if self.back_end == "V4L2" else float(2.0**value)

    def read(self) -> tuple[bool, Any]:
        if self.hangs is not None:
            self.hangs.wait(10)
        if self.unplugged or self.released:
            return False, None
        self._number += 1
        while self._number in self.lost:
            self._number += 1
            self._bench.clock.sleep(1 / 30)
        self._bench.clock.sleep(1 / 30)
        if self._number not in self.repeated:
            self._stamp_ms = 1e3 * self._bench.clock.now_s()
        self._pipeline.append(self.exposure_s())
        exposure_s = self._pipeline[max(0, len(self._pipeline) - 3)]  # shows two frames later
        picture = np.empty((HEIGHT, WIDTH, 3), np.uint8)
        picture[:] = self._colour or np.rint(255 * to_display(min(1.0, 20 * exposure_s), "srgb"))
        return True, picture

    def release(self) -> None:
        self.released = True
