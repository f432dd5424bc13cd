"""A stretch's tags held against the flash's schedule: frames that contradict it, pulses that did not come."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from capture.tagging.config import TaggingConfig
from capture.tagging.expected import find_contradictions, predicted_lit_fraction
from capture.tagging.result import FrameTag
from capture.tagging.stream_summary import Counts

Floats = NDArray[np.float64]

_ROWS = 4  # by which a pulse that no frame can show is told
_TRACE_LENGTHS = 2.0  # how near a frame is to a pulse that was not seen


@dataclass(frozen=True, eq=False)
class Schedule:
    """What the flash was to do, on the frames' axis, and the shutter that looked.

    Attributes:
        on_s: [P] starts of the pulses, increasing.
        length_s: of each.
        slack_s: doubt of an edge.
        readout_s: from the first row's start to the last row's, signed.
        exposure_s: of a row.
    """

    on_s: Floats
    length_s: float
    slack_s: float
    readout_s: float
    exposure_s: float


def hold_against_schedule(
    pts_s: Floats,
    tags: Sequence[FrameTag],
    own: range,
    schedule: Schedule,
    *,
    seen_s: Floats,
    unmatched_s: Sequence[float],
    counts: Counts,
    config: TaggingConfig,
) -> list[FrameTag]:
    """The tags, without those that the schedule contradicts or makes doubtful.

    Args:
        pts_s: [K] start of the frames.
        tags: [K].
        own: the frames whose tags are final now; only these change, and only these are counted.
        schedule: what was to be.
        seen_s: starts of all pulses that were found among the frames.
        unmatched_s: those of the own frames that have no command.
        counts: gets "contradiction", "unseen" and "unscheduled" with their times.
        config: limits of the labels.
    """
    on_s, off_s = schedule.on_s, schedule.on_s + schedule.length_s
    shutter = {"readout_s": schedule.readout_s, "exposure_s": schedule.exposure_s}
    wrong, possible = find_contradictions(
        pts_s, tags, on_s, off_s, **shutter, slack_s=schedule.slack_s, config=config
    )
    shown = predicted_lit_fraction(pts_s, on_s, off_s, **shutter, rows=_ROWS).max(axis=1)
    begin_s, end_s = pts_s[own.start], pts_s[own.stop] if own.stop < len(pts_s) else np.inf
    traces = np.zeros(len(pts_s), bool)  # of a pulse that came while frames were lost, perhaps
    for time_s in on_s:
        if np.any(np.abs(seen_s - time_s) < 0.5 * schedule.length_s + schedule.slack_s):
            continue
        burning = (pts_s >= time_s) & (pts_s < time_s + schedule.length_s)
        if begin_s <= time_s < end_s and np.any(shown[burning] > 0):
            counts.happened("unseen", [float(time_s)])
        traces |= (np.abs(pts_s - time_s) < _TRACE_LENGTHS * schedule.length_s) & (possible > 0)
    counts.happened("contradiction", [float(pts_s[k]) for k in own if wrong[k]])
    counts.happened("unscheduled", [t for t in unmatched_s if on_s[0] < t < on_s[-1]])
    out = list(tags)
    for k in own:
        if wrong[k]:
            out[k] = _doubted(tags[k], "contradiction", tags[k].lit_fraction)
        elif traces[k] and tags[k].flash == 0:
            out[k] = _doubted(tags[k], "flash_uncertain", None)
    return out


def _doubted(tag: FrameTag, reason: str, lit_fraction: float | None) -> FrameTag:
    return replace(tag, flash=None, lit_fraction=lit_fraction, confidence=0.5, reasons=(*tag.reasons, reason))
