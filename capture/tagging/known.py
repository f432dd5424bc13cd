"""What the frames so far have taught of a flash and a camera, for the frames to come.

A camera's shutter does not change while its controls are locked, and a lamp keeps its pattern. Each stretch
of frames gives readout and exposure anew; together they are known better, and after some there is nothing
left to learn.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from capture.tagging.config import TaggingConfig
from capture.tagging.shutter_fit import Shutter

Floats = NDArray[np.float64]

# Fits of the shutter after which no more are made: when the span is known to this share, and in any case.
_ENOUGH, _SETTLED, _MOST = 6, 0.004, 24
# What every fit leaves, however sharp its evidence: the model's share (a lamp that rises, time stamps).
_LEAST_SIGMA = 0.003
# A fit farther from the others' middle than this many standard deviations is another peak of the evidence.
_OUTLIER = 5.0
# Pulses and commands belong together within this: a phone's jank, and an interval of frames.
_TOLERANCE_S = 0.12
# Fewer matches than this share of the pulses leave the commands unproved.
_LEAST_MATCHED = 0.5
_LEAST_LOCKED = 3


class KnownFlash:
    """Shutter, and the light's pattern over the picture."""

    def __init__(self) -> None:
        """Nothing is known."""
        self.pattern: Floats | None = None
        self.map: Floats | None = None
        self.log_gain = 0.0
        self._fits: list[Shutter] = []

    def learn_pattern(self, pattern: Floats, map_: Floats, log_gain: float) -> None:
        """Takes the latest pattern: the camera walks, and what the lamp lights in the picture changes.

        Args:
            pattern: [n, n] log gain.
            map_: unit vector of the light over the picture.
            log_gain: mean log gain of lit frames.
        """
        self.pattern, self.map, self.log_gain = pattern, map_, log_gain

    def learn_shutter(self, fit: Shutter) -> None:
        """Takes one more fit, independent of the others."""
        self._fits.append(fit)

    @property
    def empty(self) -> bool:
        """Whether no shutter has been fitted yet."""
        return not self._fits

    @property
    def shutter_settled(self) -> bool:
        """Whether further fits would not make the shutter known better."""
        if len(self._fits) < _ENOUGH:
            return False
        return len(self._fits) >= _MOST or self.shutter(TaggingConfig()).stretch_sigma < _SETTLED

    def shutter(self, config: TaggingConfig) -> Shutter:
        """The mean of the fits in log span and roll, each weighted by its precision, outliers left out.

        Args:
            config: what is known of the shutter stays as it is.
        """
        if len(self._fits) == 1:
            return self._fits[0]
        span = np.array([abs(fit.readout_s) + fit.exposure_s for fit in self._fits])
        log_span, stretch = _mean(np.log(span), np.array([_stretch(fit) for fit in self._fits]))
        roll, roll_sigma = _mean(
            np.array([fit.readout_s for fit in self._fits]) / span,
            np.array([_roll_sigma(fit) for fit in self._fits]),
        )
        total = float(np.exp(log_span))
        readout_s, exposure_s = roll * total, (1 - abs(roll)) * total
        known = config.readout_s is not None or config.exposure_s is not None
        return Shutter(
            readout_s=readout_s if config.readout_s is None else config.readout_s,
            exposure_s=exposure_s if config.exposure_s is None else config.exposure_s,
            readout_sigma_s=float(np.hypot(stretch * readout_s, roll_sigma * total))
            if config.readout_s is None
            else 0.0,
            exposure_sigma_s=float(np.hypot(stretch * exposure_s, roll_sigma * total))
            if config.exposure_s is None
            else 0.0,
            stretch_sigma=0.0 if known else stretch,
        )


