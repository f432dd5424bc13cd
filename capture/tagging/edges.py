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
# Around a peak the grid is so many times finer, and as much again: from a step of 1 ms to 0.01 ms.
_FINER = 10
# The first look at both edges together: so many grid steps apart for the one, so many ends for the other,
# and so many bands made one, for it need not be sharp.
_COARSE_FACTOR, _COARSE_ENDS, _MERGE = 3, 24, 4
# Turns of the pattern search: on the soft cost from 4 ms to 1 ms, on the sharp one from 1 ms to 0.003 ms.
_SOFT_TURNS, _SHARP_TURNS = 4, 10
# Offsets of the pattern, the centre first, so that a plateau does not make it walk.
_AROUND = np.array([(0, 0), *((i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j)], float).T
# Log likelihoods within this of the maximum do not tell times apart.
_FLAT = 0.1
# A band whose gain is below this takes no part in the prior's share, which would pin it to zero.
_LEAST_GAIN = 1e-3
# Bands in a run over which errors are looked at for being shared: a quarter of the picture.
_RUN = 12
# Residuals smaller than expected make the weights larger only this far: a camera on a tripod leaves errors
# of the model.
_LEAST_SCALE2 = 0.5
#: Student-t degrees of freedom of a band's error: motion has heavy tails.
TAIL = 3.0


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
    coarse_prior = gain_prior.reshape(-1, _MERGE).mean(axis=1)
    coarse = _Model(data.merged(_MERGE), readout_s, exposure_s, coarse_prior)
    # The edges meet in g: find both together, then ask for each with the other held.
    on_s, off_s = _best_pair(model, coarse, edges, step_s)
    off, off_cost = _curve(
        lambda t: model.cost(on_s[:, None], t), edges.off_low, edges.off_high, step_s, off_s
    )
    on, on_cost = _curve(lambda t: model.cost(t, off_s[:, None]), edges.on_low, edges.on_high, step_s, on_s)
    best = -0.5 * np.minimum(on_cost, off_cost)
    return Edges(on=on, off=off, best=best, gain=model.gain(on.best_s, off.best_s))


def _best_pair(model: _Model, coarse: _Model, edges: EdgeRange, step_s: float) -> tuple[Floats, Floats]:
    """[P] t_on and [P] t_off of the least cost.

    The valley of the cost can be a hundred times narrower than any grid: a soft cost leads near it, and a
    pattern search (Hooke and Jeeves 1961), with diagonals, into it.
    """
    count = int(np.ceil(float(np.max(edges.on_high - edges.on_low)) / (_COARSE_FACTOR * step_s))) + 1
    on_s = np.linspace(edges.on_low, edges.on_high, count, axis=1)
    off_s = np.linspace(edges.off_low, edges.off_high, _COARSE_ENDS, axis=1)
    on_reach, off_reach = on_s[:, 1:2] - on_s[:, :1], off_s[:, 1:2] - off_s[:, :1]
    tried = np.repeat(on_s, _COARSE_ENDS, axis=1), np.tile(off_s, (1, count))
    for turn in range(_SOFT_TURNS + _SHARP_TURNS):
        cost = coarse.squares(*tried) if turn < _SOFT_TURNS else model.cost(*tried)
        at = np.argmin(cost, axis=1)[:, None]
        on_s, off_s = (np.take_along_axis(times, at, axis=1) for times in tried)
        if turn == _SOFT_TURNS - 1:
            on_reach = off_reach = np.full_like(on_s, step_s)
        shrink = np.where(at == 0, 0.5, 1.0) if turn else 0.5
        on_reach, off_reach = shrink * on_reach, shrink * off_reach
        tried = (
            np.clip(on_s + on_reach * _AROUND[0], edges.on_low[:, None], edges.on_high[:, None]),
            np.clip(off_s + off_reach * _AROUND[1], edges.off_low[:, None], edges.off_high[:, None]),
        )
    return on_s[:, 0], off_s[:, 0]


def _curve(
    cost: Callable[[Floats], Floats], low: Floats, high: Floats, step_s: float, peak_s: Floats
) -> tuple[EdgeCurve, Floats]:
    """Likelihood on a grid that is fine around its peak, and the least cost."""
    count = max(int(np.ceil(float(np.max(high - low)) / step_s)) + 1, 3)
    near = np.linspace(-step_s, step_s, 2 * _FINER + 1)
    fine = peak_s[:, None] + np.concatenate([near, near / _FINER])
    time = np.concatenate([np.linspace(low, high, count, axis=1), fine], axis=1)
    time = np.sort(np.clip(time, low[:, None], high[:, None]), axis=1)
    value = cost(time)
    least = value.min(axis=1)
    return EdgeCurve(time, -0.5 * (value - least[:, None])), least


class _Model:
    """Costs of candidate edges, all pulses at once."""

    def __init__(self, data: BandGains, readout_s: float, exposure_s: float, gain_prior: Floats):
        self._data, self._readout_s, self._exposure_s = data, readout_s, exposure_s
        self._prior = gain_prior
        self._prior_weight = 1.0 / _GAIN_RUN / (_GAIN_FREEDOM * np.maximum(gain_prior, _LEAST_GAIN)) ** 2
        self._weighted = data.weight * data.gain

    def cost(self, on_s: Floats, off_s: Floats) -> Floats:
        """[P, G] -2 log likelihood at edges [P, G or 1]: Student-t errors of all bands, and g's prior."""
        error2, gain = self._squared_errors(on_s, off_s)
        error2 /= TAIL
        error2 += 1.0
        # one logarithm of the product over frames; few frames, so it cannot overflow
        cost = (TAIL + 1) * np.log(error2.prod(axis=2)).sum(axis=2)
        return cost + (np.square(gain - self._prior) * self._prior_weight).sum(axis=2)

    def squares(self, on_s: Floats, off_s: Floats) -> Floats:
        """[P, G] plain sum of squared errors: a soft cost, whose valley is wide."""
        return self._squared_errors(on_s, off_s)[0].sum(axis=(2, 3))

    def _squared_errors(self, on_s: Floats, off_s: Floats) -> tuple[Floats, Floats]:
        """[P, G, n, B] squared errors in units of their variance, and [P, G, B] gains."""
        lit = self._lit(on_s, off_s)
        gain = self._full_gain(lit)
        error2 = self._data.gain[:, None] - lit * gain[:, :, None]
        error2 *= error2
        error2 *= self._data.weight[:, None]
        return error2, gain

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
        scale2 = max(float(np.mean((TAIL + 1) * square / (TAIL + square / scale2))), 1e-12)
    scale2 = max(scale2, _LEAST_SCALE2)
    limited = np.clip(error / np.sqrt(scale2), -3, 3)
    runs = limited.reshape(len(error), -1, _RUN).mean(axis=-1)
    together = _RUN * float(np.mean(runs**2)) / max(float(np.mean(limited**2)), 1e-12)
    return scale2 * max(together, 1.0)
