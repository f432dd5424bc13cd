"""When each pulse began and ended, for a given readout and exposure.

Model of `capture.tagging.shutter`: the gain of band b in frame k is rho = a g, with a the lit share and
g[b] the gain of a fully lit band, which is linear and solved in closed form inside (variable projection,
Golub and Pereyra 1973). What is left is one time per edge, whose likelihood is computed on a grid: it is
flat where no row looks (the gap between two frames' exposures) and may have several peaks, so neither a
single optimum nor a Gaussian would describe it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from capture.tagging.bands import BandGains
from capture.tagging.shutter import lit_share

Floats = NDArray[np.float64]

# A band's gain may differ by this share between pulses as the camera moves around the head, and it does so
# together with its neighbours: so many bands count as one in the prior.
_GAIN_FREEDOM, _GAIN_RUN = 0.3, 6
# Levels of refinement around a peak, each this many times finer: from a step of 1 ms to 0.01 ms, finer than
# any peak.
_REFINEMENTS, _FINER = 2, 10
# The first look at both edges together: this many grid steps apart for the one, this many ends for the other.
_COARSE_FACTOR, _COARSE_ENDS = 2, 8
# Factor of the soft cost: plain squares, so small that the plateau of edges no row looks at stays flat.
_SOFTENING = 0.05
# Log likelihoods within this of the maximum do not tell times apart.
_FLAT = 0.1
# A band whose gain is below this takes no part in the prior's share, which would pin it to zero.
_LEAST_GAIN = 1e-3
# Bands in a run over which errors are looked at for being shared: a quarter of the picture.
_RUN = 12
# Residuals smaller than expected make the weights larger only this far: a camera on a tripod leaves errors
# of the model.
_LEAST_SCALE2 = 0.5
# Numbers that are worked on together: as many as a processor's cache holds, a few pulses at a time.
_CACHED = 1 << 17
# Student-t degrees of freedom of a band's error: motion has heavy tails.
_TAIL = 3.0


@dataclass(frozen=True, eq=False)
class EdgeRange:
    """Where the edges of the pulses can lie at all: [P] seconds each."""

    on_low: Floats
    on_high: Floats
    off_low: Floats
    off_high: Floats

    def take(self, index: NDArray[np.int_]) -> EdgeRange:
        """The ranges of some pulses."""
        return EdgeRange(self.on_low[index], self.on_high[index], self.off_low[index], self.off_high[index])


@dataclass(frozen=True, eq=False)
class EdgeCurve:
    """Log likelihood of one kind of edge, for all pulses, on grids that are fine where it is high.

    Attributes:
        time_s: [P, G] increasing.
        log: [P, G] log likelihood relative to the maximum.
    """

    time_s: Floats
    log: Floats

    @property
    def best_s(self) -> Floats:
        """[P] most likely time; the middle of the plateau where the likelihood is flat."""
        top = self.log > -_FLAT
        low = np.where(top, self.time_s, np.inf).min(axis=1)
        high = np.where(top, self.time_s, -np.inf).max(axis=1)
        return 0.5 * (low + high)

    def probability(self, log_prior: Floats | None = None) -> Floats:
        """[P, G] posterior probability of each grid point's cell; the prior is flat when not given."""
        width = np.zeros_like(self.time_s)
        gap = 0.5 * np.diff(self.time_s, axis=1)
        width[:, :-1] += gap
        width[:, 1:] += gap
        log = self.log if log_prior is None else self.log + log_prior
        density = np.exp(log - log.max(axis=1, keepdims=True)) * width
        return density / density.sum(axis=1, keepdims=True)

    def log_mean(self) -> Floats:
        """[P] log of the likelihood's mean over the range: the evidence of a flat prior."""
        span = self.time_s[:, -1] - self.time_s[:, 0]
        return np.log(np.trapezoid(np.exp(self.log), self.time_s, axis=1) / span)

    def moments(self) -> tuple[Floats, Floats]:
        """[P] mean and [P] variance of the time under a flat prior."""
        weight = self.probability()
        mean = (weight * self.time_s).sum(axis=1)
        return mean, (weight * np.square(self.time_s - mean[:, None])).sum(axis=1)


