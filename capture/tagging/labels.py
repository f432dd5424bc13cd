"""Labels of the frames around the pulses, out of what is known of the pulses' edges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from capture.tagging.bands import BandGains
from capture.tagging.config import TaggingConfig
from capture.tagging.edges import EdgeCurve, EdgeRange, Edges, calibrated, find_edges
from capture.tagging.known import Commands
from capture.tagging.schedule import Hypothesis, fit_rhythm, neighbours_log_prior
from capture.tagging.shutter import lit_share, share_after, sharp_limits
from capture.tagging.shutter_fit import Shutter

Floats = NDArray[np.float64]

# Gauss-Hermite points and weights of a normal distribution, exact to the fifth power.
_STRETCHES = ((-(3**0.5), 1 / 6), (0.0, 2 / 3), (3**0.5, 1 / 6))
_STEP_S = 5e-4
# Errors of time stamps that a label must survive, in standard deviations.
_STAMP_SIGMAS = 3.0
# Bands for the mean lit share of a frame: it is nearly linear in them.
_COARSE_BANDS = 4


@dataclass(frozen=True, eq=False)
class EdgeLabels:
    """What the edges say of the frames around each pulse; arrays are [P, n] as in `BandGains`, or [P].

    Attributes:
        full: probability that every row is lit.
        none: probability that no row is lit.
        lit: expected lit share of the frame.
        excess: measured light less what the likeliest edges say, as a share of a full flash.
        excess_sigma: its standard deviation.
        on_s: expected t_on.
        off_s: expected t_off.
        on_sigma_s: standard deviation of t_on.
        off_sigma_s: standard deviation of t_off.
        gain: mean gain of the pulse over the usual.
    """

    full: Floats
    none: Floats
    lit: Floats
    excess: Floats
    excess_sigma: Floats
    on_s: Floats
    off_s: Floats
    on_sigma_s: Floats
    off_sigma_s: Floats
    gain: Floats


def label_frames(
    data: BandGains,
    edges: EdgeRange,
    shutter: Shutter,
    gain_prior: Floats,
    config: TaggingConfig,
    commands: Commands | None = None,
) -> EdgeLabels:
    """Label probabilities, averaged over the unknown common stretch of readout and exposure."""
    middle = find_edges(data, edges, shutter.readout_s, shutter.exposure_s, gain_prior, _STEP_S)
    data = calibrated(data, middle, shutter.readout_s, shutter.exposure_s)
    points = ((0.0, 1.0),) if shutter.certain else _STRETCHES
    likely: _Hypotheses | None = None
    slack_s = _STAMP_SIGMAS * config.stamp_sigma_s + shutter.small_doubt_s
    shape = data.start_s.shape
    full, none, lit = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    for sigmas, weight in points:
        readout_s, exposure_s = shutter.stretched(sigmas)
        found = find_edges(data, edges, readout_s, exposure_s, gain_prior, _STEP_S)
        on_p, off_p, ways = _posterior(found, config, commands, likely)
        if commands is not None:  # the lamp's lateness, which is about the same for a shutter nearly the same
            likely = ways
        f, n, a = _probabilities(data.start_s, found, on_p, off_p, readout_s, exposure_s, slack_s, config)
        full, none, lit = full + weight * f, none + weight * n, lit + weight * a
        if sigmas == 0.0:
            middle, middle_p = found, (on_p, off_p)
    excess, excess_sigma = _excess(data, middle, shutter)
    on_s, on_sigma_s = _moments(middle.on, middle_p[0])
    off_s, off_sigma_s = _moments(middle.off, middle_p[1])
    gain = (middle.gain * gain_prior).sum(axis=1) / np.square(gain_prior).sum()
    return EdgeLabels(full, none, lit, excess, excess_sigma, on_s, off_s, on_sigma_s, off_sigma_s, gain)


_Hypotheses = tuple[Sequence[Hypothesis], Sequence[Hypothesis]]


def _posterior(
    found: Edges, config: TaggingConfig, commands: Commands | None, likely: _Hypotheses | None
) -> tuple[Floats, Floats, _Hypotheses]:
    """Probabilities on both edges' grids, with what the other pulses' rhythm or lateness says, and the ways
    in which they may be regular: looked for where none are given.
    """
    on, off = found.on, found.off
    locked = None if commands is None else commands.partners(on.best_s)
    if commands is not None and locked is not None:
        cycle, _ = locked
        apart = np.diff(commands.times_s)
        period_s = float(np.median(apart)) if len(apart) else config.longest_period_s
        # Times are moved so that the commands are a period apart: what is left of a rhythm is lateness.
        moved = np.where(cycle >= 0, commands.times_s[cycle] - cycle * period_s, 0.0)[:, None]
        on, off = EdgeCurve(on.time_s - moved, on.log), EdgeCurve(off.time_s - moved, off.log)
    else:
        rhythm = fit_rhythm(0.5 * (on.best_s + off.best_s), config)
        if rhythm is None:
            return on.probability(), off.probability(), ((), ())
        cycle, period_s = rhythm.cycle, rhythm.period_s
    on_prior, on_likely = neighbours_log_prior(on, cycle, period_s, likely[0] if likely else None)
    off_prior, off_likely = neighbours_log_prior(off, cycle, period_s, likely[1] if likely else None)
    return found.on.probability(on_prior), found.off.probability(off_prior), (on_likely, off_likely)


def _probabilities(
    start_s: Floats,
    found: Edges,
    on_p: Floats,
    off_p: Floats,
    readout_s: float,
    exposure_s: float,
    slack: float,
    config: TaggingConfig,
) -> tuple[Floats, Floats, Floats]:
    """[P, n] probability of fully lit, of unlit, and expected lit share."""
    on_full, off_full, off_none, on_none = sharp_limits(
        readout_s, exposure_s, config.full_lit, config.none_lit
    )
    full = _until(found.on, on_p, start_s + on_full - slack)
    full = full * (1 - _until(found.off, off_p, start_s + off_full + slack))
    none = _until(found.off, off_p, start_s + off_none - slack)
    none = none + 1 - _until(found.on, on_p, start_s + on_none + slack)
    lit = 0.0
    for curve, p, sign in ((found.on, on_p, 1), (found.off, off_p, -1)):
        share = share_after(start_s[:, None], curve.time_s[..., None], readout_s, exposure_s, _COARSE_BANDS)
        lit = lit + sign * np.einsum("pg,pgn->pn", p, share.mean(axis=-1))
    return full, np.clip(none, 0, 1), np.clip(lit, 0, 1)


def _until(curve: EdgeCurve, p: Floats, time_s: Floats) -> Floats:
    """[P, n] probability that an edge comes before a time."""
    return np.einsum("pg,pgn->pn", p, curve.time_s[:, :, None] <= time_s[:, None, :])


def _excess(data: BandGains, found: Edges, shutter: Shutter) -> tuple[Floats, Floats]:
    """[P, n] measured light less the predicted, as a share of a full flash, and its standard deviation."""
    lit = lit_share(
        data.start_s,
        found.on.best_s[:, None],
        found.off.best_s[:, None],
        shutter.readout_s,
        shutter.exposure_s,
        data.gain.shape[-1],
    )
    weight = data.weight * found.gain[:, None]
    power = np.maximum((weight * found.gain[:, None]).sum(axis=-1), 1e-12)
    excess = (weight * (data.gain - lit * found.gain[:, None])).sum(axis=-1) / power
    return excess, 1 / np.sqrt(power)


def _moments(curve: EdgeCurve, p: Floats) -> tuple[Floats, Floats]:
    mean = (p * curve.time_s).sum(axis=1)
    return mean, np.sqrt((p * np.square(curve.time_s - mean[:, None])).sum(axis=1))