@dataclass(frozen=True, eq=False)
class Commands:
    """When the flash was told to go on.

    Attributes:
        times_s: [N] increasing, by a clock that runs with the frames'.
        offset_s: what to add to come to the frames' time; None = not known yet.
        on_s: how long each was to last; None = not known.
    """

    times_s: Floats
    offset_s: float | None
    on_s: float | None = None

    def partners(self, on_s: Floats) -> tuple[NDArray[np.int_], float] | None:
        """Each pulse's command, -1 = none, and the offset; None when the two do not agree.

        Args:
            on_s: [P] starts of pulses, increasing.
        """
        least = _LEAST_LOCKED if self.offset_s is None else 1
        if len(self.times_s) < least or len(on_s) < least:
            return None
        found: tuple[int, float, NDArray[np.int_], float] | None = None
        for start_s in self._offsets(on_s):
            offset_s = start_s
            for _ in range(2):  # the nearest command at a coarse offset, then at the matches' own
                partner = _nearest(self.times_s + offset_s, on_s)
                late = on_s - self.times_s[partner] - offset_s
                near = np.abs(late) <= _TOLERANCE_S
                if not near.any():
                    break
                offset_s += float(np.median(late[near]))
            matched = len(np.unique(partner[near]))
            rank = (matched, -abs(offset_s))
            if found is None or rank > found[:2]:
                found = (*rank, np.where(near, partner, -1), offset_s)
        if found is None or found[0] < max(least, _LEAST_MATCHED * len(on_s)):
            return None
        return _once(found[2], on_s - self.times_s[found[2]]), found[3]

    def _offsets(self, on_s: Floats) -> list[float]:
        if self.offset_s is not None:
            return [self.offset_s]
        # the first pulses against every command: one of them is right
        pairs = (on_s[:_LEAST_LOCKED, None] - self.times_s).ravel()
        return [float(value) for value in np.unique(np.round(pairs, 2))]


def _once(partner: NDArray[np.int_], late: Floats) -> NDArray[np.int_]:
    """No command twice: of two pulses that claim one, the nearer to the usual lateness keeps it."""
    usual = float(np.median(late[partner >= 0]))
    out = partner.copy()
    for command in np.unique(partner[partner >= 0]):
        claim = np.flatnonzero(partner == command)
        out[claim[np.argsort(np.abs(late[claim] - usual))[1:]]] = -1
    return out


def _nearest(times: Floats, t: Floats) -> NDArray[np.int_]:
    """Index of the time nearest to each t."""
    if len(times) == 1:
        return np.zeros(len(t), int)
    right = np.clip(np.searchsorted(times, t), 1, len(times) - 1)
    return right - (t - times[right - 1] < times[right] - t)


def _stretch(fit: Shutter) -> float:
    """Standard deviation of the log span; of a fit that knows one of the two, by the other."""
    span = abs(fit.readout_s) + fit.exposure_s
    return fit.stretch_sigma or float(np.hypot(fit.readout_sigma_s, fit.exposure_sigma_s)) / span


def _roll_sigma(fit: Shutter) -> float:
    """Standard deviation of readout over span, as `fit_shutter` combined it."""
    span = abs(fit.readout_s) + fit.exposure_s
    return float(np.sqrt(max(fit.exposure_sigma_s**2 - (_stretch(fit) * fit.exposure_s) ** 2, 0.0))) / span


def _mean(values: Floats, sigma: Floats) -> tuple[float, float]:
    """Weighted mean without outliers, and its standard deviation by the larger of formal and seen scatter."""
    sigma = np.hypot(sigma, _LEAST_SIGMA)
    order = np.argsort(values)
    total = np.cumsum(1 / sigma[order] ** 2)
    middle = values[order][np.searchsorted(total, 0.5 * total[-1])]
    kept = np.abs(values - middle) <= _OUTLIER * sigma
    weight = kept / sigma**2
    mean = float(weight @ values / weight.sum())
    scatter = float(weight @ np.square(values - mean)) / max(int(kept.sum()) - 1, 1)
    return mean, float(np.sqrt(max(1.0, scatter) / weight.sum()))