@dataclass(frozen=True, eq=False)
class Edges:
    """What the data say of the edges of all pulses, for one readout and exposure.

    Attributes:
        on: likelihood of t_on.
        off: likelihood of t_off.
        best: [P] log likelihood of the data at the best edges.
        gain: [P, B] gain of fully lit bands at the best edges.
    """

    on: EdgeCurve
    off: EdgeCurve
    best: Floats
    gain: Floats


def find_edges(
    data: BandGains,
    edges: EdgeRange,
    readout_s: float,
    exposure_s: float,
    gain_prior: Floats,
    step_s: float,
) -> Edges:
    """Likelihoods of all edges.

    Args:
        data: band gains around the pulses.
        edges: search ranges.
        readout_s: ro.
        exposure_s: e.
        gain_prior: [B] usual gain of fully lit bands.
        step_s: grid step away from the peaks.
    """
    model = _Model(data, readout_s, exposure_s, gain_prior)
    # The edges meet in g: look at both together first, coarsely, then at each with the other held.
    on_s, off_s = _coarse_pair(model, edges, step_s)
    off, off_cost = _curve(lambda t: model.costs(on_s[:, None], t), edges.off_low, edges.off_high, step_s)
    off_s = off.best_s
    on, on_cost = _curve(lambda t: model.costs(t, off_s[:, None]), edges.on_low, edges.on_high, step_s)
    on_s = on.best_s
    return Edges(on=on, off=off, best=-0.5 * np.minimum(on_cost, off_cost), gain=model.gain(on_s, off_s))


def _coarse_pair(model: _Model, edges: EdgeRange, step_s: float) -> tuple[Floats, Floats]:
    """[P] t_on and [P] t_off of the least cost on a coarse grid of both."""
    count = int(np.ceil(float(np.max(edges.on_high - edges.on_low)) / (_COARSE_FACTOR * step_s))) + 1
    on_s = np.linspace(edges.on_low, edges.on_high, count, axis=1)
    off_s = np.linspace(edges.off_low, edges.off_high, _COARSE_ENDS, axis=1)
    pairs_on, pairs_off = np.repeat(on_s, _COARSE_ENDS, axis=1), np.tile(off_s, (1, count))
    at = np.argmin(model.costs(pairs_on, pairs_off)[1], axis=1)[:, None]
    return np.take_along_axis(pairs_on, at, axis=1)[:, 0], np.take_along_axis(pairs_off, at, axis=1)[:, 0]


def _curve(
    costs: Callable[[Floats], tuple[Floats, Floats]], low: Floats, high: Floats, step_s: float
) -> tuple[EdgeCurve, Floats]:
    """Likelihood on a grid that is refined around its peak, and the least cost.

    A peak can be a hundred times narrower than the grid and show at none of its points; the soft cost is
    wide enough to lead there.
    """
    count = max(int(np.ceil(float(np.max(high - low)) / step_s)) + 1, 3)
    time = np.linspace(low, high, count, axis=1)
    value, guide = costs(time)
    for level in range(_REFINEMENTS):
        reach = step_s / _FINER**level
        centre = EdgeCurve(time, -0.5 * (guide - guide.min(axis=1, keepdims=True))).best_s
        extra = centre[:, None] + np.linspace(-reach, reach, 2 * _FINER + 1)
        extra = np.clip(extra, low[:, None], high[:, None])
        time, value = np.concatenate([time, extra], axis=1), np.concatenate([value, costs(extra)[0]], axis=1)
        order = np.argsort(time, axis=1)
        time, value = np.take_along_axis(time, order, axis=1), np.take_along_axis(value, order, axis=1)
        guide = value
    least = value.min(axis=1)
    return EdgeCurve(time, -0.5 * (value - least[:, None])), least


