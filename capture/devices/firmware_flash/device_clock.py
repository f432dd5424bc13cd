"""The device's clock in host time, from PING and PONG (PROTOCOL.md: four stamps of a round trip).

The host stamps before it writes a PING and after it has read the PONG; the device stamps when the PING's
last byte has arrived and when the PONG's first leaves. On a UART the bytes themselves take longer than
everything else, and not the same both ways (16 there, 36 back): that much is known and is taken off. Whether
a line has that pace is told by the quickest round trip: a pseudo-terminal, a network or a native USB port is
quicker than any UART could be.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

from capture.clock_fit import ClockFit
from firmware_protocol import Ping, Pong
from firmware_protocol.limits import CRC_BYTES, HEADER_BYTES

_FRAMING_BYTES = HEADER_BYTES + CRC_BYTES + 2  # and the code byte and delimiter of COBS
_PING_BYTES = Ping.payload_bytes() + _FRAMING_BYTES
_PONG_BYTES = Pong.payload_bytes() + _FRAMING_BYTES
#: UARTs run up to so much faster than they say (an ATmega at 16 MHz: 117,647 for 115,200 baud).
_QUICKER = 0.97
_WRAP = 1 << 64


@dataclass(frozen=True)
class _RoundTrip:
    t2_tick: int
    busy_s: float
    before_s: float
    after_s: float

    @property
    def seconds(self) -> float:
        return max(0.0, self.after_s - self.before_s - self.busy_s)


class DeviceClock:
    """A clock fit that is fed with PONGs.

    Attributes:
        round_trips_s: The last ones, without the time that the device took, seconds.
    """

    def __init__(self, tick_hz: int, seconds_per_byte: float) -> None:
        """Knows nothing yet.

        Args:
            tick_hz: Of the device's clock, as its HELLO says.
            seconds_per_byte: Pace of the line if it is a UART (`ByteTransport.seconds_per_byte`).
        """
        self.tick_hz = tick_hz
        self.fit = ClockFit(tick_hz)
        self.round_trips_s: deque[float] = deque(maxlen=4096)
        self._byte_s = _QUICKER * seconds_per_byte
        self._recent: deque[_RoundTrip] = deque(maxlen=64)
        self._paced = self._byte_s > 0

    @property
    def paced(self) -> bool:
        """Whether the line has the pace of a UART, as far as can be told."""
        return self._paced

    def add(self, pong: Pong, before_s: float, after_s: float) -> None:
        """Takes the answer to a PING that was sent once, after `before_s`, and had been read by `after_s`."""
        trip = _RoundTrip(
            pong.t2_tick,
            ((pong.t3_tick - pong.t2_tick) % _WRAP) / self.tick_hz,
            before_s,
            after_s,
        )
        self.round_trips_s.append(trip.seconds)
        self._recent.append(trip)
        if self._paced and trip.seconds < (_PING_BYTES + _PONG_BYTES) * self._byte_s:
            self._paced = False
            self.fit = ClockFit(self.tick_hz)
            for each in self._recent:
                self._give(each)
        else:
            self._give(trip)

    def _give(self, trip: _RoundTrip) -> None:
        byte_s = self._byte_s if self._paced else 0.0
        before_s = trip.before_s + _PING_BYTES * byte_s
        after_s = trip.after_s - _PONG_BYTES * byte_s - trip.busy_s
        # A device that was busy for longer than the round trip took has a clock that runs fast: within 0.5 %.
        self.fit.add(trip.t2_tick, min(before_s, after_s), max(before_s, after_s))

    def report(self) -> dict[str, Any]:
        """Plain values for session.json."""
        ordered = sorted(self.round_trips_s)
        return {
            "round_trip_min_s": ordered[0] if ordered else None,
            "round_trip_p50_s": ordered[len(ordered) // 2] if ordered else None,
            "round_trip_p99_s": ordered[min(len(ordered) - 1, len(ordered) * 99 // 100)] if ordered else None,
            "uart_pace": self.paced,
            "clock": self.fit.report(),
        }
