"""The rhythm of the pulses: a free period, missed and extra pulses, and what regular neighbours say of an
edge.

Android's timers wait a fixed time *after* the last firing, so lateness adds up and no line t0 + n T fits
for long; a microcontroller's do not. Both are a random walk of the pulses' lateness, with a small step or a
large one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft, optimize

from capture.tagging.config import TaggingConfig
from capture.tagging.edges import EdgeCurve

Floats = NDArray[np.float64]

# A pulse belongs to the rhythm when it is off by less than this share of the period: a phone's worst jank.
_TOLERANCE = 0.12
# In the chain's score a missed pulse costs this much of a found one: half the period explains all pulses
# too, but misses every other one; the double period finds only half of them.
_MISSED_COST = 0.4
# Scales of the random walk's step that are tried, seconds: a microcontroller's timer to a phone's busy user
# interface.
_STEPS_S = np.geomspace(1e-4, 0.03, 8)
# Floor of a neighbours' density against its peak: what they say is never taken for certain.
_LEAST_DENSITY = 1e-6
# Lateness has heavy tails: so many steps are so many times larger, and some follow no rule at all (a phone
# that hangs).
_LARGE_SHARE, _LARGE_FACTOR, _LAWLESS = 0.15, 6.0, 0.01
# Pulses from which step and period are learnt.
_MOST_PULSES = 60


@dataclass(frozen=True, eq=False)
class Rhythm:
    """The pulses' place in a periodic schedule.

    Attributes:
        period_s: mean time from pulse to pulse.
        period_sigma_s: its standard deviation.
        jitter_s: robust standard deviation of one step's lateness.
        cycle: [P] number of the period that each pulse belongs to; -1 = an extra pulse.
        missed: cycles inside the sequence without a pulse.
    """

    period_s: float
    period_sigma_s: float
    jitter_s: float
    cycle: NDArray[np.int_]
    missed: tuple[int, ...]


def fit_rhythm(time_s: Floats, config: TaggingConfig) -> Rhythm | None:
    """Find the period and each pulse's number; None for fewer than three pulses that share one.

    Args:
        time_s: [P] pulse times, increasing.
        config: limits of the period.
    """
    if len(time_s) < 3:
        return None
    best_score, best_chain, best_period = 0.0, np.zeros(0, int), 0.0
    for period_s in _candidate_periods(time_s, config):
        score, chain = _longest_chain(time_s, period_s)
        if score > best_score:
            best_score, best_chain, best_period = score, chain, period_s
    if len(best_chain) < 3:
        return None
    steps = np.round(np.diff(time_s[best_chain]) / best_period).astype(int)
    cycles = np.concatenate([[0], np.cumsum(steps)])
    apart = np.diff(time_s[best_chain]) / steps
    period_s = float(np.median(apart))
    jitter_s = 1.4826 * float(np.median(np.abs(apart - period_s)))
    if jitter_s < 0.02 * period_s:  # a clean rhythm: the mean over all of it is more precise than the median
        period_s = float((time_s[best_chain[-1]] - time_s[best_chain[0]]) / cycles[-1])
    cycle = np.full(len(time_s), -1)
    cycle[best_chain] = cycles
    missed = tuple(sorted(set(range(int(cycles[-1]))) - set(cycles.tolist())))
    return Rhythm(period_s, float(max(jitter_s, 1e-5) / np.sqrt(len(steps))), jitter_s, cycle, missed)


def _candidate_periods(time_s: Floats, config: TaggingConfig) -> list[float]:
    """Differences of near pulses over small integers, those within 3 % of each other once."""
    found: list[float] = []
    for lag in (1, 2, 3):
        for apart in time_s[lag:] - time_s[:-lag]:
            for parts in (1, 2, 3, 4):
                period_s = float(apart) / parts
                if config.shortest_period_s <= period_s <= config.longest_period_s and all(
                    abs(period_s / other - 1) > 0.03 for other in found
                ):
                    found.append(period_s)
    return found


def _longest_chain(time_s: Floats, period_s: float) -> tuple[float, NDArray[np.int_]]:
    """Best sequence of pulses whose steps are whole periods (dynamic programming): its score and its
    members."""
    count = len(time_s)
    score, before = np.ones(count), np.full(count, -1)
    for i in range(1, count):
        j = np.arange(max(0, i - 12), i)
        periods = (time_s[i] - time_s[j]) / period_s
        whole = np.round(periods)
        off = np.abs(periods - whole) / _TOLERANCE
        total = np.where(
            (whole >= 1) & (off < 1), score[j] + 1 - 0.2 * off**2 - _MISSED_COST * (whole - 1), -np.inf
        )
        if len(total) and total.max() > score[i]:
            score[i], before[i] = total.max(), j[int(np.argmax(total))]
    at = int(np.argmax(score))
    chain = [at]
    while before[chain[-1]] >= 0:
        chain.append(int(before[chain[-1]]))
    return float(score[at]), np.array(chain[::-1])


@dataclass(frozen=True)
class Hypothesis:
    """A way in which pulses may be regular: its probability, the period, the scale of a step's lateness."""

    weight: float
    period_s: float
    step_s: float


