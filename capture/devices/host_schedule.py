"""When the host has to switch a lamp that has no clock of its own: a state machine without clock or thread.

The flashes of a train begin at `start_s` + k `period_s`: absolute deadlines, so no delay adds up. What the
host cannot begin in time it leaves out, as the firmware does; a flash that began late keeps its length.
However late, early or often it is asked, it never orders more than three flashes in any one second, over all
trains.

    schedule.start(train)
    step = schedule.due(now_s)            None, or what to do now
    edge = schedule.done(step, before_s, after_s)      it was done in between
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Any

from capture.devices.flash import FlashEdge, PulseTrain

#: A flash that cannot begin within this is left out. On a machine with four times the work that it can do,
#: the thread was up to 80 ms late; the edges are told as they happened, so lateness costs regularity alone.
LATEST_S = 0.1
#: Most flashes in any one second (WCAG 2.3.1), as in firmware_protocol.
_FLASHES, _WINDOW_S = 3, 1.0


@dataclass(frozen=True)
class Step:
    """What is to be done: the light on or off, for which flash of the train."""

    on: bool
    pulse: int


class HostSchedule:
    """One lamp's flashes.

    Attributes:
        skipped: Numbers of the flashes that were left out, of all trains.
        made: How many were made.
        last_on_s: Of the last flash, from before the command on to after the command off.
        longest_on_s: Of all flashes.
        latest_s: The worst delay of a beginning.
    """

    def __init__(self, latency_s: float = 0.0, jitter_s: float = 0.0) -> None:
        """Nothing to do yet.

        Args:
            latency_s: From the command to the light, by which edges are later than commands.
            jitter_s: Standard deviation of that, to be added to what the commands leave open.
        """
        self.skipped: list[int] = []
        self.made = 0
        self.last_on_s = 0.0
        self.longest_on_s = 0.0
        self.latest_s = 0.0
        self._latency_s, self._jitter_s = latency_s, jitter_s
        self._train: PulseTrain | None = None
        self._pulse = 0
        self._lit_s: float | None = None
        self._lit_pulse = 0
        self._off_s = math.inf
        self._ons_s: deque[float] = deque(maxlen=_FLASHES)

    @property
    def train(self) -> PulseTrain | None:
        """What runs; None = nothing, or all of it has been made."""
        return self._train

    @property
    def lit(self) -> bool:
        """Whether the light was last told to be on."""
        return self._lit_s is not None

    def start(self, train: PulseTrain) -> None:
        """Begins a train in place of one that runs. A light that is on stays on until it is due to go out."""
        self._train, self._pulse = train, 0

    def drop(self) -> Step | None:
        """Forgets the train. What to do to be dark: nothing when it is dark already."""
        self._train = None
        return Step(False, self._lit_pulse) if self.lit else None

    def next_s(self) -> float | None:
        """When there is something to do next; None = never."""
        if self.lit:
            return self._off_s
        return self._begin_s() if self._train else None

    def due(self, now_s: float) -> Step | None:
        """What there is to do now; flashes that are too late are left out here."""
        if self.lit:
            return Step(False, self._lit_pulse) if now_s >= self._off_s else None
        while self._train is not None:
            begin_s, late_s = self._begin_s(), self._nominal_s() + LATEST_S
            if now_s < begin_s and begin_s <= late_s:
                return None
            if max(now_s, begin_s) <= late_s:
                return Step(True, self._pulse)
            self.skipped.append(self._pulse)
            self._advance()
        return None

    def done(self, step: Step, before_s: float, after_s: float) -> FlashEdge:
        """Takes note that a step was made, by a command that was given `before_s` and taken by `after_s`.

        Returns:
            The edge: the lamp's latency after the middle of the two; uniform between them, and uncertain by
            the lamp's jitter.
        """
        if step.on:
            self.latest_s = max(self.latest_s, before_s - self._nominal_s())
            assert self._train is not None
            self._lit_s, self._lit_pulse = before_s, step.pulse
            self._off_s = before_s + self._train.on_s
            self._ons_s.append(after_s)
            self.made += 1
            self._advance()
        elif self._lit_s is not None:
            self.last_on_s = after_s - self._lit_s
            self.longest_on_s = max(self.longest_on_s, self.last_on_s)
            self._lit_s, self._off_s = None, math.inf
        sigma_s = math.hypot((after_s - before_s) / math.sqrt(12), self._jitter_s)
        time_s = (before_s + after_s) / 2 + self._latency_s
        return FlashEdge(time_s=time_s, sigma_s=sigma_s, on=step.on, pulse=step.pulse)

    def report(self) -> dict[str, Any]:
        """What became of the flashes: plain values for session.json."""
        return {
            "flashes": self.made,
            "skipped": list(self.skipped),
            "longest_on_s": self.longest_on_s,
            "latest_s": self.latest_s,
        }

    def _nominal_s(self) -> float:
        assert self._train is not None
        return self._train.start_s + self._pulse * self._train.period_s

    def _begin_s(self) -> float:
        full = len(self._ons_s) == _FLASHES
        return max(self._nominal_s(), self._ons_s[0] + _WINDOW_S) if full else self._nominal_s()

    def _advance(self) -> None:
        assert self._train is not None
        self._pulse += 1
        if self._pulse >= self._train.count:
            self._train = None
