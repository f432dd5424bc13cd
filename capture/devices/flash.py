"""What a flash is to the controller: told a pulse train, asked for the edges that happened, always put out.

with open_flash(url, bench) as flash:
    flash.start(PulseTrain(start_s=clock.now_s() + 0.5, period_s=1.0, on_s=0.1, count=20))
    edges = flash.poll()
    flash.off()
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from types import TracebackType
from typing import Any, Protocol, Self

#: Hard limits of every flash, ours or bought; firmware_protocol/PROTOCOL.md says why.
LONGEST_ON_S = 0.25
SHORTEST_PERIOD_S = 0.333334
#: In one train.
MOST_PULSES = 65535


@dataclass(frozen=True, kw_only=True)
class PulseTrain:
    """Flashes to be made: on at `start_s` + k `period_s`, off `on_s` later.

    Attributes:
        start_s: Of the first, host clock.
        period_s: From one start to the next.
        on_s: Length of each.
        count: How many, 1..65535.
        level: 0 (exclusive) .. 1 (full).
    """

    start_s: float
    period_s: float = 1.0
    on_s: float = 0.1
    count: int = 20
    level: float = 1.0

    def __post_init__(self) -> None:
        """Holds the limits of safety."""
        if not math.isfinite(self.start_s):
            raise ValueError(f"start_s is {self.start_s}, not a time")
        if not SHORTEST_PERIOD_S <= self.period_s < math.inf:
            raise ValueError(
                f"period_s is {self.period_s}; a light may not flash more often than three times a second "
                f"({SHORTEST_PERIOD_S} s)"
            )
        if not 0 < self.on_s <= LONGEST_ON_S or not self.on_s < self.period_s:
            raise ValueError(
                f"on_s is {self.on_s}; a flash lasts at most {LONGEST_ON_S} s and less than its period"
            )
        if not 1 <= self.count <= MOST_PULSES:
            raise ValueError(f"count is {self.count}, not 1..{MOST_PULSES}")
        if not 0 < self.level <= 1:
            raise ValueError(f"level is {self.level}, not above 0 and at most 1")

    @property
    def end_s(self) -> float:
        """When the last flash ends."""
        return self.start_s + (self.count - 1) * self.period_s + self.on_s


@dataclass(frozen=True, kw_only=True)
class FlashCapabilities:
    """What a flash can do, as its back end knows it.

    Attributes:
        own_schedule: Runs a train by its own clock; otherwise the host switches each edge in time.
        watchdog: Goes out by itself when the host dies.
        shortest_on_s: Shorter flashes cannot be told.
        longest_on_s: Longer ones are refused.
        shortest_period_s: Between starts.
        latency_s: From the command to the light, an estimate; None = not known.
        jitter_s: Its standard deviation, an estimate; None = not known.
        dimmable: Has levels between off and full.
        feedback: Edges are measured at the light, not at the command.
    """

    own_schedule: bool
    watchdog: bool
    shortest_on_s: float
    longest_on_s: float = LONGEST_ON_S
    shortest_period_s: float = SHORTEST_PERIOD_S
    latency_s: float | None = None
    jitter_s: float | None = None
    dimmable: bool = False
    feedback: bool = False

    def to_json(self) -> dict[str, Any]:
        """For session.json."""
        return asdict(self)


@dataclass(frozen=True, kw_only=True)
class FlashInfo:
    """What a flash says of itself.

    Attributes:
        url: That opens it.
        name: For a person.
        back_end: "serial", "hid-firmware", "litra", "hidrelay", "blink1", "manual", "sim", ...
        details: Firmware, serial number, port: plain values for session.json.
    """

    url: str
    name: str
    back_end: str
    details: Mapping[str, Any]


@dataclass(frozen=True, kw_only=True)
class FlashEdge:
    """The light went on or off.

    Attributes:
        time_s: Host clock.
        sigma_s: Standard deviation of that, without the lamp's constant latency.
        on: Which way.
        pulse: Number of the flash within the train, from 0.
    """

    time_s: float
    sigma_s: float
    on: bool
    pulse: int


class FlashDevice(Protocol):
    """A flash. Opening it leaves it dark; a context manager that turns it off and closes it.

    Threads of a back end never raise into nowhere: what went wrong comes out of the next `poll`.

    Every method but `off` and `close` may raise `FlashError` and its kinds: `FlashGoneError` when the device
    is not there any more, `FlashResetError` when it has restarted (its light is off then).
    """

    @property
    def info(self) -> FlashInfo:
        """Who it is."""

    @property
    def capabilities(self) -> FlashCapabilities:
        """What it can do."""

    def start(self, train: PulseTrain) -> None:
        """Begins a train, in place of one that runs; returns at once.

        Raises:
            FlashError: The train is beyond the device's capabilities, or `start_s` is too near.
        """

    def poll(self) -> tuple[FlashEdge, ...]:
        """The edges since the last call, in order of time; called a few times a second while a train runs."""

    def off(self) -> bool:
        """Puts the light out and drops the train; whether the device has confirmed it.

        Never raises, can be repeated, and is tried even on a link that has failed.
        """

    def link_report(self) -> dict[str, Any]:
        """Round trips, retries, errors, clock fit: plain values for session.json; empty = no link."""

    def close(self) -> None:
        """Turns the light off and lets go of the device; harmless when repeated or when it is gone."""

    def __enter__(self) -> Self:
        """Itself."""

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Closes it."""