class _Model:
    """Costs of candidate edges, all pulses at once."""

    def __init__(self, data: BandGains, readout_s: float, exposure_s: float, gain_prior: Floats):
        self._data, self._readout_s, self._exposure_s = data, readout_s, exposure_s
        self._prior = gain_prior
        self._prior_weight = 1.0 / _GAIN_RUN / (_GAIN_FREEDOM * np.maximum(gain_prior, _LEAST_GAIN)) ** 2
        self._weighted = data.weight * data.gain

    def _take(self, pulses: slice) -> _Model:
        """The model of some pulses."""
        return _Model(
            self._data.take(np.arange(len(self._data.gain))[pulses]),
            self._readout_s,
            self._exposure_s,
            self._prior,
        )

    def costs(self, on_s: Floats, off_s: Floats) -> tuple[Floats, Floats]:
        """[P, G] -2 log likelihood at edges [P, G or 1], and a soft version of it.

        A Student-t error per frame and band, and g's prior; in the soft version errors are taken for so much
        smaller that they are all in the error's quadratic middle.
        """
        pulses, frames, bands = self._data.gain.shape
        each = frames * bands * max(on_s.shape[1], off_s.shape[1])
        if pulses * each > _CACHED and pulses > 1:
            some = max(1, _CACHED // each)
            parts = [
                self._take(slice(p, p + some)).costs(on_s[p : p + some], off_s[p : p + some])
                for p in range(0, pulses, some)
            ]
            return np.concatenate([cost for cost, _ in parts]), np.concatenate([soft for _, soft in parts])
        lit = self._lit(on_s, off_s)
        gain = self._full_gain(lit)
        error2 = self._data.gain[:, None] - lit * gain[:, :, None]
        error2 *= error2
        error2 *= self._data.weight[:, None] / _TAIL
        prior = (np.square(gain - self._prior) * self._prior_weight).sum(axis=2)
        soft = error2.sum(axis=(2, 3)) * _SOFTENING
        error2 += 1.0
        # one logarithm of the product over frames; few frames, so it cannot overflow
        cost = (_TAIL + 1) * np.log(error2.prod(axis=2)).sum(axis=2)
        return cost + prior, soft

    def gain(self, on_s: Floats, off_s: Floats) -> Floats:
        """[P, B] gain of fully lit bands at edges [P]."""
        return self._full_gain(self._lit(on_s[:, None], off_s[:, None]))[:, 0]

    def _lit(self, on_s: Floats, off_s: Floats) -> Floats:
        """[P, G, n, B] lit shares."""
        start, bands = self._data.start_s[:, None, :], self._data.gain.shape[-1]
        return lit_share(start, on_s[..., None], off_s[..., None], self._readout_s, self._exposure_s, bands)

    def _full_gain(self, lit: Floats) -> Floats:
        """[P, G, B] least-squares gain of fully lit bands for lit shares [P, G, n, B]; not negative."""
        top = np.einsum("pgkb,pkb->pgb", lit, self._weighted) + self._prior_weight * self._prior
        bottom = np.einsum("pgkb,pgkb,pkb->pgb", lit, lit, self._data.weight) + self._prior_weight
        return np.maximum(top / bottom, 0)


def calibrated(data: BandGains, found: Edges, readout_s: float, exposure_s: float) -> BandGains:
    """The data with weights that fit the residuals: their scale, and that neighbouring bands err together.

    The scale is that of largest likelihood under the Student-t error. Over a run of bands, the variance of
    the mean of independent errors falls with the run's length; what it exceeds that by is how many bands it
    takes to count as one. A pulse whose residuals are larger than the others' (a reference that lost the
    motion) counts less than they do.
    """
    bands = data.gain.shape[-1]
    lit = lit_share(
        data.start_s, found.on.best_s[:, None], found.off.best_s[:, None], readout_s, exposure_s, bands
    )
    error = (data.gain - lit * found.gain[:, None]) * np.sqrt(data.weight)
    whole = _variance_factor(error[data.frames >= 0])
    each = [_variance_factor(e[f >= 0]) for e, f in zip(error, data.frames, strict=True)]
    factor = np.maximum(each, whole)
    return BandGains(data.start_s, data.gain, data.weight / factor[:, None, None], data.frames)


def _variance_factor(error: Floats) -> float:
    """By how much the variances of errors [n, B], in units of their expected sigma, are larger than
    expected."""
    square = np.square(error)
    scale2 = 1.0
    for _ in range(20):
        scale2 = max(float(np.mean((_TAIL + 1) * square / (_TAIL + square / scale2))), 1e-12)
    scale2 = max(scale2, _LEAST_SCALE2)
    limited = np.clip(error / np.sqrt(scale2), -3, 3)
    runs = limited.reshape(len(error), -1, _RUN).mean(axis=-1)
    together = _RUN * float(np.mean(runs**2)) / max(float(np.mean(limited**2)), 1e-12)
    return scale2 * max(together, 1.0)
