"""Lit or unlit: the labels of a series of stills from the steps of light between them.

A hidden Markov model whose state is the labels of the last pictures: every pair up to `REACH` apart has a
step of light, which is 1 from unlit to lit, -1 back, and 0 between two of a kind, but for noise with heavy
tails.
Nothing is supposed of how often or in what order the flash fires.

Steps are [K - m] for each distance m, in gains of the flash; spreads [REACH] are their standard deviations.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from capture.tagging.still_steps import REACH

Floats = NDArray[np.float64]
Labels = NDArray[np.bool_]
Steps = Sequence[Floats]

_TAIL = 3.0  # degrees of freedom of the residuals (Student)
# The flash's gain changes with where it comes from; from picture to picture by about so much of itself.
_GAIN_SPREAD = 0.12


def likeliest_labels(steps: Steps, spread: Floats) -> Labels:
    """[K] the labels of least cost (Viterbi 1967)."""
    costs = _state_costs(steps, spread)
    count = costs.shape[1]
    before = np.arange(count) >> 1  # the state one picture earlier, but for its oldest label
    oldest = count // 2
    best, choice = costs[0], np.zeros(costs.shape, bool)
    for k in range(1, len(costs)):
        either = np.stack([best[before], best[before + oldest]])
        choice[k] = either[1] < either[0]
        best = either.min(axis=0) + costs[k]
    state = int(np.argmin(best))
    lit = np.zeros(len(costs), bool)
    for k in range(len(costs) - 1, -1, -1):
        lit[k] = state & 1
        state = (state >> 1) + (oldest if choice[k, state] else 0)
    return lit


def lit_probability(steps: Steps, spread: Floats) -> Floats:
    """[K] probability that each picture is lit (forward and backward, Rabiner 1989)."""
    costs = _state_costs(steps, spread)
    count = costs.shape[1]
    before, oldest = np.arange(count) >> 1, count // 2
    forward, backward = np.zeros(costs.shape), np.zeros(costs.shape)
    forward[0] = -costs[0]
    for k in range(1, len(costs)):
        reached = np.logaddexp(forward[k - 1][before], forward[k - 1][before + oldest]) - costs[k]
        forward[k] = reached - reached.max()
    after = (np.arange(count) << 1) & (count - 1)  # the states one picture later
    for k in range(len(costs) - 2, -1, -1):
        arriving = backward[k + 1] - costs[k + 1]
        reached = np.logaddexp(arriving[after], arriving[after + 1])
        backward[k] = reached - reached.max()
    total = forward + backward
    total = np.exp(total - total.max(axis=1, keepdims=True))
    odd = (np.arange(count) & 1).astype(bool)
    return np.asarray(total[:, odd].sum(axis=1) / total.sum(axis=1))


def _pair_costs(steps: Steps, spread: Floats) -> Floats:
    """[K, REACH, 2, 2] cost of the labels (earlier, later) of each picture and the one so many before it.

    The pairs of a picture are not independent; each counts for one part in `REACH`.
    """
    cost = np.zeros((len(steps[0]) + 1, REACH, 2, 2))
    for apart, step in enumerate(steps, start=1):
        for earlier in (0, 1):
            for later in (0, 1):
                variance = spread[apart - 1] ** 2 + _GAIN_SPREAD**2 * max(earlier, later)
                square = (step - (later - earlier)) ** 2 / variance
                student = 0.5 * (_TAIL + 1) * np.log1p(square / _TAIL) + 0.5 * np.log(variance)
                cost[apart:, apart - 1, earlier, later] = student / REACH
    return cost


def _state_costs(steps: Steps, spread: Floats) -> Floats:
    """[K, S] cost of each picture in each state; a state's bit m is the label of the picture m before."""
    pairs = _pair_costs(steps, spread)
    states = np.arange(2 ** (REACH + 1))
    label = (states[:, None] >> np.arange(REACH + 1)) & 1
    total = np.zeros((len(pairs), len(states)))
    for apart in range(1, REACH + 1):
        total += pairs[:, apart - 1][:, label[:, apart], label[:, 0]]
    return total
