"""How long a fit may take, and what shall be done with its portrait on the way.

A benchmark asks for portraits at given times of one fit; what it does with them does not count as the fit's
time. The clock is the caller's choice: seconds on the wall, or those of the processor, which a machine that
does other things does not spoil.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence

from relight.portrait import Portrait

AtMark = Callable[[float, Portrait], None]
"""Told (mark in seconds, the portrait of that time)."""


class Stopwatch:
    """A limit and marks on a clock."""

    def __init__(
        self,
        limit_s: float | None = None,
        *,
        marks_s: Sequence[float] = (),
        at_mark: AtMark | None = None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        """Runs from now on.

        Args:
            limit_s: Seconds of the clock; None = as long as it takes.
            marks_s: Ascending.
            at_mark: What to do at a mark.
            clock: Gives seconds.
        """
        self.limit_s = limit_s
        self._marks_s = list(marks_s)
        self._at_mark = at_mark
        self._clock = clock
        self._began_s = clock()

    @property
    def elapsed_s(self) -> float:
        """Seconds since it began, without those spent at marks."""
        return self._clock() - self._began_s

    @property
    def left_s(self) -> float:
        """Seconds that remain; infinite without a limit."""
        return math.inf if self.limit_s is None else self.limit_s - self.elapsed_s

    def look(self, make_portrait: Callable[[], Portrait]) -> None:
        """Does what is to be done at the marks that have passed, of several the last."""
        elapsed_s = self.elapsed_s
        passed = [mark for mark in self._marks_s if mark <= elapsed_s]
        if not passed or self._at_mark is None:
            return
        self._marks_s = self._marks_s[len(passed) :]
        self._at_mark(passed[-1], make_portrait())
        self._began_s += self.elapsed_s - elapsed_s
