"""What a known schedule says of frames: which rows of which frame were lit, and where the frames disagree."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capture.tagging.config import TaggingConfig
from capture.tagging.result import FrameTag
from capture.tagging.shutter import lit_share

Floats = NDArray[np.float64]

#: Rows by which frames and schedule are compared.
_ROWS = 24
# A frame that has a row with this share of the light, by edges so much shorter, is lit for sure.
_SURELY_LIT = 0.5


def predicted_lit_fraction(
    pts_s: ArrayLike, on_s: ArrayLike, off_s: ArrayLike, *, readout_s: float, exposure_s: float, rows: int
) -> Floats:
    """Which rows of which frame a flash lights (model of `capture.tagging.shutter`).

    Args:
        pts_s: [K] start of each frame's first exposed row, increasing.
        on_s: [P] when the flash goes on, on the frames' time axis.
        off_s: [P] when it goes off.
        readout_s: from the first row's start to the last row's, negative when the bottom row is first.
        exposure_s: of a row, positive.
        rows: R, bands of equal height from the top of the picture to the bottom.

    Returns:
        [K, R] share of each band's exposure with the flash on, 0..1.
    """
    start = np.asarray(pts_s, float)
    out = np.zeros((len(start), rows))
    span = abs(readout_s) + exposure_s
    for on, off in zip(np.atleast_1d(on_s), np.atleast_1d(off_s), strict=True):
        if off <= on:
            continue
        first, last = np.searchsorted(start, [on - span, off])
        out[first:last] += lit_share(start[first:last], on, off, readout_s, exposure_s, rows)
    return np.clip(out, 0.0, 1.0)


def find_contradictions(
    pts_s: Floats,
    tags: Sequence[FrameTag],
    on_s: Floats,
    off_s: Floats,
    *,
    readout_s: float,
    exposure_s: float,
    slack_s: float,
    config: TaggingConfig,
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Frames whose tag cannot be reconciled with the schedule.

    A frame called unlit that a pulse lights for sure, or one called lit (or found partial by its light) that
    no pulse can reach. What lies within `slack_s` of an edge contradicts nothing, and neither does what the
    schedule does not cover: before its first pulse and after its last.

    Args:
        pts_s: [K] start of the frames.
        tags: [K].
        on_s: [P] starts of the scheduled pulses on the frames' axis, increasing.
        off_s: [P] their ends.
        readout_s: ro.
        exposure_s: e.
        slack_s: doubt of an edge.
        config: limits of the labels.

    Returns:
        [K] bool, and [K] the greatest lit share of a row that the schedule allows, edges taken that much
        farther apart.
    """
    out = np.zeros(len(pts_s), bool)
    if not len(on_s):
        return out, np.zeros(len(pts_s))
    surely, perhaps = (
        predicted_lit_fraction(
            pts_s, on_s + side, off_s - side, readout_s=readout_s, exposure_s=exposure_s, rows=_ROWS
        ).max(axis=1)
        for side in (slack_s, -slack_s)
    )
    covered = (pts_s > on_s[0] - config.shortest_period_s) & (pts_s < off_s[-1] + config.shortest_period_s)
    for k, tag in enumerate(tags):
        shows_light = tag.flash == 1 or (tag.flash is None and "partial_flash" in tag.reasons)
        unseen = tag.flash == 0 and surely[k] >= _SURELY_LIT
        uncalled = shows_light and perhaps[k] <= 0.0 and covered[k]
        out[k] = unseen or uncalled
    return out, perhaps
