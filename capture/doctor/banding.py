"""Whether the flash's own light bands, as a dimmed one does that is switched on and off very often.

A rolling shutter shows that as stripes.

What the flash adds to a frame is the scene's pattern times the light that each row caught. The pattern is
the same in all lit frames of a camera that stands still, the stripes are not: they begin elsewhere in each.
So the rows' mean over the frames is taken off, in logarithms, and what is left is looked at for a wave.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_LEAST_FRAMES = 3
_LEAST_LIGHT = 2e-3  # added by the flash to a row, linear, 1 = white
_LEAST_WAVES = 3  # over the picture; slower changes are the scene's
_SIGNIFICANT = 8.0  # power of the wave over the median of all others


@dataclass(frozen=True)
class Banding:
    """Stripes in the light of the flash.

    Attributes:
        waves: Over the height of the picture.
        depth: Amplitude of the wave, as a share of the flash's light.
    """

    waves: float
    depth: float


def find_banding(lit: Sequence[NDArray[np.float32]], unlit: Sequence[NDArray[np.float32]]) -> Banding | None:
    """The strongest wave over the rows of the flash's light.

    Args:
        lit: [H, W, 3] linear, frames that are lit in every row.
        unlit: Likewise, for each of them one without the flash, from about the same time.

    Returns:
        None where there is no wave that stands out, or fewer than three frames or too little light to tell.
    """
    if len(lit) < _LEAST_FRAMES:
        return None
    rows = np.stack(
        [
            (with_flash.astype(np.float64) - without).mean(axis=(1, 2))
            for with_flash, without in zip(lit, unlit, strict=True)
        ]
    )
    if not np.all(np.isfinite(rows)) or np.median(rows) < _LEAST_LIGHT:
        return None
    logs = np.log(np.maximum(rows, _LEAST_LIGHT / 4))
    ripple = logs - logs.mean(axis=0)
    ripple -= ripple.mean(axis=1, keepdims=True)
    height = ripple.shape[1]
    window = np.hanning(height)
    power = np.mean(np.abs(np.fft.rfft(ripple * window, axis=1)) ** 2, axis=0)
    power[:_LEAST_WAVES] = 0.0
    peak = int(np.argmax(power))
    if power[peak] < _SIGNIFICANT * np.median(power[_LEAST_WAVES:]) or peak == 0:
        return None
    # A wave of amplitude a has |X| = a sum(window) / 2 at its frequency; the mean over n frames that is taken
    # off costs it 1 / n of its power.
    amplitude = 2.0 * np.sqrt(power[peak] * len(lit) / (len(lit) - 1)) / window.sum()
    return Banding(waves=float(peak), depth=float(amplitude))
