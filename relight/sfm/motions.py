"""A head that moves in its room: which matches to believe when two motions are in the pictures."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from relight.sfm.matching import Pair
from relight.sfm.survey import Look

_FAR = 5  # frames apart in the order of capture
_STILL = 0.002  # motion, share of the longer side: a pixel of 512
_MOVING = 0.008
_LEAST_SHARE = 0.15  # of a pair's matches, still and moving
_LEAST_MATCHES = 10
_LEAST_PAIRS = 0.5  # share of the far pairs


def still_features(looks: Sequence[Look], pairs: Sequence[Pair]) -> list[NDArray[np.bool_]] | None:
    """Features of a background that stands still in the picture while something else moves.

    So it is when the camera stands on a tripod and the person turns on a chair. A camera that moves keeps
    nothing in its place from one end of its path to the other.

    Args:
        looks: In the order of capture.
        pairs: Compared frames with all their matches.

    Returns:
        For each frame [N] bool; None where no such background is.
    """
    flags = [np.zeros(len(look.features), bool) for look in looks]
    far = both = 0
    for pair in pairs:
        if pair.second - pair.first < _FAR or len(pair.matches) < 2 * _LEAST_MATCHES:
            continue
        motion = _motion(looks, pair)
        still, moving = motion < _STILL, motion > _MOVING
        far += 1
        most = max(_LEAST_MATCHES, _LEAST_SHARE * len(motion))
        both += int(still.sum() >= most and moving.sum() >= most)
        flags[pair.first][pair.matches[still, 0]] = True
        flags[pair.second][pair.matches[still, 1]] = True
    if not far or both < _LEAST_PAIRS * far:
        return None
    return flags


def without_still(looks: Sequence[Look], pair: Pair) -> NDArray[np.uint32]:
    """[M, 2] the matches of a pair that moved."""
    return pair.matches[_motion(looks, pair) >= _STILL]


def _motion(looks: Sequence[Look], pair: Pair) -> NDArray[np.float64]:
    """[M] how far each match moved, share of the longer side."""
    first = looks[pair.first].features.places_px[pair.matches[:, 0]]
    second = looks[pair.second].features.places_px[pair.matches[:, 1]]
    return np.asarray(np.linalg.norm(first - second, axis=1) / max(looks[pair.first].size))
