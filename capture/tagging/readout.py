"""The readout of a rolling shutter for its own sake: with how far it may be off, and whether edges wandered.

The tagger's fit (`shutter_fit`) states what the evidence of its pulses says. Pulses err together where one of
them does, so here the fit is made again without each quarter of the pulses: the spread of those fits is the
delete-a-group jackknife (Efron and Tibshirani 1993, An Introduction to the Bootstrap, section 11.5).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from capture.errors import TaggingError
from capture.tagging.analysis import analyse
from capture.tagging.config import TaggingConfig
from capture.tagging.profiles import FrameProfiles
from capture.tagging.shutter_fit import Shutter, fit_shutter
from capture.tagging.windows import edge_range

Floats = NDArray[np.float64]

#: Parts of the pulses that are left out in turn.
PARTS = 4
# Pulses from which leaving out a part leaves enough to fit.
_LEAST_PULSES = 8


@dataclass(frozen=True, eq=False)
class ReadoutEvidence:
    """What the pulses of one sequence say of the readout.

    Attributes:
        readout_s: from the first row's start to the last row's, negative when the bottom row is first.
        fit_sigma_s: its standard deviation by the evidence of the fit.
        without_s: [PARTS] the readout without each part of the pulses; empty = too few pulses for that.
        exposure_s: of a row.
        interval_s: from frame to frame.
        on_s: [P] when the pulses began, on the frames' time axis.
    """

    readout_s: float
    fit_sigma_s: float
    without_s: Floats
    exposure_s: float
    interval_s: float
    on_s: Floats


def measure_readout(profiles: FrameProfiles, config: TaggingConfig | None = None) -> ReadoutEvidence:
    """Fits the readout of a sequence to all of its pulses, and again without each part of them.

    Args:
        profiles: of all frames, in order.
        config: the exposure, where it is known; a known readout is not looked at.

    Raises:
        TaggingError: no flash, a flash that is always on, or too few frames.
    """
    config = replace(config or TaggingConfig(), readout_s=None, readout_sigma_s=0.0)
    seen = profiles.take(np.flatnonzero(profiles.readable))
    if len(seen) < 2:
        raise TaggingError(f"Only {len(seen)} of {len(profiles)} frames can be used; film for half a minute.")
    found = analyse(seen, config).found
    pulses = len(found.windows)
    strong = np.array([not window.weak for window in found.windows])
    gain_prior = np.maximum(np.median(found.data.gain[strong].max(axis=1), axis=0), 1e-3)
    edges = edge_range(seen.pts_s, found.windows, seen.interval_s, config)
    cycle = np.full(pulses, -1) if found.rhythm is None else np.asarray(found.rhythm.cycle)
    part = np.arange(pulses) % PARTS  # interleaved, so that a drift is in all of them

    def fit(index: NDArray[np.int_]) -> Shutter:
        data, ranges = found.data.take(index), edges.take(index)
        return fit_shutter(data, ranges, cycle[index], gain_prior, seen.interval_s, config)

    whole = found.shutter
    if not whole.readout_sigma_s > 0:  # the room's flicker told it, without saying how well
        whole = fit(np.arange(pulses))
    left_out = range(PARTS) if pulses >= _LEAST_PULSES else ()
    others = [fit(np.flatnonzero(part != number)) for number in left_out]
    return ReadoutEvidence(
        readout_s=whole.readout_s,
        fit_sigma_s=whole.readout_sigma_s,
        without_s=np.array([other.readout_s for other in others]),
        exposure_s=whole.exposure_s,
        interval_s=seen.interval_s,
        on_s=np.asarray(found.labels.on_s),
    )
