"""One gain per band of rows: the data of the edge fit, out of the gains of blocks."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from capture.tagging.reference import BANDS, COLUMNS, PulseGain

Floats = NDArray[np.float64]

# Gain that a block's texture and 8-bit codes leave even when nothing moves.
_BLOCK_NOISE = 0.01
# Vertical misfit of the reference after registration, in bands (0.3 thumbnail rows; measured on simulated
# hand-held video). It moves a whole row of blocks up or down the picture's vertical slope together, so it
# does not average out over columns.
_MISFIT_BANDS = 0.15
# The flash's own pattern moves with the head during the pulse, which the reference cannot follow: by so
# many bands, and with gloss and turning surfaces by so large a share.
_PATTERN_SHIFT_BANDS, _PATTERN_CHANGE = 0.2, 0.02
# Huber's limit in standard deviations, for blocks and for bands.
_HUBER = 2.0


@dataclass(frozen=True, eq=False)
class BandGains:
    """The data of the fit, padded to the longest pulse.

    Attributes:
        start_s: [P, n] start of the frames (0 where padded).
        gain: [P, n, B] rho.
        weight: [P, n, B] inverse variance, 0 where padded.
        frames: [P, n] frame indices, -1 where padded.
    """

    start_s: Floats
    gain: Floats
    weight: Floats
    frames: NDArray[np.int_]

    def take(self, index: NDArray[np.int_]) -> BandGains:
        """The data of some pulses."""
        return BandGains(self.start_s[index], self.gain[index], self.weight[index], self.frames[index])

    def merged(self, count: int) -> BandGains:
        """The data with `count` neighbouring bands made one."""
        shape = (*self.gain.shape[:2], -1, count)
        weight = self.weight.reshape(shape).sum(axis=-1)
        gain = (self.weight * self.gain).reshape(shape).sum(axis=-1) / np.maximum(weight, 1e-12)
        return BandGains(self.start_s, gain, weight, self.frames)


def band_gains(pulses: list[PulseGain], pattern: Floats, pts_s: Floats) -> BandGains:
    """Collapse the columns of each band into one gain.

    The same column weights serve all frames of a pulse, so that rho = a g holds exactly whatever the
    pattern of the flash: pattern over variance, the matched filter. Blocks that stick out (something moved)
    are pulled in (Huber).

    Args:
        pulses: gains of the frames around each pulse.
        pattern: [n, n] log gain of the flash.
        pts_s: [K] start of the frames.
    """
    longest = max(len(pulse.frames) for pulse in pulses)
    shape = (len(pulses), longest)
    start, frames = np.zeros(shape), np.full(shape, -1)
    gain, weight = np.zeros((*shape, BANDS)), np.zeros((*shape, BANDS))
    shape_of_flash = np.maximum(
        cv2.resize(np.expm1(pattern), (COLUMNS, BANDS), interpolation=cv2.INTER_LINEAR), 0
    )
    shape_of_flash += 0.05 * shape_of_flash.max()  # every column may speak
    for p, pulse in enumerate(pulses):
        n = len(pulse.frames)
        variance = (2 * pulse.doubt) ** 2 + _BLOCK_NOISE**2
        filter_ = shape_of_flash / variance
        middle = _weighted_median(pulse.gain / shape_of_flash, filter_ * shape_of_flash)
        expected = middle[..., None] * shape_of_flash
        limit = _HUBER * np.sqrt(variance)
        held = expected + np.clip(pulse.gain - expected, -limit, limit)
        rho = (held * filter_).sum(axis=-1) / filter_.sum(axis=-1)
        slope = (pulse.slope * filter_).sum(axis=-1) / filter_.sum(axis=-1)
        full = ndimage.uniform_filter1d(np.maximum(rho.max(axis=0), 1e-3), 3)
        lit = np.clip(rho / full, 0, 1)
        sigma2 = (
            (filter_**2 * variance).sum(axis=-1) / filter_.sum(axis=-1) ** 2
            + np.square(_MISFIT_BANDS * slope * (1 + full * lit))
            + np.square(_PATTERN_SHIFT_BANDS * np.gradient(full) * lit)
            + np.square(_PATTERN_CHANGE * full * lit)
        )
        start[p, :n], frames[p, :n] = pts_s[pulse.frames], pulse.frames
        gain[p, :n], weight[p, :n] = rho, 1 / sigma2
    return BandGains(start, gain, weight, frames)


def _weighted_median(values: Floats, weight: Floats) -> Floats:
    """Weighted median over the last axis; `weight` is broadcast."""
    order = np.argsort(values, axis=-1)
    ordered = np.take_along_axis(values, order, axis=-1)
    total = np.cumsum(np.take_along_axis(np.broadcast_to(weight, values.shape), order, axis=-1), axis=-1)
    at = (total >= 0.5 * total[..., -1:]).argmax(axis=-1)
    return np.take_along_axis(ordered, at[..., None], axis=-1)[..., 0]
