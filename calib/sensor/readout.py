"""The readout of a rolling shutter: what the flashes of a film say of it, and when they do not say it.

Its uncertainty is three things in quadrature: what the fit states, the spread of the fit over parts of the
flashes (delete-a-group jackknife, Efron and Tibshirani 1993, section 11.5; widened for so few groups), and
what the fit's model of lamp and rows leaves out, which no spread shows. Where a session recorded only the
fit, a share of readout and exposure stands for the spread.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.errors import ReadoutError

Floats = NDArray[np.float64]

# Fewer flashes have edges in too few rows, and leave nothing when a part is left out.
_LEAST_FLASHES = 12
# Edges that leave so large a share of the frame interval out are in step with the camera.
_WIDEST_GAP = 0.5
# A readout below this share of the frame interval (1 ms at 30 frames a second), or within so many deviations
# of none, is a global shutter's, or does not matter.
_LEAST_SHARE, _SIGMAS = 0.03, 3.0
# Beyond this share of the readout, each tagging may as well fit it anew.
_WORST_SHARE = 0.1
# Of readout and exposure together: what the model leaves (a lamp that rises, time stamps, rows in bands); and
# with what a single fit is wrong by beyond what it states: with it, 95 % of the 108 films of known readout in
# benchmarks/results/tagging_grid.json have the truth within 1.96 deviations, and 87 % without.
_MODEL_SHARE, _ALONE_SHARE = 0.005, 0.015
# 97.5 % of Student's t at 3 degrees of freedom over a normal's: four parts tell a spread no better.
_FEW_PARTS = 3.182 / 1.960


@dataclass(frozen=True, eq=False)
class ReadoutResult:
    """A readout that was measured.

    Attributes:
        readout_s: from the first row's start to the last row's, negative when the bottom row is first.
        sigma_s: standard deviation, all doubts together.
        flashes: that it was fitted to.
    """

    readout_s: float
    sigma_s: float
    flashes: int


def judge_readout(
    readout_s: float,
    fit_sigma_s: float,
    exposure_s: float,
    interval_s: float,
    on_s: ArrayLike,
    without_s: ArrayLike,
) -> ReadoutResult:
    """The readout with its whole uncertainty.

    Args:
        readout_s: fitted to all flashes, s.
        fit_sigma_s: what the fit states, s.
        exposure_s: of a row, s.
        interval_s: from frame to frame, s.
        on_s: [P] when the flashes began, s.
        without_s: [G] the readout without each of G parts of the flashes, s; empty = only one fit
            is known.

    Raises:
        ReadoutError: too few flashes, in step with the camera, a global shutter, or too uncertain.
    """
    began_s, parts_s = np.asarray(on_s, np.float64), np.asarray(without_s, np.float64)
    if len(began_s) < _LEAST_FLASHES:
        raise ReadoutError(
            f"{len(began_s)} flashes are too few to measure the readout; film at least {_LEAST_FLASHES}, "
            "better thirty."
        )
    if (gap := _widest_gap(began_s / interval_s)) > _WIDEST_GAP:
        raise ReadoutError(
            f"The flash is in step with the camera: {gap:.0%} of the time between two frames holds no edge "
            "of it, so most rows never saw one; let it blink with a period that is no multiple of "
            f"{1e3 * interval_s:.1f} ms, as 1.013 s."
        )
    groups, span_s = len(parts_s), abs(readout_s) + exposure_s
    spread_s, model_s = 0.0, _ALONE_SHARE * span_s
    if groups > 1:
        squares = float(np.sum(np.square(parts_s - parts_s.mean())))
        spread_s, model_s = _FEW_PARTS * np.sqrt((groups - 1) / groups * squares), _MODEL_SHARE * span_s
    sigma_s = math.hypot(fit_sigma_s, spread_s, model_s)
    if abs(readout_s) < max(_LEAST_SHARE * interval_s, _SIGMAS * sigma_s):
        raise ReadoutError(
            f"No readout can be told from none ({1e3 * readout_s:.2f} ± {1e3 * sigma_s:.2f} ms): the shutter "
            "is global, or the flashes are too irregular or too weak; a global shutter needs no readout."
        )
    if sigma_s > _WORST_SHARE * abs(readout_s):
        raise ReadoutError(
            f"The readout is known to {sigma_s / abs(readout_s):.0%} only ({1e3 * readout_s:.1f} ± "
            f"{1e3 * sigma_s:.1f} ms, {_WORST_SHARE:.0%} needed); use a flash with a steady period, film it "
            "for longer on a tripod, or state the exposure time with --exposure-ms."
        )
    return ReadoutResult(readout_s, sigma_s, len(began_s))


def _widest_gap(phase: Floats) -> float:
    """Largest share of a turn without a phase in it; phases in turns."""
    around = np.sort(phase % 1.0)
    return float(np.diff(np.append(around, around[0] + 1.0)).max())
