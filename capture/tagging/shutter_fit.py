"""Readout and exposure of a sequence, out of the rolling-shutter patterns of its pulses.

One partially lit frame gives only the ratios readout : exposure : edge time; stretched in time, it looks
the same. The absolute scale comes from edges seen in two frames, from how often an edge falls between two
frames' exposures, where no row sees it, and from regular pulses. All three are in the evidence (the
likelihood integrated over the edges), so readout and exposure are those of the largest evidence.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from capture.tagging.bands import BandGains
from capture.tagging.config import TaggingConfig
from capture.tagging.edges import EdgeRange, find_edges

Floats = NDArray[np.float64]

# Starts: the span from the first row's start to the last row's end in frame intervals, and the readout's
# share of it with its sign.
_SPANS = (0.15, 0.3, 0.5, 0.75, 1.0, 1.3)
_ROLLS = (-0.9, -0.7, -0.4, 0.0, 0.4, 0.7, 0.9)
# Spans that are tried at the found roll: the evidence has several peaks along it, or none at all.
_ALL_SPANS = np.geomspace(0.1, 2.0, 36)
# Rolling shutters of phones take 10 to 33 ms at 30 frames a second: normal in log span. It decides only
# where nothing else does.
_USUAL_SPAN, _USUAL_WIDTH = 0.65, 0.6
# A hump of the evidence wider than this, in log span, is taken by its mean; it is one step of the spans.
_SHARP = 0.08
# More pulses sharpen the coarse search, and the fit, no further.
_FEW, _MOST = 8, 16
# Bands that are made one here: their slopes stay resolved, and the cost is halved.
_MERGE = 2
# Scales of irregularity that are tried, seconds: a microcontroller's timer to a phone's busy user interface.
_IRREGULARITIES = np.geomspace(5e-5, 0.05, 16)
_SHORTEST_EXPOSURE_S = 1e-4
# Distances from the peak at which the evidence's fall is measured, in log span and in roll.
_REACHES = (0.01, 0.03, 0.1, 0.3)
# Doubt of the readout that moves the limits of labels by no more than edges are known.
_SMALL_S = 3e-4
# Grid steps of the edge search: several to an exposure, down to what the refinement resolves.
_EDGE_STEPS_S = (5e-4, 1e-3)


@dataclass(frozen=True)
class Shutter:
    """Readout and exposure with standard deviations.

    Attributes:
        readout_s: from the first row's start to the last row's, negative when the bottom row is first.
        exposure_s: of a row.
        readout_sigma_s: standard deviation of the readout.
        exposure_sigma_s: standard deviation of the exposure.
        stretch_sigma: standard deviation of a common factor on both, which the pictures alone do not fix.
        readout_doubt_s: how far the readout alone may be off beyond that; labels must hold all the same.
    """

    readout_s: float
    exposure_s: float
    readout_sigma_s: float
    exposure_sigma_s: float
    stretch_sigma: float
    readout_doubt_s: float = 0.0

    @property
    def certain(self) -> bool:
        """Whether labels need not be averaged over what is not known."""
        return self.stretch_sigma <= 0 and self.readout_doubt_s <= _SMALL_S

    @property
    def small_doubt_s(self) -> float:
        """A doubt of the readout that is an edge's slack rather than another shutter."""
        return self.readout_doubt_s if self.readout_doubt_s <= _SMALL_S else 0.0

    def stretched(self, sigmas: float) -> tuple[float, float]:
        """(readout, exposure) so many standard deviations along the common factor, and along the doubt."""
        factor = float(np.exp(sigmas * self.stretch_sigma))
        return self.readout_s * factor + sigmas * self.readout_doubt_s, self.exposure_s * factor


