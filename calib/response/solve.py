"""The numbers of a response fit (`response_fit`): Gauss-Newton in stored values, EM for the three variances.

Residuals are those of stored values against what curve, group and exposure promise, and the curve is taken
at that promise: taken at the noisy values themselves it would be bent by their noise, and the more so the
darker they are.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from calib.response.curve import CurveBasis
from calib.response.groups import SweepGroups

Floats = NDArray[np.float64]

_ROUNDS, _FIRST_ROUNDS = 30, 6
_TUKEY = 5.0  # residuals beyond so many standard deviations carry no weight
_LEAST_TAU = 2e-4  # of an exposure time: no camera's clock divides finer
_NOISE_LEVELS = 24
_LEAST_NOISE = 2e-4  # relative, of a group
_LARGEST_NOISE = 0.2  # beyond, a measurement says nothing
_NO_WEIGHT = 1e-9


@dataclass(frozen=True, eq=False)
class CurveFit:
    """A solution over K frames and J groups, which are (group, channel) pairs.

    Attributes:
        basis: of the curve.
        curve: [Q] its coefficients.
        covariance: [Q, Q].
        offsets: [K] logarithm of the light over what the exposures claim; no factor or power of all.
        offset_sigma: [K].
        residuals: [K, J] relative, of radiance; nan where not measured.
        fitted: [K, J] stored values that were expected.
        sigma: [K, J] standard deviation of the residuals; inf where not measured.
        robust: [K, J] 0..1, weight for being no outlier.
        tau: standard deviation of the offsets.
        power_sigma: of the exponent of the curve that the offsets leave open.
        leverage: [K] share of a frame's offset that factor and power take up.
    """

    basis: CurveBasis
    curve: Floats
    covariance: Floats
    offsets: Floats
    offset_sigma: Floats
    residuals: Floats
    fitted: Floats
    sigma: Floats
    robust: Floats
    tau: float
    power_sigma: float
    leverage: Floats


def join_channels(values: NDArray[Any], channels: list[int]) -> NDArray[Any]:
    """[K, G, 3] -> [K, J]."""
    return values[..., channels].reshape(len(values), -1)


def solve_curve(
    groups: SweepGroups,
    stored: Floats,
    seen: NDArray[np.bool_],
    unclipped: NDArray[np.bool_],
    channels: list[int],
    low: float,
) -> CurveFit:
    """Curve, groups and exposures; weights, robustness and variances are renewed each round.

    Args:
        groups: of the sweep.
        stored: [K, G, 3] medians above the dark level.
        seen: [K, G, 3] those to start with.
        unclipped: [K, G, 3] those that may be used.
        channels: which ones.
        low: least stored value that tells something.
    """
    z = join_channels(stored, channels)
    start = join_channels(seen, channels)
    linked = start.sum(axis=0) >= 2
    basis = CurveBasis(max(low, float(z[start & linked].min())))
    rows = np.where((join_channels(unclipped, channels) & linked).ravel())[0]
    frame_of, group_of = np.divmod(rows, z.shape[1])
    values = z.ravel()[rows]
    system = _System(basis, frame_of, group_of, z.shape, groups.exposures_s)
    used = start.ravel()[rows]
    curve = basis.straight(2.0)
    noise = 2.0 * join_channels(groups.sigma, channels).ravel()[rows] / np.maximum(values, low)
    robust, expected = np.ones(len(rows)), np.maximum(values, low)
    tau2, bend2 = 0.01**2, 10.0
    for number in range(_ROUNDS):
        slope = np.maximum(basis.slopes(expected) @ curve, 0.3)
        working = slope * (values - expected) / expected
        weight = np.where(used & (noise < _LARGEST_NOISE), 1.0, _NO_WEIGHT) / noise**2
        solution = system.solve(expected, working, weight * robust, tau2, bend2)
        curve = solution.curve
        spare = np.sqrt(np.maximum(solution.spare, 1e-3))  # the group's own level takes the rest
        if number < _FIRST_ROUNDS:
            residual = solution.residual
        else:
            expected = np.maximum(basis.inverse(curve, solution.level), 1e-4)
            residual = np.maximum(basis.slopes(expected) @ curve, 0.3) * (values - expected) / expected
            used = (expected > low) & (expected < 0.998)
        noise = _noise_by_level(solution.level, residual / spare, used, noise)
        robust = np.maximum(1.0 - (residual / spare / (noise * _TUKEY)) ** 2, 1e-3) ** 2
        tau2 = max(solution.offset_power / (len(z) - 2), _LEAST_TAU**2)
        bend2 = float(np.clip(solution.bend_power / (basis.count - 1), 1e-4, 1e3))

    good = used & (noise < _LARGEST_NOISE)

    def grid(flat: Floats, empty: float) -> Floats:
        full = np.full(z.size, empty)
        full[rows] = np.where(good, flat, empty)
        return full.reshape(z.shape)

    return CurveFit(
        basis=basis,
        curve=curve,
        covariance=solution.covariance,
        offsets=solution.offsets,
        offset_sigma=solution.offset_sigma,
        residuals=grid(residual, np.nan),
        fitted=grid(expected, np.nan),
        sigma=grid(noise, np.inf),
        robust=grid(robust, 0.0),
        tau=float(np.sqrt(tau2)),
        power_sigma=float(np.sqrt(tau2 / np.sum((system.log_t - system.log_t.mean()) ** 2))),
        leverage=1.0 - np.sum(system.free**2, axis=1),
    )


@dataclass(frozen=True, eq=False)
class _Solution:
    """Of one round; R measurements."""

    curve: Floats  # [Q]
    covariance: Floats  # [Q, Q]
    offsets: Floats  # [K]
    offset_sigma: Floats  # [K]
    level: Floats  # [R] ln(radiance) that is expected
    residual: Floats  # [R]
    spare: Floats  # [R] 1 - share that the measurement has in its group's level
    offset_power: float  # expected sum of squares of the offsets
    bend_power: float  # and of the curve's bending


class _System:
    """The normal equations, with the groups' levels eliminated."""

    def __init__(
        self,
        basis: CurveBasis,
        frame_of: NDArray[np.int64],
        group_of: NDArray[np.int64],
        shape: tuple[int, ...],
        exposures_s: Floats,
    ) -> None:
        self._basis, self._frame_of, self._group_of = basis, frame_of, group_of
        self._frames, self._groups = shape
        self.log_t = np.log(exposures_s) - np.mean(np.log(exposures_s))
        # Offsets that are a factor of all exposures, or a power, cannot be told from other radiances and from
        # another curve: [K, K - 2], orthonormal to these.
        trend = np.stack([np.ones_like(self.log_t), self.log_t], axis=1)
        self.free = np.linalg.qr(trend, mode="complete")[0][:, 2:]

    def solve(self, expected: Floats, working: Floats, w: Floats, tau2: float, bend2: float) -> _Solution:
        """One step from curve and levels that promise `expected`.

        Args:
            expected: [R] stored values.
            working: [R] relative residuals of what was measured against these.
            w: [R] weights.
            tau2: variance of the offsets.
            bend2: and of the curve's second derivative.
        """
        basis, frame_of, group_of = self._basis, self._frame_of, self._group_of
        count, frames, groups = basis.count, self._frames, self._groups
        design = basis.values(expected)
        beyond = basis.below(expected)
        target = self.log_t[frame_of] - working - beyond
        total = np.maximum(np.bincount(group_of, w, groups), 1e-300)
        weighted = design * w[:, None]
        sums = np.zeros((groups, count + frames))
        for column in range(count):
            sums[:, column] = np.bincount(group_of, weighted[:, column], groups)
        np.add.at(sums, (group_of, count + frame_of), -w)
        normal = np.zeros((count + frames, count + frames))
        normal[:count, :count] = weighted.T @ design
        for column in range(count):
            cross = np.bincount(frame_of, weighted[:, column], frames)
            normal[column, count:] = normal[count:, column] = -cross
        normal[count:, count:] = np.diag(np.bincount(frame_of, w, frames))
        normal -= sums.T @ (sums / total[:, None])
        right = np.concatenate([weighted.T @ target, -np.bincount(frame_of, w * target, frames)])
        right -= sums.T @ (np.bincount(group_of, w * target, groups) / total)
        shrunk = np.zeros((count + frames, count + frames - 2))  # from the curve and the free offsets
        shrunk[:count, :count], shrunk[count:, count:] = np.eye(count), self.free
        prior = np.zeros((count + frames - 2,) * 2)
        prior[:count, :count] = basis.penalty / bend2 + 1e-9 * np.eye(count)
        prior[count:, count:] = np.eye(frames - 2) / tau2
        system, right = shrunk.T @ normal @ shrunk + prior, shrunk.T @ right
        inverse = np.linalg.inv(system)
        solution = inverse @ right
        if (basis.increments() @ solution[:count] < 0).any():
            solution = _rising(basis, system, right)
        covariance = shrunk @ inverse @ shrunk.T
        curve, offsets = solution[:count], self.free @ solution[count:]
        fitted = design @ curve - offsets[frame_of] - target
        own = np.bincount(group_of, w * fitted, groups) / total
        offset_variance = np.diag(covariance)[count:]
        within = covariance[:count, :count]
        return _Solution(
            curve,
            within,
            offsets,
            np.sqrt(offset_variance),
            own[group_of] + self.log_t[frame_of] + offsets[frame_of],
            fitted - own[group_of],
            1.0 - w / total[group_of],
            float(np.sum(offsets**2 + offset_variance)),
            float(curve @ basis.penalty @ curve + np.trace(basis.penalty @ within)),
        )


