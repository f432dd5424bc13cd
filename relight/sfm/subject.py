"""Which features are on the subject: those that the flash lights more than the rest of the room.

The flash falls off with the square of the distance, so between a lit frame and the next unlit one the head
changes most. No pose is needed: at 64 pixels the few degrees between neighbours are less than the blur.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from relight.sfm.survey import Look

_BLUR_PX = 1.5  # of 64
_DARK = 0.004
_LEAST_STEP = 0.25  # of the logarithm: the subject gains at least 28 % more light than the rest
_LEAST_SHARE = 0.03  # of the picture, for either class


def subject_features(looks: Sequence[Look]) -> list[NDArray[np.bool_]] | None:
    """For each frame [N] bool; None where neither masks nor the flash tell subject and background apart.

    Args:
        looks: In the order of capture.
    """
    if all(look.subject is not None for look in looks):
        return [np.asarray(look.subject) for look in looks]
    gains = flash_gains(looks)
    if gains is None:
        return None
    step = gain_step(np.concatenate([gain.ravel() for gain in gains]))
    if step is None:
        return None
    flags = []
    for look, gain in zip(looks, gains, strict=True):
        scale = np.array([gain.shape[1] / look.size[0], gain.shape[0] / look.size[1]])
        at = (look.features.places_px * scale).astype(np.int64)
        column = np.clip(at[:, 0], 0, gain.shape[1] - 1)
        row = np.clip(at[:, 1], 0, gain.shape[0] - 1)
        flags.append(gain[row, column] > step)
    return flags


def flash_gains(looks: Sequence[Look]) -> list[NDArray[np.float64]] | None:
    """Logarithm of lit over unlit radiance, [h, w] for each frame; None without both kinds of frames."""
    lit = np.array([i for i, look in enumerate(looks) if look.record.flash == 1])
    unlit = np.array([i for i, look in enumerate(looks) if look.record.flash == 0])
    if not len(lit) or not len(unlit):
        return None
    smooth = [cv2.GaussianBlur(look.small, (0, 0), _BLUR_PX).astype(np.float64) for look in looks]
    gains = []
    for i, look in enumerate(looks):
        bright = i if look.record.flash == 1 else int(lit[np.abs(lit - i).argmin()])
        dark = i if look.record.flash == 0 else int(unlit[np.abs(unlit - i).argmin()])
        if look.record.flash is None:
            dark = int(unlit[np.abs(unlit - i).argmin()])
        if smooth[bright].shape != smooth[dark].shape:
            return None  # pictures of several shapes: no place in one is the place in another
        gains.append(np.log((smooth[bright] + _DARK) / (smooth[dark] + _DARK)))
    return gains


def gain_step(values: NDArray[np.float64]) -> float | None:
    """The gain that best parts two classes (Otsu 1979); None where there are no two."""
    low, high = np.percentile(values, [0.5, 99.5])
    if not high - low > _LEAST_STEP:
        return None
    counts, edges = np.histogram(np.clip(values, low, high), bins=128)
    middles = 0.5 * (edges[1:] + edges[:-1])
    below = np.cumsum(counts)[:-1]
    above = below[-1] + counts[-1] - below
    mean_below = np.cumsum(counts * middles)[:-1] / np.maximum(below, 1)
    mean_above = ((counts * middles).sum() - np.cumsum(counts * middles)[:-1]) / np.maximum(above, 1)
    between = below * above * (mean_above - mean_below) ** 2.0
    best = int(between.argmax())
    share = min(below[best], above[best]) / counts.sum()
    if mean_above[best] - mean_below[best] < _LEAST_STEP or share < _LEAST_SHARE:
        return None
    return float(edges[best + 1])