def neighbours_log_prior(
    curve: EdgeCurve,
    cycle: NDArray[np.int_],
    period_s: float,
    hypotheses: Sequence[Hypothesis] | None = None,
) -> tuple[Floats, Sequence[Hypothesis]]:
    """What the other pulses say of each edge's time: [P, G] log density on the curve's grid, leaving the
    pulse itself out.

    The lateness u = t - n T is a random walk over the cycles n; forward and backward messages of the walk
    (Rabiner 1989) meet at each pulse. The step is averaged over, so an irregular flash gives a wide density
    and a regular one a sharp density, also where all edges fall into the gap between two frames.

    The hypotheses come back too: they are most of the work, and serve again for curves that hardly differ.
    """
    log_prior = np.zeros_like(curve.log)
    known = np.flatnonzero(cycle >= 0)
    if len(known) < 3:
        return log_prior, ()
    walk = _Walk(curve, known, cycle[known], period_s)
    density = np.zeros((len(known), curve.time_s.shape[1]))
    hypotheses = hypotheses or walk.hypotheses()
    for likely in hypotheses:
        for i, (time_s, message) in enumerate(walk.messages(likely.period_s, likely.step_s)):
            density[i] += likely.weight * np.interp(curve.time_s[known[i]], time_s, message)
    log_prior[known] = np.log(density / density.max(axis=1, keepdims=True) + _LEAST_DENSITY)
    return log_prior, hypotheses


