"""What a camera and a flash on one desk share: time, and for simulated ones the light of the lamp.

Real devices live in the host's CLOCK_MONOTONIC. When both are simulated, time is what the simulated camera
makes it: it passes as frames are asked for, so a capture of twenty seconds takes as long as it takes to
compute, and nothing in it depends on the speed of the machine.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Protocol


class Clock(Protocol):
    """Seconds that pass."""

    def now_s(self) -> float:
        """Now; only differences mean something."""

    def sleep(self, seconds: float) -> None:
        """Waits; not at all for what is not positive."""


class MonotonicClock:
    """The host's: CLOCK_MONOTONIC, which V4L2 stamps its buffers with."""

    def now_s(self) -> float:
        """Seconds since some start of the machine."""
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        """Waits."""
        if seconds > 0:
            time.sleep(seconds)


class VirtualClock:
    """Time that passes when somebody sleeps or says so."""

    def __init__(self, now_s: float = 100.0) -> None:
        """Starts at an arbitrary time, not 0, as a machine's does."""
        self._now_s = now_s

    def now_s(self) -> float:
        """Seconds."""
        return self._now_s

    def sleep(self, seconds: float) -> None:
        """Passes at once."""
        self._now_s += max(0.0, seconds)

    def advance_to(self, now_s: float) -> None:
        """Passes until then; a time that is over is left alone."""
        self._now_s = max(self._now_s, now_s)


@dataclass
class LampLight:
    """A simulated lamp's light, as simulated cameras see it: pulses [on_s, off_s) by the bench's clock."""

    pulses: list[tuple[float, float]] = field(default_factory=list)


@dataclass(frozen=True)
class Bench:
    """What is on the desk.

    Attributes:
        clock: Of everything here.
        light: What simulated lamps shine with; real cameras do not look at it.
        walk_s: How long the hand of a simulated camera takes around the head.
    """

    clock: Clock = field(default_factory=MonotonicClock)
    light: LampLight = field(default_factory=LampLight)
    walk_s: float = 16.0
