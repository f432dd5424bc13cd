"""Stretches of a stream: frames that are looked at together, and in parts where the flash died inside."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from capture.errors import TaggingError
from capture.tagging.analysis import Analysis, analyse
from capture.tagging.config import TaggingConfig
from capture.tagging.drift import DriftStep
from capture.tagging.known import Commands, KnownFlash
from capture.tagging.profiles import FrameProfiles
from capture.tagging.result import Pulse

# A stretch in which no flash is found is looked at in halves down to this length: it may have died inside.
_SHORTEST_S = 8.0
_LEAST_FRAMES = 8


@dataclass(frozen=True, eq=False)
class Stretch:
    """Frames that are looked at together.

    Attributes:
        profiles: [K] of them.
        base: position of the first.
        begin: index of the first that has no tag yet.
        last: it ends a segment.
        only: it is all of the capture.
        commands: of the flash around it; None = none known.
    """

    profiles: FrameProfiles
    base: int
    begin: int
    last: bool
    only: bool
    commands: Commands | None


@dataclass(frozen=True, eq=False)
class Part:
    """A part of a stretch's readable frames [first, end) with what was found in it; None = no flash."""

    first: int
    end: int
    analysis: Analysis | None


def parts_of(
    stretch: Stretch, seen: NDArray[np.int_], config: TaggingConfig, known: KnownFlash
) -> list[Part]:
    """The stretch, or its halves and their halves where there is no flash in all of it.

    Args:
        stretch: to look at.
        seen: its readable frames.
        config: limits.
        known: what the stretches before have taught.

    Raises:
        TaggingError: it is all of the capture and cannot be tagged.
    """
    readable = stretch.profiles.take(seen)
    taught = None if stretch.only else known

    def attempt(first: int, end: int) -> list[Part]:
        part = readable.take(np.arange(first, end))
        try:
            if len(part) < _LEAST_FRAMES:
                raise TaggingError(
                    f"Only {len(part)} frames can be used; at least {_LEAST_FRAMES} are needed."
                )
            found = analyse(part, config, taught, stretch.commands)
        except TaggingError:
            if stretch.only:
                raise
            if len(part) < 2 * _LEAST_FRAMES or part.pts_s[-1] - part.pts_s[0] < 2 * _SHORTEST_S:
                return [Part(first, end, None)]
            middle = (first + end) // 2
            return attempt(first, middle) + attempt(middle, end)
        return [Part(first, end, found)]

    return attempt(0, len(readable))


def steps_of(parts: Sequence[Part], pts_s: NDArray[np.float64]) -> tuple[DriftStep, ...]:
    """Changes of exposure within the times of some frames."""
    return tuple(
        step
        for part in parts
        if part.analysis is not None
        for step in part.analysis.drift.steps
        if pts_s[0] <= step.time_s <= pts_s[-1]
    )


def added_light(analysis: Analysis, pulse: Pulse, seen: NDArray[np.int_]) -> float:
    """Mean linear light that a pulse adds to the frames that it lights in full; NaN where there is none."""
    first, last = np.searchsorted(seen, pulse.frames)
    lit = [k for k in range(first, last) if analysis.frames[k].flash == 1]
    beside = [k for k in (first - 1, last) if 0 <= k < len(seen) and analysis.frames[k].flash == 0]
    if not lit or not beside:
        return float("nan")
    return float(np.mean(analysis.squares[lit]) - np.mean(analysis.squares[beside]))