def fit_shutter(
    data: BandGains,
    edges: EdgeRange,
    cycle: NDArray[np.int_],
    gain_prior: Floats,
    interval_s: float,
    config: TaggingConfig,
    commanded_s: Floats | None = None,
) -> Shutter:
    """Fit readout and exposure.

    Args:
        data: band gains around the pulses.
        edges: search ranges of the edges.
        cycle: [P] number of the flash period that a pulse belongs to; -1 = none known.
        gain_prior: [B] usual gain of fully lit bands.
        interval_s: from frame to frame.
        config: known exposure and readout.
        commanded_s: [P] when each pulse was told to go on, by a clock that runs with the frames', NaN = not
            known; None = none is.
    """
    if config.readout_s is not None and config.exposure_s is not None:
        return Shutter(config.readout_s, config.exposure_s, 0.0, 0.0, 0.0, config.readout_sigma_s)
    data, gain_prior = data.merged(_MERGE), gain_prior.reshape(-1, _MERGE).mean(axis=1)
    most = _thin(len(data.start_s), _MOST)
    asked_s = np.full(len(cycle), np.nan) if commanded_s is None else commanded_s
    problem = _Problem(
        data.take(most), edges.take(most), cycle[most], asked_s[most], gain_prior, interval_s, config
    )
    few = _thin(len(most), _FEW)
    coarse = problem.take(few)
    starts = [(np.log(span), roll) for span in _SPANS for roll in _ROLLS]
    best = max(starts, key=coarse.evidence)
    best = coarse.climb(best, 25)
    best, stretch = problem.stretch(best)
    if stretch is None:
        best = problem.climb(best, 30)
        stretch = problem.sigma(best, 0)
    roll = problem.sigma(best, 1)
    readout_s, exposure_s = problem.times(best)
    span = abs(readout_s) + exposure_s
    return Shutter(
        readout_s=readout_s,
        exposure_s=exposure_s,
        readout_sigma_s=0.0
        if config.readout_s is not None
        else float(np.hypot(stretch * readout_s, roll * span)),
        exposure_sigma_s=0.0
        if config.exposure_s is not None
        else float(np.hypot(stretch * exposure_s, roll * span)),
        stretch_sigma=0.0 if config.readout_s is not None or config.exposure_s is not None else stretch,
        readout_doubt_s=0.0 if config.readout_s is None else config.readout_sigma_s,
    )


