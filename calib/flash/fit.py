"""A flash's place, direction, falloff and strength from the light of boards: one weighted least squares.

The weights are those of the errors in `calib.flash.boards`. How large the texture and the spread of the
pulses are is found from the residuals by restricted maximum likelihood (Patterson and Thompson 1971), which
does not take them for smaller because eight numbers were fitted. Squares that do not belong are left out
before (`calib.flash.strangers`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares, minimize

from calib.flash.boards import (
    Spread,
    Stack,
    covariance_of,
    error_covariance,
    light_slopes,
    pose_change,
    relative_residuals,
    square_noise,
)
from calib.flash.model import AXIS, FALLOFF, LIGHT_SIZE, POSITION, Light, log_light

Floats = NDArray[np.float64]

# The axis of a flash that sends the same everywhere has no meaning; that a flash points to where its camera
# looks, within 45 degrees or so, is taken as known (slopes 0 +- 1).
_AXIS_PRIOR = 1.0
_LARGEST_FALLOFF, _LARGEST_SLOPE, _FARTHEST_M = 60.0, 6.0, 3.0
_SPREADS = (1e-5, 0.5)  # between which texture and pulse spread are sought
_ROUNDS = 4


@dataclass(frozen=True, eq=False)
class LightFit:
    """A light fitted to boards.

    Attributes:
        light: the light.
        covariance: [8, 8]; zero where a number was not free.
        spread: what the errors were found to be.
        free: [p] numbers that were sought.
    """

    light: Light
    covariance: Floats
    spread: Spread
    free: NDArray[np.int64]


def fit_light(stack: Stack, start: Light, free: NDArray[np.int64], spread: Spread | None = None) -> LightFit:
    """The weighted least squares of the module.

    Args:
        stack: of boards without strangers.
        start: near the answer.
        free: which numbers of the light are sought, ascending.
        spread: what the errors are, where that is known already.
    """
    found = spread or Spread(0.003, 0.01)
    light = start
    for _ in range(_ROUNDS):
        roots = error_roots(stack, light, found)
        light = _solved(stack, light, free, roots)
        if spread is None:
            found = _spread_of(stack, light, free, found)
    information = _information(stack, light, free, error_roots(stack, light, found))
    covariance = np.zeros((LIGHT_SIZE, LIGHT_SIZE))
    covariance[np.ix_(free, free)] = np.linalg.pinv(information, hermitian=True)
    if spread is None:
        # The pulses' spread is itself known from few pulses only: the variance of Student's t.
        pulses = max(len(stack.boards), 6)
        covariance *= (pulses - 2) / (pulses - 4)
    return LightFit(light, covariance, found, free)


def pulse_gains(stack: Stack, fit: LightFit) -> tuple[Floats, Floats]:
    """[V] how much brighter each pulse was than the light says, relative, and its standard deviation.

    The best estimate with the fitted light as given: noise, texture and pose weighed as in the fit.
    """
    bare = error_covariance(stack, fit.light, Spread(max(fit.spread.texture, _SPREADS[0]), 0.0))
    ones = stack.there.astype(np.float64)[..., None]
    weighted = np.linalg.solve(bare, ones)[..., 0]
    precision = (weighted * ones[..., 0]).sum(1)
    gains = (weighted * relative_residuals(stack, fit.light)).sum(1) / precision
    return gains, 1.0 / np.sqrt(precision)


def light_exponent(stack: Stack, fit: LightFit) -> tuple[float, float]:
    """By which power of the predicted light the measured one grows, and its standard deviation: 1 if all is
    well.

    A response that is wrong, light that is not the flash's, or paper that is not matte bend the light, and
    place and falloff follow as far as they can; what they cannot follow is seen here (one step from 1, with
    everything else free).
    """
    roots = error_roots(stack, fit.light, fit.spread)
    level = log_light(fit.light, stack.points_cam, stack.normals_cam, stack.time)
    bent = np.where(stack.there, level - level[stack.there].mean(), 0.0)
    slopes = light_slopes(stack, fit.light, np.arange(LIGHT_SIZE))
    columns = (roots @ np.concatenate([bent[..., None], slopes], axis=2)).reshape(-1, 1 + LIGHT_SIZE)
    off = (roots @ relative_residuals(stack, fit.light)[..., None]).ravel()
    prior = np.zeros((AXIS.stop - AXIS.start, 1 + LIGHT_SIZE))
    prior[:, 1:] = prior_slopes(np.arange(LIGHT_SIZE))
    columns = np.vstack([columns, prior])
    off = np.append(off, -prior[:, 1:] @ fit.light.vector)
    covariance = np.linalg.pinv(columns.T @ columns, hermitian=True)
    change = covariance @ (columns.T @ off)
    return 1.0 + float(change[0]), float(np.sqrt(covariance[0, 0]))


def bounds_of(free: NDArray[np.int64]) -> tuple[Floats, Floats]:
    """[p] and [p] between which the free numbers are sought."""
    low, high = np.full(LIGHT_SIZE, -np.inf), np.full(LIGHT_SIZE, np.inf)
    low[POSITION], high[POSITION] = -_FARTHEST_M, _FARTHEST_M
    low[AXIS], high[AXIS] = -_LARGEST_SLOPE, _LARGEST_SLOPE
    low[FALLOFF], high[FALLOFF] = 0.0, _LARGEST_FALLOFF
    return low[free], high[free]


def prior_slopes(free: NDArray[np.int64]) -> Floats:
    """[2, p] of what is taken as known of the axis."""
    axis = np.arange(AXIS.start, AXIS.stop)
    return (free[None] == axis[:, None]) / _AXIS_PRIOR


def _solved(stack: Stack, light: Light, free: NDArray[np.int64], roots: Floats) -> Light:
    """The light that minimises the weighted squares with given inverse roots of the covariances."""

    def light_of(sought: Floats) -> Light:
        vector = light.vector.copy()
        vector[free] = sought
        return Light(vector)

    prior = prior_slopes(free)
    measured = 1.0 + relative_residuals(stack, light)

    # Relative to the light before this round: relative to the light that is sought, a brighter one would
    # make all errors smaller, and be found.
    def predicted(now: Light) -> Floats:
        before = log_light(light, stack.points_cam, stack.normals_cam, stack.time)
        value = log_light(now, stack.points_cam, stack.normals_cam, stack.time)
        return np.exp(np.clip(value - before, -20.0, 20.0))

    def residuals(sought: Floats) -> Floats:
        off = np.where(stack.there, measured - predicted(light_of(sought)), 0.0)
        return np.append((roots @ off[..., None]).ravel(), prior @ sought)

    def slopes(sought: Floats) -> Floats:
        now = light_of(sought)
        change = -predicted(now)[..., None] * light_slopes(stack, now, free)
        return np.vstack([(roots @ change).reshape(-1, len(free)), prior])

    low, high = bounds_of(free)
    start = np.clip(light.vector[free], low + 1e-9, high - 1e-9)
    found = least_squares(residuals, start, slopes, bounds=(low, high), x_scale="jac", max_nfev=60)
    return light_of(found.x)


def _spread_of(stack: Stack, light: Light, free: NDArray[np.int64], start: Spread) -> Spread:
    """Texture and pulse spread that make the residuals most likely, whatever the light's numbers are."""
    off = relative_residuals(stack, light)[..., None]
    slopes = light_slopes(stack, light, free)
    noise, change = square_noise(stack, light), pose_change(stack, light)
    prior = np.diag((prior_slopes(free) ** 2).sum(0))

    def cost(logs: Floats) -> float:
        texture, pulse = np.exp(np.clip(logs, *np.log(_SPREADS)))
        root = np.linalg.cholesky(covariance_of(stack.there, noise, change, Spread(texture, pulse)))
        both = np.linalg.solve(root, np.concatenate([off, slopes], axis=2))
        r, x = both[..., 0].ravel(), both[..., 1:].reshape(-1, len(free))
        information = x.T @ x + prior
        pull = x.T @ r
        determinants = 2.0 * np.log(np.diagonal(root, axis1=1, axis2=2)).sum()
        explained = pull @ np.linalg.lstsq(information, pull, rcond=None)[0]
        return float(determinants + np.linalg.slogdet(information)[1] + r @ r - explained)

    found = minimize(
        cost,
        np.log(np.clip([start.texture, start.pulse], *_SPREADS)),
        method="Nelder-Mead",
        options={"xatol": 0.02, "fatol": 0.01, "maxfev": 60},
    )
    texture, pulse = np.exp(np.clip(found.x, *np.log(_SPREADS)))
    return Spread(float(texture), float(pulse))


def _information(stack: Stack, light: Light, free: NDArray[np.int64], roots: Floats) -> Floats:
    weighted = (roots @ light_slopes(stack, light, free)).reshape(-1, len(free))
    prior = prior_slopes(free)
    information: Floats = weighted.T @ weighted + prior.T @ prior
    return information


def error_roots(stack: Stack, light: Light, spread: Spread) -> Floats:
    """[V, N, N] W with W^T W the inverse covariance of the errors; zero in rows that are not there."""
    root = np.linalg.cholesky(error_covariance(stack, light, spread))
    return np.linalg.inv(root) * stack.there[:, :, None]
