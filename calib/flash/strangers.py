"""A first light by a fit with a robust loss, and which squares and pulses do not belong to the others."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from calib.flash.boards import LitBoard, Stack, stacked
from calib.flash.fit import bounds_of, prior_slopes
from calib.flash.model import LIGHT_SIZE, LOG_STRENGTH, POSITION, Light, log_light, log_light_with_slopes

Floats = NDArray[np.float64]

# Off-camera flashes are found from one of these places too (metres; x, y).
_STARTS = ((0.0, 0.0), (0.25, 0.0), (-0.25, 0.0), (0.0, 0.25), (0.0, -0.25))
# Squares that agree are within 1 % of each other, pulses within 5 %.
_SQUARE_SCALE, _PULSE_SCALE = 0.01, 0.05
# Beyond so many standard deviations of the others, and this much, something does not belong.
_STRANGE, _STRANGE_SQUARE, _STRANGE_PULSE = 5.0, 0.01, 0.1
_FEWEST_SQUARES = 8


def find_strangers(boards: Sequence[LitBoard], free: NDArray[np.int64]) -> tuple[Light, list[LitBoard], int]:
    """A first light by a robust fit, and the boards without the squares and pulses that do not belong.

    Returns:
        The light, the boards that are left, and the number of squares left out of these.
    """
    stack = stacked(boards, Light())
    light, gains, off = _robust(stack, free)
    middle = float(np.median(gains))
    limit = max(_STRANGE * _deviation(gains - middle), _STRANGE_PULSE)
    within = off[stack.there]
    near = max(_STRANGE * _deviation(within), _STRANGE_SQUARE)
    kept, lost = [], 0
    for number, board in enumerate(boards):
        fine = np.abs(off[number, : len(board.points_cam)]) < near
        if abs(gains[number] - middle) > limit or fine.sum() < _FEWEST_SQUARES:
            continue
        lost += int((~fine).sum())
        kept.append(board.part(fine))
    return light, kept, lost


def _robust(stack: Stack, free: NDArray[np.int64]) -> tuple[Light, Floats, Floats]:
    """Light, [V] log of each pulse's gain, and [V, N] what is left of each square, with a robust loss."""
    count = len(stack.boards)
    there = np.nonzero(stack.there)
    size = len(free)
    rows = len(there[0])
    gain_slopes = np.zeros((rows, count))
    gain_slopes[np.arange(rows), there[0]] = 1.0 / _SQUARE_SCALE
    priors = np.zeros((count + 2, size + count))
    priors[np.arange(count), size + np.arange(count)] = 1.0 / _PULSE_SCALE
    priors[count:, :size] = prior_slopes(free)

    def light_of(sought: Floats) -> Light:
        vector = np.zeros(LIGHT_SIZE)
        vector[free] = sought[:size]
        return Light(vector)

    def logarithms(sought: Floats) -> tuple[Floats, Floats]:
        value, by_light, _, _ = log_light_with_slopes(
            light_of(sought), stack.points_cam, stack.normals_cam, stack.time
        )
        off = np.log(np.maximum(stack.light, 1e-9)) - value - sought[size:, None]
        return off[there], by_light[there][:, free]

    def residuals(sought: Floats) -> Floats:
        return np.concatenate([logarithms(sought)[0] / _SQUARE_SCALE, priors @ sought])

    def slopes(sought: Floats) -> Floats:
        by_light = logarithms(sought)[1] / _SQUARE_SCALE
        return np.vstack([np.hstack([-by_light, -gain_slopes]), priors])

    best = None
    low, high = bounds_of(free)
    low, high = np.append(low, np.full(count, -5.0)), np.append(high, np.full(count, 5.0))
    for x, y in _STARTS:
        vector = Light().vector.copy()
        vector[POSITION] = x, y, 0.0
        value = log_light(Light(vector), stack.points_cam, stack.normals_cam, stack.time)
        vector[LOG_STRENGTH] = np.median(np.log(np.maximum(stack.light, 1e-9))[there] - value[there])
        start = np.append(vector[free], np.zeros(count))
        found = least_squares(
            residuals, start, slopes, bounds=(low, high), x_scale="jac", loss="soft_l1", max_nfev=60
        )
        if best is None or found.cost < best.cost:
            best = found
        if found.cost < 2.0 * rows:  # squares within 2 % of each other: no other start does much better
            break
    assert best is not None
    light, gains = light_of(best.x), best.x[size:]
    value = log_light(light, stack.points_cam, stack.normals_cam, stack.time)
    off = np.log(np.maximum(stack.light, 1e-9)) - value - gains[:, None]
    off -= np.array([[np.median(row[real])] for row, real in zip(off, stack.there, strict=True)])
    return light, gains, np.where(stack.there, off, 0.0)


def _deviation(values: Floats) -> float:
    """Standard deviation of the bulk (median absolute deviation)."""
    return 1.4826 * float(np.median(np.abs(values - np.median(values))))
