"""EVENTs as edges in host time, each with the number of its flash within the train that was asked for.

The firmware counts flashes from its start; a train counts from 0, and a flash that the device left out is a
number that is missing. So the number is told by the device's clock: flash k begins at t0 + k period, exactly.
"""

from __future__ import annotations

from collections import deque

from capture.devices.firmware_flash.device_clock import DeviceClock
from capture.devices.flash import FlashEdge
from firmware_protocol import Event, Train
from firmware_protocol.messages import Edge

_HALF = 1 << 63
_WRAP = 1 << 64


class EdgeLog:
    """Turns EVENTs into edges, once each.

    Attributes:
        missing: Edges that happened and whose EVENT never came.
        strange: Edges that belong to no train.
    """

    def __init__(self) -> None:
        """Begins at any edge."""
        self.missing = self.strange = 0
        self._trains: deque[tuple[Train, int]] = deque(maxlen=4)
        self._last: int | None = None

    def begin(self, train: Train, tick_hz: int, pulses: int) -> None:
        """A train has been accepted.

        Args:
            train: As it was sent.
            tick_hz: Of the device's clock.
            pulses: How many flashes the device had begun since its start when it accepted it.
        """
        self._trains.appendleft((train, tick_hz))
        if self._last is None:
            self._last = 2 * pulses

    def reset(self) -> None:
        """The device has restarted: no train, another count."""
        self._trains.clear()
        self._last = None

    def edge(self, event: Event, clock: DeviceClock) -> FlashEdge | None:
        """The edge of an EVENT; None for one that has come before or belongs to no train."""
        order = 2 * event.pulse - (event.edge == Edge.ON)  # 1 on, 2 off, 3 on, ...: each edge one more
        if self._last is not None:
            if order <= self._last:
                return None
            self.missing += order - self._last - 1
        self._last = order
        for train, tick_hz in self._trains:
            into = (event.tick - train.t0_tick + _HALF) % _WRAP - _HALF
            if into >= 0:
                time_s, sigma_s = clock.fit.host_s(event.tick)
                return FlashEdge(
                    time_s=time_s,
                    sigma_s=sigma_s,
                    on=event.edge == Edge.ON,
                    pulse=min(into * 1_000_000 // (train.period_us * tick_hz), train.count - 1),
                )
        self.strange += 1
        return None
