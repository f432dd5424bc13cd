"""Which frames belong to a pulse, and which unlit frames beside it show the room."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from capture.tagging.config import TaggingConfig
from capture.tagging.edges import EdgeRange
from capture.tagging.split import Split

Floats = NDArray[np.float64]

# Frames on each side of the lit ones that an edge can touch: one by its rows, one more by a readout and an
# exposure that overlap the next frame's.
_GUARD = 2
# A score above this share of a full flash and so many spreads may be a pulse that only ever lit parts of
# frames.
_WEAK_SCORE, _WEAK_SPREADS = 0.2, 6.0
# Edges are searched so far beyond the frames that bracket them, in frame intervals: the score's error.
_MARGIN = 0.25


@dataclass(frozen=True)
class PulseWindow:
    """A candidate pulse.

    Attributes:
        first: first frame that is lit for the larger part.
        last: last such frame.
        begin: first frame to look at.
        end: one past the last frame to look at.
        before: unlit frame before it, None at the start.
        after: unlit frame after it, None at the end.
        weak: no frame is lit for the larger part; the candidate must prove itself.
    """

    first: int
    last: int
    begin: int
    end: int
    before: int | None
    after: int | None
    weak: bool


def find_windows(pts_s: Floats, split: Split, config: TaggingConfig) -> list[PulseWindow]:
    """Candidate pulses, in order, with no frame in two of them."""
    runs = [(first, last, False) for first, last in runs_of(split.core)]
    runs = _merged(pts_s, runs, config)
    weak = (split.score > max(_WEAK_SCORE, _WEAK_SPREADS * split.spread)) & ~split.core
    for first, last in runs_of(weak):
        if all(last < a - _GUARD or first > b + _GUARD for a, b, _ in runs):
            peak = first + int(np.argmax(split.score[first : last + 1]))
            runs.append((peak, peak, True))
    runs.sort()
    windows = []
    count = len(pts_s)
    for i, (first, last, is_weak) in enumerate(runs):
        room_before = first - (runs[i - 1][1] + 1) if i else first
        room_after = (runs[i + 1][0] if i + 1 < len(runs) else count) - last - 1
        # between two pulses their guards and at least one unlit frame must find room; at an end, one unlit
        # frame
        left = min(_GUARD, max((room_before - 1) // (2 if i else 1), 0))
        right = min(_GUARD, max((room_after - 1) // (2 if i + 1 < len(runs) else 1), 0))
        begin, end = first - left, last + right + 1
        windows.append(
            PulseWindow(
                first=first,
                last=last,
                begin=begin,
                end=end,
                before=begin - 1 if begin > 0 and room_before > left else None,
                after=end if end < count and room_after > right else None,
                weak=is_weak,
            )
        )
    return [window for window in windows if window.before is not None or window.after is not None]


def edge_range(
    pts_s: Floats, windows: list[PulseWindow], interval_s: float, config: TaggingConfig
) -> EdgeRange:
    """Where the edges of the pulses can lie, by the frames that are mostly lit and those that are not.

    More than half of frame `first` sees the light, so it went on at most an interval after the frame began;
    less than half of the frame before does, so it went on after that one began.
    """
    margin = _MARGIN * interval_s
    on_low, on_high, off_low, off_high = [], [], [], []
    for w in windows:
        before_s = pts_s[w.first - 1] if w.first > 0 else pts_s[0] - config.longest_on_s
        after_s = pts_s[w.last + 1] if w.last + 1 < len(pts_s) else pts_s[-1] + config.longest_on_s
        on_low.append(before_s - margin)
        on_high.append(pts_s[w.first] + interval_s * (2 if w.weak else 1) + margin)
        off_low.append(pts_s[w.last] - margin)
        off_high.append(after_s + interval_s + margin)
    return EdgeRange(np.array(on_low), np.array(on_high), np.array(off_low), np.array(off_high))


def runs_of(flags: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and last index of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return [(int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _merged(
    pts_s: Floats, runs: list[tuple[int, int, bool]], config: TaggingConfig
) -> list[tuple[int, int, bool]]:
    """Runs with a single frame between them made one: motion hid the flash in that frame."""
    out: list[tuple[int, int, bool]] = []
    for first, last, weak in runs:
        if out and first - out[-1][1] == 2 and pts_s[last] - pts_s[out[-1][0]] <= config.longest_on_s:
            out[-1] = (out[-1][0], last, weak)
        else:
            out.append((first, last, weak))
    return out
