"""Mains flicker of the room light: a wave over the rows whose phase runs on from frame to frame.

Room light on the mains goes as 1 + m cos(2 pi f t) with f twice the line frequency. A row at position r of
a frame that starts at s sees it at t = s + r ro, so in the picture it is a wave of q = f ro periods per
frame height, at the phase 2 pi f s. A partial flash is nothing of the kind: it comes once a second and only
ever adds light.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from capture.tagging.config import TaggingConfig

Floats = NDArray[np.float64]

# The line frequency wanders by some 0.1 %, a phone's clock by less.
_DETUNING_HZ = 0.3
# Waves per frame height: 33 ms of readout at 120 Hz is 4.
_MOST_WAVES, _WAVE_STEP = 4.5, 0.1
# At the frame rate the light's frequency appears as an alias. One slower than this is followed by the unlit
# frames around a pulse, so it does no harm; and a moving camera has its power there.
_SLOWEST_ALIAS_HZ = 1.5
# A wave counts when its amplitude is above this and so many times the usual one of the spectrum.
_LEAST_DEPTH, _LEAST_RATIO = 0.004, 10.0
_LEAST_FRAMES = 24
# Amplitude and phase are followed at this scale.
_FOLLOW_S = 0.6


@dataclass(frozen=True, eq=False)
class Flicker:
    """A flicker that was found.

    Attributes:
        frequency_hz: of the light.
        depth: mean amplitude as a share of the room light, after the exposure's smoothing.
        readout_s: signed readout time that its slope over the rows gives.
        row_gain: [K, rows] gain of the room light.
    """

    frequency_hz: float
    depth: float
    readout_s: float
    row_gain: Floats

    @property
    def waves(self) -> float:
        """Periods over the height of a frame."""
        return self.readout_s * self.frequency_hz


def find_flicker(
    pts_s: Floats, log_rows: Floats, steady: NDArray[np.bool_], rows: int, config: TaggingConfig
) -> Flicker | None:
    """Look for mains flicker.

    Args:
        pts_s: [K] start of the frames.
        log_rows: [K, B] mean log light of bands of rows.
        steady: [K] bool, frames that may be used: no flash, none unreadable.
        rows: R, for how many rows of a frame the gain is wanted.
        config: frequencies.

    Returns:
        The flicker; None when there is none above the noise, or too few frames.
    """
    interval = float(np.median(np.diff(pts_s)))
    best: tuple[float, Flicker] | None = None
    for nominal_hz in config.mains_hz:
        found = _find_near(nominal_hz, pts_s, log_rows, steady, rows, interval)
        if found is not None and (best is None or found[0] > best[0]):
            best = found
    return None if best is None else best[1]


def _find_near(
    nominal_hz: float, pts_s: Floats, log_rows: Floats, steady: NDArray[np.bool_], rows: int, interval: float
) -> tuple[float, Flicker] | None:
    """Flicker near one frequency with its strength."""
    bands = log_rows.shape[1]
    alias_hz = abs((nominal_hz * interval + 0.5) % 1 - 0.5) / interval
    if alias_hz < _SLOWEST_ALIAS_HZ:
        return None
    # The mean over one period of the alias has no flicker in it, and nearly all of the camera's motion.
    window = max(3, 2 * round(0.5 / (alias_hz * interval) - 0.5) + 1)
    steady = ndimage.binary_erosion(steady, np.ones(window), border_value=0)
    if steady.sum() < _LEAST_FRAMES:
        return None
    residual = log_rows - ndimage.uniform_filter1d(log_rows, window, axis=0)
    kept = 1 - np.sin(np.pi * alias_hz * interval * window) / (window * np.sin(np.pi * alias_hz * interval))
    used = residual[steady]
    scale = 1.4826 * float(np.median(np.abs(used))) + 1e-6
    used = np.clip(used, -3 * scale, 3 * scale) * np.hanning(bands + 2)[1:-1]
    position = (np.arange(bands) + 0.5) / bands
    most = min(_MOST_WAVES, 1.05 * nominal_hz * interval)  # a readout is no longer than the frame interval
    waves = np.arange(-most, most + _WAVE_STEP, _WAVE_STEP)
    over_rows = used @ np.exp(-2j * np.pi * position[:, None] * waves)  # [k, Q]
    time = pts_s[steady] - pts_s[steady][0]
    step = 0.5 / max(float(time[-1]), 1.0)
    frequency = nominal_hz + np.arange(-_DETUNING_HZ, _DETUNING_HZ + step, step)
    spectrum = np.abs(np.exp(-2j * np.pi * frequency[:, None] * time) @ over_rows) / len(time)
    peak = np.unravel_index(int(np.argmax(spectrum)), spectrum.shape)
    # Without a wave, the spectrum of noise has a Rayleigh distribution: as many cells as here hardly reach
    # 4 medians.
    ratio = float(spectrum[peak] / (np.median(spectrum) + 1e-12))  # frames may be all the same
    if ratio < _LEAST_RATIO:
        return None
    frequency_hz, wave = float(frequency[peak[0]]), float(waves[peak[1]])
    gain, depth = _follow(pts_s, residual / kept, steady, frequency_hz, wave, rows, interval)
    if depth < _LEAST_DEPTH:
        return None
    return ratio, Flicker(frequency_hz, depth, wave / frequency_hz, gain)


def _follow(
    pts_s: Floats,
    residual: Floats,
    steady: NDArray[np.bool_],
    frequency_hz: float,
    wave: float,
    rows: int,
    interval: float,
) -> tuple[Floats, float]:
    """The wave's gain [K, rows] with slowly changing amplitude and phase, and its mean amplitude."""
    bands = residual.shape[1]
    position = (np.arange(bands) + 0.5) / bands
    carrier = np.exp(2j * np.pi * (frequency_hz * pts_s[:, None] + wave * position))
    each = 2 * np.mean(residual * np.conj(carrier), axis=1) * steady
    width = _FOLLOW_S / interval
    smooth = _smooth(each.real, width) + 1j * _smooth(each.imag, width)
    amplitude = smooth / np.maximum(_smooth(steady.astype(float), width), 1e-3)
    at = (np.arange(rows) + 0.5) / rows
    carrier = np.exp(2j * np.pi * (frequency_hz * pts_s[:, None] + wave * at))
    return np.exp(np.real(amplitude[:, None] * carrier)), float(np.mean(np.abs(amplitude[steady])))


def _smooth(values: Floats, width: float) -> Floats:
    return np.asarray(ndimage.gaussian_filter1d(values, width, mode="nearest"), float)