class _Walk:
    """Lateness of one kind of edge as a random walk on a grid."""

    def __init__(self, curve: EdgeCurve, known: NDArray[np.int_], cycle: NDArray[np.int_], period_s: float):
        self._time, self._cycle = curve.time_s[known], cycle
        # likelihood integrated over time, so that a grid cell gets what lies in it however narrow the peak
        cell = curve.probability()[known]
        self._mass = np.cumsum(cell, axis=1) - 0.5 * cell
        self._period_s = period_s
        self._kernels: dict[tuple[int, float], _Spread] = {}
        late = curve.best_s[known] - cycle * period_s
        self._origin = float(np.median(late))
        self._reach = float(np.max(np.abs(late - self._origin)) + np.ptp(self._time, axis=1).max())

    def hypotheses(self) -> list[Hypothesis]:
        """Each step that is at all likely, with the period that is most likely for it."""
        last = min(len(self._cycle), _MOST_PULSES)
        span = float(self._cycle[last - 1] - self._cycle[0])
        found: list[tuple[float, float, float]] = []
        for step_s in _STEPS_S[::-1]:
            centre = max(found)[1] if found else self._period_s
            # the mean of a walk of n steps is known to step / sqrt(n)
            reach = 3 * max([float(step_s), *(f[2] for f in found[-1:])]) / np.sqrt(span) + 2e-4 / span
            best = optimize.minimize_scalar(
                lambda period_s, s=step_s: -self._pass(last, period_s, s)[0],
                bounds=(centre - reach, centre + reach),
                method="bounded",
                options={"maxiter": 10, "xatol": 0.3 * step_s / span},
            )
            # The likelihood integrated over the period, not its peak: a regular flash fits only a narrow
            # range of periods, and what a few pulses do by chance must not count as regular.
            width = float(np.log(step_s / np.sqrt(span)))
            found.append((-float(best.fun) + width, float(best.x), float(step_s)))
        highest = max(found)[0]
        weights = [float(np.exp(value - highest)) for value, _, _ in found]
        return [
            Hypothesis(weight / sum(weights), period_s, step_s)
            for weight, (_, period_s, step_s) in zip(weights, found, strict=True)
            if weight > 1e-3
        ]

    def messages(self, period_s: float, step_s: float) -> list[tuple[Floats, Floats]]:
        """Per pulse: times, and the density that all other pulses give there."""
        count = len(self._cycle)
        _, ahead = self._pass(count, period_s, step_s)
        _, back = self._pass(count, period_s, step_s, backward=True)
        grid = self._grid(step_s)
        spacing = grid[1] - grid[0]
        return [
            (grid + self._origin + n * period_s, a * b / max(float((a * b).sum()) * spacing, 1e-300))
            for n, a, b in zip(self._cycle, ahead, back, strict=True)
        ]

    def _grid(self, step_s: float) -> Floats:
        # a quarter of the walk's step resolves its spread
        spacing = 0.25 * step_s
        return np.arange(-self._reach, self._reach + spacing, spacing)

    def _pass(
        self, count: int, period_s: float, step_s: float, backward: bool = False
    ) -> tuple[float, list[Floats]]:
        """Log likelihood of the first pulses, and the message that reaches each pulse before its own data."""
        grid = self._grid(step_s)
        spacing = grid[1] - grid[0]
        borders = np.append(grid - 0.5 * spacing, grid[-1] + 0.5 * spacing)
        flat = np.full(len(grid), 1.0 / len(grid))
        order = list(range(count))[:: -1 if backward else 1]
        belief, total, messages = flat, 0.0, []
        for place, i in enumerate(order):
            message = flat
            if place:
                periods = abs(int(self._cycle[i] - self._cycle[order[place - 1]]))
                spread = step_s * np.sqrt(periods) / spacing
                key = len(grid), float(spread)
                if key not in self._kernels:
                    self._kernels[key] = _Spread(*key)
                message = (1 - _LAWLESS) * self._kernels[key](belief) + _LAWLESS * flat
            messages.append(message)
            late = self._time[i] - self._cycle[i] * period_s - self._origin
            belief = message * np.diff(np.interp(borders, late, self._mass[i])) / spacing + 1e-30
            total += float(np.log(belief.sum()))
            belief = belief / belief.sum()
        return total, messages[:: -1 if backward else 1]


class _Spread:
    """Convolution with the density of a walk's steps: a normal one, and a share of larger ones.

    Through the Fourier transform: kernels are hundreds of cells long. Its rounding, 1e-16 of the peak, is far
    below the share of steps that follow no rule.
    """

    def __init__(self, count: int, spread: float) -> None:
        usual, large = _normal(spread, 4.0), _normal(_LARGE_FACTOR * spread, 3.0)
        both = _LARGE_SHARE * np.convolve(usual, large)
        middle, reach = len(both) // 2, len(usual) // 2
        both[middle - reach : middle + reach + 1] += (1 - _LARGE_SHARE) * usual
        self._count, self._from = count, middle
        self._size = fft.next_fast_len(count + len(both) - 1, real=True)
        self._kernel = np.fft.rfft(both, self._size)

    def __call__(self, belief: Floats) -> Floats:
        """[count] density after a step; nothing comes from beyond the ends."""
        whole = np.fft.irfft(np.fft.rfft(belief, self._size) * self._kernel, self._size)
        return np.maximum(whole[self._from : self._from + self._count], 0.0)


def _normal(spread: float, reach: float) -> Floats:
    """Weights of a normal distribution on a grid, cut at so many spreads."""
    radius = int(reach * spread + 0.5)
    weight = np.exp(-0.5 * np.square(np.arange(-radius, radius + 1) / spread))
    return np.asarray(weight / weight.sum())
