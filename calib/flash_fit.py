"""A flash's place, direction, falloff and strength from boards that it lit.

What is compared is the relative difference between measured and predicted light of every white square,
summed over the channels. Three kinds of error make it, all allowed for in one weighted least squares:

    each square by itself   noise of its pixels, and `texture`: what is left (paper, print)
    a whole board together  `pulse_spread`: pulses are not equally bright
    a board's pose          its six numbers are known only as well as its corners were found

So the covariance of one board's squares is  noise^2 + texture^2 + pulse_spread^2 1 1^T + Q Q^T,  with Q the
change of the light with the pose times the square root of the pose's covariance. `texture` and
`pulse_spread` are found from the residuals by restricted maximum likelihood (Patterson and Thompson 1971),
which does not take them for smaller because eight numbers were fitted. Before, squares that do not belong
(highlights, shadows, fingers) are told by a fit with a robust loss.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares, minimize

from calib.flash_model import (
    AXIS,
    FALLOFF,
    LIGHT_SIZE,
    LOG_STRENGTH,
    POSITION,
    Light,
    log_light,
    log_light_with_slopes,
)

Floats = NDArray[np.float64]

# The axis of a flash that sends the same everywhere has no meaning; that a flash points to where its camera
# looks, within 45 degrees or so, is taken as known (slopes 0 +- 1).
_AXIS_PRIOR = 1.0
_LARGEST_FALLOFF, _LARGEST_SLOPE, _FARTHEST_M = 60.0, 6.0, 3.0
# Off-camera flashes are found from one of these places too (metres; x, y).
_STARTS = ((0.0, 0.0), (0.25, 0.0), (-0.25, 0.0), (0.0, 0.25), (0.0, -0.25))
# Of the robust fit, relative: squares that agree are within 1 % of each other, pulses within 5 %.
_SQUARE_SCALE, _PULSE_SCALE = 0.01, 0.05
# Beyond so many standard deviations of the others, and this much, a square does not belong.
_STRANGE, _STRANGE_SQUARE, _STRANGE_PULSE = 5.0, 0.01, 0.1
_FEWEST_SQUARES = 8
_SPREADS = (1e-5, 0.5)
_ROUNDS = 4


@dataclass(frozen=True, eq=False)
class LitBoard:
    """The light of one pulse on the white squares of one board.

    Attributes:
        name: of the picture with the flash.
        time_s: of the pulse.
        points_cam: [n, 3] middle of what was measured of each square, camera axes, metres.
        reach_cam: [n, 4, 3] four points whose mean and spread are those of all points measured of a square.
        normal_cam: [3] unit, towards the camera.
        radiance: [n, 3] with the flash minus without, after the flat field.
        noise: [n] standard deviation of the sum over the channels, relative.
        pose_covariance: [6, 6] of the board's rotation (about the camera's axes, at the camera) of its
            points about its own origin, rad, and translation, m.
        origin_cam: [3] of the board, camera axes, metres.
        squares: [n] number of each square, row by row of the board.
    """

    name: str
    time_s: float
    points_cam: Floats
    reach_cam: Floats
    normal_cam: Floats
    radiance: Floats
    noise: Floats
    pose_covariance: Floats
    origin_cam: Floats
    squares: NDArray[np.int64]

    def part(self, chosen: NDArray[np.bool_]) -> LitBoard:
        """Some of its squares."""
        return replace(
            self,
            points_cam=self.points_cam[chosen],
            reach_cam=self.reach_cam[chosen],
            radiance=self.radiance[chosen],
            noise=self.noise[chosen],
            squares=self.squares[chosen],
        )


@dataclass(frozen=True, eq=False)
class Spread:
    """The errors that are no pixel noise, relative standard deviations: of squares, and of pulses."""

    texture: float
    pulse: float


@dataclass(frozen=True, eq=False)
class Stack:
    """V boards in arrays of equal length: rows that a board does not have say nothing.

    Attributes:
        boards: the boards.
        there: [V, N] which rows are real.
        points_cam: [V, N, 3] metres.
        normals_cam: [V, N, 3].
        time: [V, N] in the capture, -1/2..1/2.
        light: [V, N] mean of the channels in the middle of each square.
        noise: [V, N] relative.
        arms: [V, N, 3] from the board's origin to the point.
        pose_roots: [V, 6, 6] square roots of the pose covariances.
    """

    boards: Sequence[LitBoard]
    there: NDArray[np.bool_]
    points_cam: Floats
    normals_cam: Floats
    time: Floats
    light: Floats
    noise: Floats
    arms: Floats
    pose_roots: Floats

    def part(self, chosen: NDArray[np.bool_]) -> Stack:
        """Some of its boards."""
        return Stack(
            [board for board, kept in zip(self.boards, chosen, strict=True) if kept],
            *(
                getattr(self, name)[chosen]
                for name in (
                    "there",
                    "points_cam",
                    "normals_cam",
                    "time",
                    "light",
                    "noise",
                    "arms",
                    "pose_roots",
                )
            ),
        )


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


def stacked(boards: Sequence[LitBoard], about: Light) -> Stack:
    """Boards as arrays; their times become the part of the capture that had passed, from -1/2 to 1/2.

    Args:
        boards: the boards.
        about: roughly the light: within a square it bends, and so its mean is not the light in the middle.
    """
    longest = max(len(board.points_cam) for board in boards)
    count = len(boards)
    seconds = np.array([board.time_s for board in boards])
    duration = max(float(np.ptp(seconds)), 1e-9)
    there = np.zeros((count, longest), bool)
    points = np.tile([0.0, 0.0, 1.0], (count, longest, 1))
    normals = np.tile([0.0, 0.0, -1.0], (count, longest, 1))
    light, noise = np.ones((count, longest)), np.ones((count, longest))
    arms = np.zeros((count, longest, 3))
    for number, board in enumerate(boards):
        n = len(board.points_cam)
        there[number, :n] = True
        points[number, :n] = board.points_cam
        normals[number] = board.normal_cam
        light[number, :n] = board.radiance.mean(1) / _mean_over_middle(board, about)
        noise[number, :n] = board.noise
        arms[number, :n] = board.points_cam - board.origin_cam
    share = (seconds - seconds.min()) / duration - 0.5
    roots = np.array([_root(board.pose_covariance) for board in boards])
    times = np.repeat(share[:, None], longest, axis=1)
    return Stack(boards, there, points, normals, times, light, noise, arms, roots)


def _mean_over_middle(board: LitBoard, about: Light) -> Floats:
    """[n] mean of the light over each square by that in its middle."""
    time = np.zeros(())
    around = log_light(about, board.reach_cam, board.normal_cam, time)
    middle = log_light(about, board.points_cam, board.normal_cam, time)
    ratio: Floats = np.exp(around - middle[:, None]).mean(1)
    return ratio


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
        roots = _error_roots(stack, light, found)
        light = _solved(stack, light, free, roots)
        if spread is None:
            found = _spread_of(stack, light, free, found)
    information = _information(stack, light, free, _error_roots(stack, light, found))
    covariance = np.zeros((LIGHT_SIZE, LIGHT_SIZE))
    covariance[np.ix_(free, free)] = np.linalg.pinv(information, hermitian=True)
    if spread is None:
        # The pulses' spread is itself known from few pulses only: the variance of Student's t.
        pulses = max(len(stack.boards), 6)
        covariance *= (pulses - 2) / (pulses - 4)
    return LightFit(light, covariance, found, free)


def relative_residuals(stack: Stack, light: Light) -> Floats:
    """[V, N] measured over predicted light minus one; 0 in rows that are not there."""
    value = log_light(light, stack.points_cam, stack.normals_cam, stack.time)
    return np.where(stack.there, stack.light * np.exp(-value) - 1.0, 0.0)


def error_covariance(stack: Stack, light: Light, spread: Spread) -> Floats:
    """[V, N, N] of the relative residuals of each board; the unit matrix in rows that are not there."""
    return _covariance(stack.there, _square_noise(stack, light), _pose_change(stack, light), spread)


def light_slopes(stack: Stack, light: Light, free: NDArray[np.int64]) -> Floats:
    """[V, N, p] relative change of the light with the free numbers; 0 in rows that are not there."""
    _, by_light, _, _ = log_light_with_slopes(light, stack.points_cam, stack.normals_cam, stack.time)
    return np.where(stack.there[..., None], by_light[..., free], 0.0)


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
    for row, number in enumerate(range(AXIS.start, AXIS.stop)):
        priors[count + row, :size][free == number] = 1.0 / _AXIS_PRIOR

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
    low, high = _bounds(free)
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


def _solved(stack: Stack, light: Light, free: NDArray[np.int64], roots: Floats) -> Light:
    """The light that minimises the weighted squares with given inverse roots of the covariances."""

    def light_of(sought: Floats) -> Light:
        vector = light.vector.copy()
        vector[free] = sought
        return Light(vector)

    prior = _prior_slopes(free)
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

    low, high = _bounds(free)
    start = np.clip(light.vector[free], low + 1e-9, high - 1e-9)
    found = least_squares(residuals, start, slopes, bounds=(low, high), x_scale="jac", max_nfev=60)
    return light_of(found.x)


def _spread_of(stack: Stack, light: Light, free: NDArray[np.int64], start: Spread) -> Spread:
    """Texture and pulse spread that make the residuals most likely, whatever the light's numbers are."""
    off = relative_residuals(stack, light)[..., None]
    slopes = light_slopes(stack, light, free)
    noise, change = _square_noise(stack, light), _pose_change(stack, light)
    prior = np.diag((_prior_slopes(free) ** 2).sum(0))

    def cost(logs: Floats) -> float:
        texture, pulse = np.exp(np.clip(logs, *np.log(_SPREADS)))
        root = np.linalg.cholesky(_covariance(stack.there, noise, change, Spread(texture, pulse)))
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
    prior = _prior_slopes(free)
    information: Floats = weighted.T @ weighted + prior.T @ prior
    return information


