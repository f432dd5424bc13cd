"""The frames' time axis: seconds from the session's first frame, and where a moment of the host's clock lies.

A camera that stamps with the host's monotonic clock needs a shift only. Of one with a clock of its own, the
frames' arrivals tell the rest: no frame arrives before it is taken, and some are hardly held up, so the
least difference of arrival and stamp over the last seconds is the offset, up to a constant. That constant,
like the stamp's place within the frame and the lamp's latency, is found from the light itself when the
frames are tagged.
"""

from __future__ import annotations

from collections import deque

from capture.devices.camera import CapturedFrame

#: Break of unknown length between a killed capture and its continuation, as it is written down; longer than
#: the longest period of a flash, so that no rhythm is looked for across it.
RESUMED_AFTER_S = 3.0
_WINDOW_S = 10.0
_LEAST_STEP_S = 1e-4


class TimeAxis:
    """Times of frames and of the flash."""

    def __init__(self, clock: str, interval_s: float, begin_s: float = 0.0) -> None:
        """Of a camera whose `CameraInfo.clock` this is.

        Args:
            clock: "monotonic" or "own".
            interval_s: Usual time from frame to frame.
            begin_s: Where the first frame lies: 0, or behind what a session has already.
        """
        self._own = clock != "monotonic"
        self._interval_s, self._begin_s = interval_s, begin_s
        self._zero_s: float | None = None
        self._last_s = float("-inf")
        self._last_sequence = 0
        self._lags: deque[tuple[float, float]] = deque()  # (arrival, arrival - stamp), lags rising

    def pts_s(self, frame: CapturedFrame) -> tuple[float, bool]:
        """The frame's time, later than the one before in any case, and whether its stamp could be used."""
        if self._zero_s is None:
            self._zero_s = frame.stamp_s - self._begin_s
            self._last_s = self._begin_s - self._interval_s
            self._last_sequence = frame.sequence - 1
        pts_s = frame.stamp_s - self._zero_s
        sound = pts_s > self._last_s + _LEAST_STEP_S
        if not sound:
            pts_s = self._last_s + self._interval_s * max(1, frame.sequence - self._last_sequence)
        elif self._own:
            self._remember_lag(frame)
        self._last_s, self._last_sequence = pts_s, frame.sequence
        return pts_s, sound

    def from_host(self, host_s: float) -> float | None:
        """The axis's time of a moment of the host's clock; None before the first frame."""
        if self._zero_s is None:
            return None
        lag_s = self._lags[0][1] if self._lags else 0.0
        return host_s - lag_s - self._zero_s

    def _remember_lag(self, frame: CapturedFrame) -> None:
        lag_s = frame.arrival_s - frame.stamp_s
        while self._lags and self._lags[-1][1] >= lag_s:
            self._lags.pop()
        self._lags.append((frame.arrival_s, lag_s))
        while self._lags[0][0] < frame.arrival_s - _WINDOW_S:
            self._lags.popleft()
