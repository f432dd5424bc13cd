"""A camera's response from an exposure sweep of a still scene: robust, smooth, rising, with its uncertainty.

Group j of pixels (`response_groups`) has the stored value z in frame k. With s the curve, e the group's
radiance, t the exposure time that the frame claims and d what that time is off by,

    s(z_jk) = e_j + ln t_k + d_k + noise,        s(white) = 0.

That is Debevec and Malik's system (1997, eq. 3) with three differences. The curve is a spline whose roughness
is a random effect, and so are the d_k: their variances are found from the data (EM; Wahba 1983 for the
intervals that this gives), not chosen. A frame whose d_k stands out is left out and named. And a group weighs
by what its noise is worth. Times that are all wrong by one power cannot be told from another curve by anyone
(Grossberg and Nayar 2003): the d_k are kept clear of that, and their scatter says how far it may be off.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from calib.errors import ResponseError
from calib.response.groups import SweepGroups, choose_frames
from calib.response.solve import CurveFit, join_channels, solve_curve

Floats = NDArray[np.float64]

_LEAST_EXPOSURES, _LEAST_SPAN = 4, 4.0
_LEAST_GROUPS = 30
_CLIPPED_SHARE = 0.4
_LOW_STEPS, _LOW = 2.0, 0.0015  # values below so many steps of the file, or below this, tell nothing
_LEAST_TOP = 0.6
_FALSE_ALARM, _FRAME_OFF = 5e-4, 0.015  # an exposure is wrong that is unlikelier, and further off
_LEAST_SCATTER = 1e-3  # of the exposures that are right, relative
_LARGEST_WRONG_SHARE = 0.25
_LARGEST_TAU = 0.08
_LARGEST_MOVED_SHARE = 0.3
# Cameras round before their curve too, which leaves codes of uneven width: so much of a code is never told.
_ROUNDING = 0.1
_SAME_CURVE_SIGMAS, _SAME_CURVE = 4.0, 0.005  # channels differ where they do by both; of white


_DOES_NOT_FOLLOW = (
    "The brightness does not follow the exposure times: an automatic is at work, the light changed, or the "
    "times belong to other pictures."
)


@dataclass(frozen=True, eq=False)
class FrameCheck:
    """What the light says of a frame's exposure time.

    Attributes:
        name: of the frame.
        claimed_s: the time that it claims, seconds.
        off: relative: 0.1 = it got 10 % more light than claimed.
        sigma: standard deviation of `off`.
        used: False = so far off that it was left out.
    """

    name: str
    claimed_s: float
    off: float
    sigma: float
    used: bool


@dataclass(frozen=True, eq=False)
class ResponseResult:
    """A response, stored value above the dark level -> radiance, 1 = white.

    Attributes:
        stored: [n] 0..1, rising.
        linear: [n] or [n, 3] radiance at these, never falling.
        sigma: as `linear`: standard deviation, by the scale on which white is 1.
        dark: [3] stored dark level that was taken off.
        step: of stored values.
        covered: (least, largest) stored value that was measured; beyond, the curve is continued.
        frames: what the light says of each.
        residual: relative standard deviation of a group about the fit.
        expected: what the groups' noise promises for it.
        jitter: relative standard deviation of the exposures (or of the lamp) about what they claim.
        levels: [m] stored values, and
        deviations: [m] mean relative deviation of linearised values there from proportionality to exposure.
        moved: share of groups that do not fit and carry no weight.
        warnings: sentences.
    """

    stored: Floats
    linear: Floats
    sigma: Floats
    dark: Floats
    step: float
    covered: tuple[float, float]
    frames: tuple[FrameCheck, ...]
    residual: float
    expected: float
    jitter: float
    levels: Floats
    deviations: Floats
    moved: float
    warnings: tuple[str, ...]

    @property
    def linearity(self) -> float:
        """The largest relative deviation from proportionality, after the response."""
        return float(np.abs(self.deviations).max())

    @property
    def bend(self) -> float:
        """The largest distance of the response from a straight line, in shares of white."""
        straight = np.minimum(self.stored / (1.0 - self.dark.mean()), 1.0)
        line = straight if self.linear.ndim == 1 else straight[:, None]
        return float(np.abs(self.linear - line).max())


def fit_response(groups: SweepGroups, dark: Floats | None = None) -> ResponseResult:
    """The response that a sweep shows.

    Args:
        groups: of `gather_groups`.
        dark: [3] stored dark level 0..1; None = 0.

    Raises:
        ResponseError: too few exposures, or too alike; too dark or too bright; brightness that does not
            follow the exposures; a scene that moved.
    """
    black = np.zeros(3) if dark is None else np.asarray(dark, dtype=np.float64)
    stored = groups.median - black
    low = max(_LOW_STEPS * groups.step, _LOW)
    unclipped = np.repeat((groups.clipped < _CLIPPED_SHARE)[..., None], 3, axis=2)
    seen = (stored > low) & unclipped
    _refuse_poor_sweep(groups, seen)
    channels = [0] if groups.grey else [0, 1, 2]
    fit, wrong, kept = _without_wrong_frames(groups, stored, seen, unclipped, channels, low)
    warnings = []
    if np.isfinite(fit.residuals).sum() < 4 * _LEAST_GROUPS:
        raise ResponseError(_DOES_NOT_FOLLOW)
    covered = (float(np.nanmin(fit.fitted)), float(np.nanmax(fit.fitted)))
    moved = _moved_share(fit)
    _refuse_bad_fit(fit, moved, covered)
    if fit.tau > 0.01:
        warnings.append(
            f"The exposures scatter by {fit.tau:.1%} about what they claim: use a steadier light (no mains "
            "flicker), or longer exposures."
        )
    if covered[1] < 0.9:
        warnings.append(
            f"Nothing brighter than {covered[1]:.2f} of white was seen unclipped; above, the curve is "
            "guessed."
        )
    nodes = np.arange(256) / 255.0 if groups.step > 1e-3 else np.arange(1025) / 1024.0
    # What a clipped pixel is at once the dark level is off.
    linear, sigma = _table(fit, nodes, groups.step, 1.0 - float(black.mean()))
    if len(channels) == 3 and _channels_differ(fit):
        linear, sigma = _by_channel(
            linear, sigma, nodes, covered, groups, stored, seen, unclipped, kept, low, black, warnings
        )
    frames = _frame_checks(groups, fit, wrong, kept, stored, seen, channels)
    warnings += [
        f"{frame.name} claims {frame.claimed_s:g} s, but the light is that of "
        f"{frame.claimed_s * (1 + frame.off):.3g} s ({frame.off:+.1%}); it was left out."
        for frame in frames
        if not frame.used
    ]
    levels, deviations = _linearity(fit)
    good = np.isfinite(fit.residuals) & (fit.robust > 0.2)
    return ResponseResult(
        stored=nodes,
        linear=linear,
        sigma=sigma,
        dark=black,
        step=groups.step,
        covered=covered,
        frames=frames,
        residual=float(np.sqrt(np.mean(fit.residuals[good] ** 2))),
        expected=float(np.sqrt(np.mean(fit.sigma[good] ** 2))),
        jitter=fit.tau,
        levels=levels,
        deviations=deviations,
        moved=moved,
        warnings=tuple(warnings),
    )


def _refuse_poor_sweep(groups: SweepGroups, seen: NDArray[np.bool_]) -> None:
    exposures = np.unique(np.round(np.log(groups.exposures_s), 3))
    if len(exposures) < _LEAST_EXPOSURES:
        raise ResponseError(
            f"The sweep has {len(exposures)} different exposure times; at least {_LEAST_EXPOSURES} are "
            "needed, 8 to 12 are good, each 1.5 to 2 times the one before."
        )
    span = float(np.exp(exposures[-1] - exposures[0]))
    if span < _LEAST_SPAN:
        raise ResponseError(
            f"The longest exposure is {span:.2g} times the shortest; at least {_LEAST_SPAN:g} times is "
            "needed, 64 times is good."
        )
    order = np.argsort(groups.exposures_s)
    rises = []
    for before, after in itertools.pairwise(order):
        both = seen[before] & seen[after]
        if groups.exposures_s[after] > 1.3 * groups.exposures_s[before] and both.sum() >= _LEAST_GROUPS:
            rises.append(float(np.median((groups.median[after] - groups.median[before])[both])) > 0)
    if rises and np.mean(rises) < 0.75:
        raise ResponseError(_DOES_NOT_FOLLOW)
    clipped = float((groups.clipped > _CLIPPED_SHARE).mean())
    useful = int((seen.any(axis=2).sum(axis=0) >= 2).sum())
    if useful < _LEAST_GROUPS:
        why = "saturated" if clipped > 0.5 else "too dark, or clipped in the next exposure"
        raise ResponseError(
            f"Only {useful} of {seen.shape[1]} parts of the picture can be measured in two or more "
            f"exposures; the others are {why}. Change the light or the exposures so that most pictures are "
            "neither black nor white."
        )


def _refuse_bad_fit(fit: CurveFit, moved: float, covered: tuple[float, float]) -> None:
    if covered[1] < _LEAST_TOP:
        raise ResponseError(
            f"The brightest unclipped value is {covered[1]:.2f} of white; add longer exposures or light, so "
            "that the pictures reach up to white."
        )
    if fit.tau > _LARGEST_TAU:
        raise ResponseError(
            f"The brightness does not follow the exposure times (it scatters by {fit.tau:.0%}): an automatic "
            "is at work, the light changed, or the times belong to other pictures."
        )
    if moved > _LARGEST_MOVED_SHARE:
        raise ResponseError(
            f"{moved:.0%} of the picture does not fit any response: the scene or the camera moved during the "
            "sweep, or an automatic changed the picture. Fix the camera and film something that keeps still."
        )


def _without_wrong_frames(
    groups: SweepGroups,
    stored: Floats,
    seen: NDArray[np.bool_],
    unclipped: NDArray[np.bool_],
    channels: list[int],
    low: float,
) -> tuple[CurveFit, list[int], list[int]]:
    """Fits, leaves out the frame whose exposure is worst, and fits again, until none is wrong."""
    kept = list(range(len(groups.names)))
    wrong: list[int] = []
    while True:
        fit = solve_curve(
            choose_frames(groups, kept), stored[kept], seen[kept], unclipped[kept], channels, low
        )
        # Each frame's offset as the others see it, and what scatter is left without it (a Student's t).
        spare = np.maximum(1.0 - fit.leverage, 0.05)
        power = fit.offsets**2 / spare
        left_over = np.maximum(np.sum(fit.offsets**2) - power, 0.0) / max(len(kept) - 3, 1)
        sigmas = np.sqrt(power / np.maximum(left_over, _LEAST_SCATTER**2))
        worst = int(np.argmax(sigmas))
        limit = float(student.ppf(1.0 - _FALSE_ALARM / len(kept), max(len(kept) - 3, 1)))
        if sigmas[worst] <= limit or abs(fit.offsets[worst]) / spare[worst] <= _FRAME_OFF:
            return fit, wrong, kept
        wrong.append(kept.pop(worst))
        left = len(np.unique(np.round(np.log(groups.exposures_s[kept]), 3)))
        if len(wrong) > max(1, _LARGEST_WRONG_SHARE * len(groups.names)) or left < _LEAST_EXPOSURES:
            raise ResponseError(
                f"The brightness of {len(wrong)} of {len(groups.names)} frames does not follow their "
                "exposure times: an automatic is at work, the light changed, or the times belong to other "
                "pictures."
            )


def _table(fit: CurveFit, nodes: Floats, step: float, white: float) -> tuple[Floats, Floats]:
    """Radiance at stored values above the dark level, and its standard deviation; 1 at `white`."""
    design = fit.basis.values(nodes) - fit.basis.values(np.array([white]))
    logarithm = design @ fit.curve
    linear = np.minimum(np.exp(logarithm + fit.basis.below(nodes)), 1.0)
    linear[nodes <= 0] = 0.0
    variance = np.einsum("nq,qr,nr->n", design, fit.covariance, design) + (fit.power_sigma * logarithm) ** 2
    rounding = _ROUNDING * step / np.maximum(nodes, step) * (fit.basis.slopes(nodes) @ fit.curve)
    sigma = linear * np.sqrt(np.maximum(variance, 0.0) + rounding**2)
    return np.maximum.accumulate(linear), sigma


def _channels_differ(fit: CurveFit) -> bool:
    """Whether the residuals of some channel about the common curve have a mean at some level."""
    frames = len(fit.residuals)
    residuals, fitted, robust = (
        values.reshape(frames, -1, 3) for values in (fit.residuals, fit.fitted, fit.robust)
    )
    edges = np.linspace(0.0, 1.0, 11)
    for channel in range(3):
        good = np.isfinite(residuals[..., channel]) & (robust[..., channel] > 0.2)
        levels, told = fitted[..., channel][good], residuals[..., channel][good]
        for low, high in itertools.pairwise(edges):
            inside = told[(levels >= low) & (levels < high)]
            if len(inside) >= _LEAST_GROUPS:
                error = float(inside.std()) / np.sqrt(len(inside))
                if abs(inside.mean()) > max(_SAME_CURVE_SIGMAS * error, 0.5 * _SAME_CURVE):
                    return True
    return False


def _by_channel(
    linear: Floats,
    sigma: Floats,
    nodes: Floats,
    covered: tuple[float, float],
    groups: SweepGroups,
    stored: Floats,
    seen: NDArray[np.bool_],
    unclipped: NDArray[np.bool_],
    kept: list[int],
    low: float,
    black: Floats,
    warnings: list[str],
) -> tuple[Floats, Floats]:
    """One curve for all channels where they agree, else one for each."""
    tables = []
    for channel in range(3):
        if seen[kept][..., channel].sum() < 4 * _LEAST_GROUPS:
            return linear, sigma
        fit = solve_curve(
            choose_frames(groups, kept), stored[kept], seen[kept], unclipped[kept], [channel], low
        )
        tables.append(_table(fit, nodes, groups.step, 1.0 - float(black[channel])))
    inside = (nodes > max(covered[0], 0.05)) & (nodes < covered[1])
    each = np.stack([table for table, _ in tables], axis=1)
    each_sigma = np.stack([sigma_c for _, sigma_c in tables], axis=1)
    apart = np.abs(each - linear[:, None])[inside]
    if ((apart > _SAME_CURVE_SIGMAS * each_sigma[inside]) & (apart > _SAME_CURVE)).any():
        warnings.append(
            f"The channels have different curves (by up to {apart.max():.1%} of white); one was found for "
            "each."
        )
        return each, each_sigma
    return linear, sigma


def _frame_checks(
    groups: SweepGroups,
    fit: CurveFit,
    wrong: list[int],
    kept: list[int],
    stored: Floats,
    seen: NDArray[np.bool_],
    channels: list[int],
) -> tuple[FrameCheck, ...]:
    """What the light says of each frame, those that were left out too."""
    values = np.asarray(join_channels(stored, channels), dtype=np.float64)
    ok = np.asarray(join_channels(seen, channels), dtype=bool)
    log_t = np.log(groups.exposures_s)
    curve = fit.basis.values(values.ravel()) @ fit.curve + fit.basis.below(values.ravel())
    apart = curve.reshape(values.shape) - log_t[:, None]
    weights = np.where(np.isfinite(fit.residuals), fit.robust, 0.0)
    sure = weights.sum(axis=0) > 0.5
    level = np.where(sure, (np.nan_to_num(apart[kept]) * weights).sum(axis=0), np.nan)
    level = level / np.where(sure, weights.sum(axis=0), 1.0)
    checks = []
    for k, name in enumerate(groups.names):
        if k in kept:
            place = kept.index(k)
            off, sigma = float(fit.offsets[place]), float(fit.offset_sigma[place])
        else:
            told = (apart[k] - level)[ok[k] & sure]
            off = float(np.median(told)) if len(told) else float("nan")
            sigma = fit.tau
        checks.append(
            FrameCheck(name, float(groups.exposures_s[k]), float(np.expm1(off)), sigma, used=k not in wrong)
        )
    return tuple(checks)


def _moved_share(fit: CurveFit) -> float:
    """Share of the groups most of whose frames carry no weight, or scatter by more than noise could."""
    seen = np.isfinite(fit.residuals)
    known = seen.sum(axis=0) >= 2
    robust = np.where(seen, fit.robust, 0.0).sum(axis=0) / np.maximum(seen.sum(axis=0), 1)
    bad = robust < 0.5
    return float(bad[known].mean())


def _linearity(fit: CurveFit) -> tuple[Floats, Floats]:
    """Mean residual by level of stored values, levels that fewer than 30 groups have left out."""
    good = np.isfinite(fit.residuals) & (fit.robust > 0.2)
    values, residuals, weights = fit.fitted[good], fit.residuals[good], fit.sigma[good] ** -2.0
    levels, deviations = [], []
    edges = np.linspace(0.0, 1.0, 21)
    for low, high in itertools.pairwise(edges):
        inside = (values >= low) & (values < high)
        if inside.sum() >= 30:
            levels.append(float(values[inside].mean()))
            deviations.append(float(np.average(residuals[inside], weights=weights[inside])))
    return np.array(levels), np.array(deviations)
