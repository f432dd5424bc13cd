"""The head of a cloud that may go on to neck and shoulders, told from its breadth level by level.

From the crown down a head grows to its breadth, the neck is narrower, the shoulders are wider; with long hair
the neck hides and only the shoulders tell. All is relative to the head's own breadth, for the unit of length
may not be known.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from relight.face.plane import Floats

_LEVELS = 64
_FEWEST_A_LEVEL = 4
_SHALLOWEST = 1.25  # breadths from the crown to the highest neck; chins are at 1.4 to 1.6
_DEEPEST = 1.8
_NECK = 0.88  # of the head's breadth
_SHOULDERS = 1.15
_CHIN = 0.2  # breadths that a chin may hang below the level where a neck begins
_WINDOW = 0.3  # breadths over which a neck does not get narrower


def head_floor(points: Floats, up: Floats, towards: Floats) -> float:
    """Height below which a cloud is no longer head.

    Args:
        points: [N, 3] evenly spread, world, without outliers.
        up: [3] unit.
        towards: [3] unit, horizontal, from the head to where the cameras are: breadth is taken across it.

    Returns:
        Height along `up`; the lowest point's where everything is head.
    """
    across = np.cross(up, towards)
    heights, lateral = points @ up, points @ across
    low, crown = (float(value) for value in np.percentile(heights, [0.2, 99.8]))
    if not crown > low:
        return low
    step = (crown - low) / _LEVELS
    breadths = np.full(_LEVELS, np.nan)
    for level in range(_LEVELS):
        here = np.abs(heights - (crown - (level + 0.5) * step)) <= 0.75 * step
        if here.sum() >= _FEWEST_A_LEVEL:
            ends = np.percentile(lateral[here], [4, 96])
            breadths[level] = ends[1] - ends[0]
    breadths = _filled(breadths)
    widest = 0.0
    for level in range(_LEVELS):
        depth = (level + 0.5) * step
        if widest > 0 and depth > _SHALLOWEST * widest:
            narrowest = breadths[level : level + max(4, int(_WINDOW * widest / step))].min()
            is_neck = breadths[level] <= narrowest and breadths[level] < _NECK * widest
            if is_neck or breadths[level] > _SHOULDERS * widest or depth > _DEEPEST * widest:
                return crown - _above_shoulders(breadths, level, widest, step)
        if widest == 0 or depth <= _SHALLOWEST * widest:  # shoulders are no breadth of the head
            widest = max(widest, float(breadths[level]))
    return low


def _above_shoulders(breadths: Floats, neck: int, widest: float, step: float) -> float:
    """Depth below the crown that leaves the chin in, which may hang below the neck's level, no shoulder."""
    level = neck
    while level > 0 and breadths[level] > _SHOULDERS * widest:
        level -= 1
    last = min(_LEVELS - 1, neck + int(_CHIN * widest / step))
    while level < last and breadths[level + 1] < _SHOULDERS * widest:
        level += 1
    return (level + 1) * step


def _filled(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Gaps interpolated, and single levels that stray evened out."""
    known = np.flatnonzero(np.isfinite(values))
    if not len(known):
        return np.zeros_like(values)
    filled = np.interp(np.arange(len(values)), known, values[known])
    padded = np.pad(filled, 1, mode="edge")
    return np.asarray(np.median(np.stack([padded[:-2], padded[1:-1], padded[2:]]), axis=0))
