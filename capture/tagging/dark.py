"""Frames in which no pulse was found, when the flash is known from before: unlit, if the light says so.

A flash that died or was reset leaves seconds or hours without pulses, in which frames do not fall into two
classes. The light that the flash would add is known, and frames that have none of it are unlit; where the
camera's motion hides that, nothing is said.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from capture.tagging.config import TaggingConfig
from capture.tagging.result import FrameTag
from capture.tagging.split import local_gain, symmetric_gain

Floats = NDArray[np.float64]

UNTAGGED = FrameTag(None, None, 0.0, ("untagged",))

# A frame is unlit when its light is within so many spreads of the others', and below this share of a flash.
_SPREADS, _MOST_LIGHT = 4.0, 0.15
# The flash must stand out of the unlit frames' spread so far, more than for a tag at a pulse: there is no
# rhythm to rely on.
_LEAST_SEPARATION = 10.0
# Frames beside a doubtful one that its light may touch.
_GUARD = 2
# A lamp that stays on is a step by a flash's worth: medians of so many frames on each side differ by so much.
_STEP_FRAMES, _STEP = 9, 0.3
_LEAST_NOISE = 1e-3
_LARGEST_LOG_GAIN = 1.5


def label_dark(
    pts_s: Floats, squares: NDArray[np.float32], pattern: Floats, config: TaggingConfig
) -> list[FrameTag]:
    """Tags of frames without pulses: 0 where they surely have no flash, None elsewhere.

    Args:
        pts_s: [K] increasing.
        squares: [K, n, n] mean linear light of blocks, positive.
        pattern: [n, n] log gain of the flash.
        config: limits.
    """
    count = len(pts_s)
    if count < 3 * _STEP_FRAMES:
        return [UNTAGGED] * count
    log = np.log(squares.astype(np.float64)).reshape(count, -1)
    gain = np.clip(symmetric_gain(pts_s, log, config), -_LARGEST_LOG_GAIN, _LARGEST_LOG_GAIN)
    score, _ = _score(gain, gain, pattern)
    unlit = ~ndimage.binary_dilation(score > 0.25, iterations=_GUARD)
    if unlit.sum() < 0.5 * count:
        return [UNTAGGED] * count
    gain = np.clip(local_gain(pts_s, log, unlit), -_LARGEST_LOG_GAIN, _LARGEST_LOG_GAIN)
    score, _ = _score(gain, gain[unlit], pattern)
    score = score - float(np.median(score[unlit]))
    scatter = np.abs(score[unlit])
    spread = max(1.4826 * float(np.median(scatter)), float(np.quantile(scatter, 0.97)) / 2.17, 1e-4)
    if 1 / spread < _LEAST_SEPARATION:
        return [UNTAGGED] * count
    doubtful = ndimage.binary_dilation(score > min(_SPREADS * spread, _MOST_LIGHT), iterations=_GUARD)
    # a Student-t tail of three degrees beyond the limit
    confidence = float(1 - 0.5 * (1 + (1 / spread) ** 2 / 3) ** -2)
    return [
        FrameTag(None, None, 0.5, ("flash_uncertain",)) if doubt else FrameTag(0, 0.0, confidence, ())
        for doubt in doubtful
    ]


def light_stays(squares: NDArray[np.float32], pattern: Floats) -> bool:
    """Whether the light jumps by a flash's worth and stays there: a lamp that is stuck, a room light.

    Args:
        squares: [K, n, n] mean linear light of blocks, positive.
        pattern: [n, n] log gain of the flash.
    """
    if len(squares) < 3 * _STEP_FRAMES:
        return False
    log = np.log(squares.astype(np.float64)).reshape(len(squares), -1)
    weight = pattern.ravel() / np.square(pattern).sum()
    middle = ndimage.median_filter(log @ weight, _STEP_FRAMES, mode="nearest")
    return bool(np.any(np.abs(middle[_STEP_FRAMES:] - middle[:-_STEP_FRAMES]) > _STEP))


def _score(gain: Floats, unlit: Floats, pattern: Floats) -> tuple[Floats, Floats]:
    """[K] light in flashes by the matched filter, and the filter [N]."""
    noise = 1.4826 * np.median(np.abs(unlit - np.median(unlit, axis=0)), axis=0) + _LEAST_NOISE
    weight = pattern.ravel() / noise**2
    weight = weight / float(pattern.ravel() @ weight)
    return gain @ weight, weight
