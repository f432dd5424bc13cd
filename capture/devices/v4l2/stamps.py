"""When a frame was: the driver's stamps, with those put right that cannot be.

Drivers that compute stamps from the camera's own clock sometimes give one that is not later than the one
before, or one that lies in the future. Such a frame is neither dropped nor passed on with a time that cannot
be: it gets the time that the frames before it and the count promise, and says so.
"""

from __future__ import annotations

from capture.devices.v4l2.stream import RawFrame

#: A stamp may be this much later than the arrival by the same clock: the driver's own estimate of it.
_AHEAD_S = 0.002
#: Frame interval until two frames have shown it.
_UNKNOWN_INTERVAL_S = 1 / 30
#: Share of a new interval in the running mean.
_NEW = 0.1


class Stamps:
    """The times of one stream's frames, in order."""

    def __init__(self, interval_s: float | None) -> None:
        """Knows the interval that the driver promises, if it does."""
        self._interval_s = interval_s or _UNKNOWN_INTERVAL_S
        self._last: tuple[float, int] | None = None

    def time_s(self, frame: RawFrame) -> tuple[float, bool]:
        """(seconds, whether it is estimated), later than every frame's before.

        A driver that gives no monotonic stamps has the time of arrival instead, which is no estimate: the
        camera's info says so.
        """
        stamp_s = frame.stamp_s if frame.monotonic else frame.arrival_s
        estimated = False
        if self._last is not None:
            last_s, last_sequence = self._last
            steps = max(1, frame.sequence - last_sequence)
            promised_s = last_s + steps * self._interval_s
            if not stamp_s > last_s or stamp_s > frame.arrival_s + _AHEAD_S:
                # Not beyond now, or the next sound stamp would be earlier in its turn.
                latest_s = max(frame.arrival_s, last_s + 0.1 * self._interval_s)
                stamp_s, estimated = min(promised_s, latest_s), True
            else:
                measured_s = (stamp_s - last_s) / steps
                self._interval_s += _NEW * (min(measured_s, 2 * self._interval_s) - self._interval_s)
        elif frame.monotonic and not 0 < stamp_s <= frame.arrival_s + _AHEAD_S:
            stamp_s, estimated = frame.arrival_s, True
        self._last = (stamp_s, frame.sequence)
        return stamp_s, estimated