def _prior_slopes(free: NDArray[np.int64]) -> Floats:
    """[2, p] of what is taken as known of the axis."""
    axis = np.arange(AXIS.start, AXIS.stop)
    return (free[None] == axis[:, None]) / _AXIS_PRIOR


def _square_noise(stack: Stack, light: Light) -> Floats:
    """[V, N] noise relative to the predicted light (that of the measured light would favour dark errors)."""
    return stack.noise * (1.0 + np.clip(relative_residuals(stack, light), -0.5, 1.0))


def _pose_change(stack: Stack, light: Light) -> Floats:
    """[V, N, 6] relative change of the light by one standard deviation along each axis of the pose."""
    _, _, by_point, by_normal = log_light_with_slopes(light, stack.points_cam, stack.normals_cam, stack.time)
    by_turn = np.cross(stack.arms, by_point) + np.cross(stack.normals_cam, by_normal)
    by_pose = np.concatenate([by_turn, by_point], axis=-1)
    change: Floats = by_pose @ stack.pose_roots
    return np.where(stack.there[..., None], change, 0.0)


def _covariance(there: NDArray[np.bool_], noise: Floats, change: Floats, spread: Spread) -> Floats:
    variance = np.where(there, noise**2 + spread.texture**2, 1.0)
    ones = there.astype(np.float64)
    covariance: Floats = change @ np.swapaxes(change, 1, 2)
    covariance += spread.pulse**2 * ones[:, :, None] * ones[:, None, :]
    rows = np.arange(there.shape[1])
    covariance[:, rows, rows] += variance
    return covariance


def _error_roots(stack: Stack, light: Light, spread: Spread) -> Floats:
    """[V, N, N] W with W^T W the inverse covariance; zero in rows that are not there."""
    root = np.linalg.cholesky(error_covariance(stack, light, spread))
    return np.linalg.inv(root) * stack.there[:, :, None]


def _bounds(free: NDArray[np.int64]) -> tuple[Floats, Floats]:
    low, high = np.full(LIGHT_SIZE, -np.inf), np.full(LIGHT_SIZE, np.inf)
    low[POSITION], high[POSITION] = -_FARTHEST_M, _FARTHEST_M
    low[AXIS], high[AXIS] = -_LARGEST_SLOPE, _LARGEST_SLOPE
    low[FALLOFF], high[FALLOFF] = 0.0, _LARGEST_FALLOFF
    return low[free], high[free]


def _root(covariance: Floats) -> Floats:
    values, vectors = np.linalg.eigh(covariance)
    root: Floats = vectors * np.sqrt(np.maximum(values, 0.0))
    return root


def _deviation(values: Floats) -> float:
    """Standard deviation of the bulk (median absolute deviation)."""
    return 1.4826 * float(np.median(np.abs(values - np.median(values))))