def _rising(basis: CurveBasis, normal: Floats, right: Floats) -> Floats:
    """The solution of normal equations among the curves that never fall."""
    count = basis.count
    from_steps = np.eye(len(normal))
    from_steps[:count, :count] = np.linalg.inv(basis.increments())
    root = np.linalg.cholesky(normal).T
    lower = np.concatenate([np.full(count, 1e-4), np.full(len(normal) - count, -np.inf)])
    found = lsq_linear(root @ from_steps, np.linalg.solve(root.T, right), (lower, np.inf))
    return np.asarray(from_steps @ found.x)


def _noise_by_level(level: Floats, standard: Floats, used: NDArray[np.bool_], before: Floats) -> Floats:
    """Standard deviation of each measurement, from the scatter of those of about the same radiance.

    Args:
        level: [R] ln(radiance) as fitted, which noise in the measurement itself hardly moves.
        standard: [R] residuals.
        used: [R] those that tell.
        before: [R] what was taken so far.
    """
    order = np.where(used)[0][np.argsort(level[used])]
    parts = np.array_split(order, max(1, min(_NOISE_LEVELS, len(order) // 40)))
    if len(parts) < 2:
        return before
    at = np.array([np.median(level[part]) for part in parts])
    scatter = [1.4826 * float(np.median(np.abs(standard[part]))) for part in parts]
    return np.asarray(np.exp(np.interp(level, at, np.log(np.maximum(scatter, _LEAST_NOISE)))))