def _thin(count: int, most: int) -> NDArray[np.int_]:
    """At most so many indices, evenly spread."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))


class _Problem:
    """The evidence as a function of (log span, roll)."""

    def __init__(
        self,
        data: BandGains,
        edges: EdgeRange,
        cycle: NDArray[np.int_],
        commanded_s: Floats,
        gain_prior: Floats,
        interval_s: float,
        config: TaggingConfig,
    ):
        self.data, self.edges, self.cycle, self._commanded_s = data, edges, cycle, commanded_s
        self._gain_prior, self._interval_s, self._config = gain_prior, interval_s, config

    def take(self, index: NDArray[np.int_]) -> _Problem:
        """The evidence of some pulses."""
        return _Problem(
            self.data.take(index),
            self.edges.take(index),
            self.cycle[index],
            self._commanded_s[index],
            self._gain_prior,
            self._interval_s,
            self._config,
        )

    def times(self, x: tuple[float, float]) -> tuple[float, float]:
        """(readout, exposure) in seconds, with what the configuration knows."""
        span = self._interval_s * float(np.exp(x[0]))
        readout_s, exposure_s = x[1] * span, (1 - abs(x[1])) * span
        if self._config.readout_s is not None:
            readout_s = self._config.readout_s
        if self._config.exposure_s is not None:
            exposure_s = self._config.exposure_s
        return readout_s, exposure_s

    def evidence(self, x: tuple[float, float]) -> float:
        """Log evidence; -inf outside what a sensor can do: rows are read and exposed once a frame."""
        readout_s, exposure_s = self.times(x)
        if not (
            abs(readout_s) <= 1.05 * self._interval_s
            and _SHORTEST_EXPOSURE_S <= exposure_s <= self._interval_s
        ):
            return -np.inf
        step_s = float(np.clip(exposure_s / 4, *_EDGE_STEPS_S))
        found = find_edges(self.data, self.edges, readout_s, exposure_s, self._gain_prior, step_s)
        value = float(np.sum(found.best + found.on.log_mean() + found.off.log_mean()))
        value -= 0.5 * ((x[0] - np.log(_USUAL_SPAN)) / _USUAL_WIDTH) ** 2
        on_s, on_variance = found.on.moments()
        off_s, off_variance = found.off.moments()
        ones = np.ones(len(on_s))
        value += _regularity(off_s - on_s, on_variance + off_variance, [ones])
        asked = np.flatnonzero(np.isfinite(self._commanded_s))
        if len(asked) > 3:  # a lamp is late by the same time, or nearly
            late_s = on_s[asked] - self._commanded_s[asked]
            value += _regularity(late_s - late_s[0], on_variance[asked], [np.ones(len(asked))])
        known = np.flatnonzero(self.cycle >= 0)
        if len(known) > 3:
            t, variance, n = on_s[known] - on_s[known[0]], on_variance[known], self.cycle[known].astype(float)
            # a microcontroller keeps to a line in time; a phone only keeps a distance from pulse to pulse
            periods = np.diff(n)
            value += max(
                _regularity(t, variance, [np.ones(len(n)), n]),
                _regularity(
                    np.diff(t) / periods, (variance[1:] + variance[:-1]) / periods**2, [np.ones(len(periods))]
                ),
            )
        return value

    def climb(self, x: tuple[float, float], evaluations: int) -> tuple[float, float]:
        """A local maximum of the evidence (Nelder and Mead 1965)."""
        simplex = np.array([x, (x[0] + 0.1, x[1]), (x[0], x[1] + (0.08 if x[1] < 0.5 else -0.08))])
        found = optimize.minimize(
            lambda y: min(-self.evidence((y[0], y[1])), 1e12),
            simplex[0],
            method="Nelder-Mead",
            options={"initial_simplex": simplex, "maxfev": evaluations, "xatol": 2e-3, "fatol": 0.05},
        )
        return float(found.x[0]), float(found.x[1])

    def stretch(self, x: tuple[float, float]) -> tuple[tuple[float, float], float | None]:
        """The best stretch of the span, and how well it is known; None when there is one sharp peak to climb.

        Where the pulses are irregular the evidence is a wide hump, rough by what the edge search leaves:
        its mean and width are the answer, not its highest point.
        """
        logs = np.log(_ALL_SPANS)
        evidence = np.array([self.evidence((value, x[1])) for value in logs])
        possible = np.isfinite(evidence)
        if not possible.any():
            return x, None
        evidence = np.where(possible, evidence, evidence[possible].min() - 20)
        smooth = np.convolve(np.pad(evidence, 1, mode="edge"), [0.25, 0.5, 0.25], mode="valid")
        weight = np.exp(smooth - smooth.max())
        weight /= weight.sum()
        mean = float(weight @ logs)
        width = float(np.sqrt(weight @ np.square(logs - mean)))
        if width > _SHARP:
            return (mean, x[1]), width
        return (float(logs[np.argmax(evidence)]), x[1]), None

    def sigma(self, x: tuple[float, float], axis: int) -> float:
        """Standard deviation along one parameter: the distance at which the evidence falls, taken for a
        normal's."""
        top = self.evidence(x)
        for reach in _REACHES:
            fall = [
                top - self.evidence((x[0] + side * reach * (axis == 0), x[1] + side * reach * (axis == 1)))
                for side in (-1, 1)
            ]
            finite = [f for f in fall if np.isfinite(f)]
            if not finite or sum(finite) / len(finite) > 1:  # beyond the peak's roughness
                break
        mean = sum(finite) / len(finite) if finite else np.inf
        return float(reach / np.sqrt(2 * max(mean, 0.5)))


def _regularity(values: Floats, variance: Floats, basis: list[Floats]) -> float:
    """Log likelihood that measured times are a linear model plus an irregularity, at its most likely
    scale."""
    columns = np.stack(basis, axis=1)
    best = -np.inf
    for scale in _IRREGULARITIES:
        total = variance + scale**2
        root = 1 / np.sqrt(total)
        solution = np.linalg.lstsq(columns * root[:, None], values * root, rcond=None)[0]
        chi2 = float(np.sum(np.square(values - columns @ solution) / total))
        best = max(best, -0.5 * (float(np.sum(np.log(total))) + chi2))
    return best
