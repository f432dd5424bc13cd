"""Which frames the reconstruction is made from; the others get their pose from it afterwards.

Blurred frames have features at the wrong places, and frames from the same place add equations that say
nothing of depth; both cost time and can lead the search astray.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from relight.sfm.matching import match_descriptors
from relight.sfm.survey import Look

BLURRED = 0.6
"""Sharpness relative to the neighbours' median below which a frame is blurred."""

SAME_PLACE = 0.004
"""Motion, share of the longer side, below which a feature is in the same place."""

_NEIGHBOURS = 6  # on each side
_STRONGEST = 1000  # features that are enough to see whether anything moved
_STILL = 0.94  # share of the matches; of frames from one place fewer than this are wrong
_ENOUGH = 40  # matches
_MOST_BLURRED = 0.3  # share of the frames; more than this is no blur but a change of what is seen


def blurred_frames(sharpness: Sequence[float]) -> list[int]:
    """Positions of frames that are much less sharp than those around them."""
    values = np.asarray(sharpness, np.float64)
    found = []
    for i, value in enumerate(values):
        around = np.concatenate([values[max(0, i - _NEIGHBOURS) : i], values[i + 1 : i + 1 + _NEIGHBOURS]])
        if len(around) >= 2 and value < BLURRED * np.median(around):
            found.append(i)
    if len(found) > _MOST_BLURRED * len(values):
        found = sorted(sorted(found, key=lambda i: values[i])[: int(_MOST_BLURRED * len(values))])
    return found


def same_place(first: Look, second: Look) -> bool:
    """Whether two frames were taken from the same place in the same direction."""
    a, b = first.features, second.features
    matches = match_descriptors(a.descriptors[:_STRONGEST], b.descriptors[:_STRONGEST])
    if len(matches) < _ENOUGH:
        return False
    motion = np.linalg.norm(a.places_px[matches[:, 0]] - b.places_px[matches[:, 1]], axis=1)
    # Nearly all must be still: the many features of a still background must not hide a head that turned.
    return float(np.percentile(motion, 100.0 * _STILL)) < SAME_PLACE * max(first.size)


def choose_keyframes(looks: Sequence[Look], most: int) -> tuple[list[int], dict[int, str]]:
    """Positions of the frames to reconstruct from, and why the others are not among them.

    Args:
        looks: In the order of capture.
        most: Keyframes at most; more are thinned out evenly, unlit ones first.
    """
    left_out = dict.fromkeys(blurred_frames([look.sharpness for look in looks]), "blurred")
    last: dict[bool, Look] = {}
    for i, look in enumerate(looks):
        if i in left_out:
            continue
        lit = look.record.flash == 1
        if lit in last and same_place(last[lit], look):
            left_out[i] = "same place as an earlier frame"
        else:
            last[lit] = look
    kept = [i for i in range(len(looks)) if i not in left_out]
    if len(kept) > most:
        chosen = set(_evenly(kept, [looks[i].record.flash == 1 for i in kept], most))
        left_out |= {i: "more frames than are needed" for i in kept if i not in chosen}
        kept = sorted(chosen)
    return kept, left_out


def _evenly(positions: list[int], lit: list[bool], most: int) -> list[int]:
    alight = [i for i, flag in zip(positions, lit, strict=True) if flag]
    others = [i for i, flag in zip(positions, lit, strict=True) if not flag]
    if len(alight) > most // 2:
        alight = _thinned(alight, most // 2)
    return alight + _thinned(others, most - len(alight))


def _thinned(positions: list[int], most: int) -> list[int]:
    if len(positions) <= most:
        return positions
    chosen: NDArray[np.int64] = np.unique(np.rint(np.linspace(0, len(positions) - 1, most)).astype(np.int64))
    return [positions[i] for i in chosen]
