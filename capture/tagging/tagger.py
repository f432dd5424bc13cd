"""From profiles to tags: what the frames show (`analysis`), and what is left to be said of them.

Said of single frames and of the sequence: clipping, drift, gaps, a schedule that does not fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from capture.errors import TaggingError
from capture.tagging.analysis import Analysis, Found, analyse, missed_times
from capture.tagging.config import TaggingConfig
from capture.tagging.prior import check_prior
from capture.tagging.profiles import FrameProfiles
from capture.tagging.result import FlashPrior, FrameTag, PriorCheck, Pulse, TagResult
from capture.tagging.shutter_fit import Shutter

# Frames farther apart than this many usual intervals have others missing between them.
_GAP = 1.5
# A readout that is known no better than this share of the frame interval is not told.
_KNOWN_SHARE = 0.25


def tag(
    profiles: FrameProfiles,
    *,
    schedule: FlashPrior | None = None,
    config: TaggingConfig | None = None,
) -> TagResult:
    """Tag every frame of a sequence.

    Args:
        profiles: of all frames, in order.
        schedule: when the flash was asked to be on; checked, not believed.
        config: limits, and what is known of the camera.

    Returns:
        A tag for each frame, the pulses, and what was learnt of the shutter and the rhythm.

    Raises:
        TaggingError: no flash, a flash that is always on, too few frames, or a schedule that contradicts
            the frames.
    """
    config = config or TaggingConfig()
    seen = np.flatnonzero(profiles.readable)
    if len(seen) < 8:
        raise TaggingError(
            f"Only {len(seen)} of {len(profiles)} frames can be used; at least 8, with and without flash, "
            "are needed."
        )
    readable = profiles.take(seen)
    analysis = analyse(readable, config)
    check: PriorCheck | None = None
    more: list[str] = []
    if schedule is not None:
        on_s, off_s = analysis.found.labels.on_s, analysis.found.labels.off_s
        check, more = check_prior(schedule, on_s, off_s, float(readable.pts_s[0]), float(readable.pts_s[-1]))
    return result_of(profiles, seen, analysis, config, check, more)


def with_remarks(
    profiles: FrameProfiles,
    seen: NDArray[np.int_],
    frames: list[FrameTag],
    drifted: NDArray[np.bool_],
    config: TaggingConfig,
) -> list[FrameTag]:
    """Tags of all frames, with what is to be said besides the flash.

    Args:
        profiles: of all frames.
        seen: [K] the readable ones.
        frames: [K] their tags, the flash only.
        drifted: [K] bool, whose exposure or white balance is not that of most frames.
        config: limits of clipping.
    """
    tags = [FrameTag(None, None, 0.0, ("unreadable",))] * len(profiles)
    for k, frame, drifts in zip(seen, frames, drifted, strict=True):
        tags[k] = replace(frame, reasons=(*frame.reasons, "drift")) if drifts else frame
    late = np.diff(profiles.pts_s, prepend=profiles.pts_s[0]) > _GAP * profiles.interval_s
    for k, share in enumerate(profiles.clipped()):
        remarks = ["clipped"] if share > config.clipped_share else []
        if share > config.hopeless_share:
            remarks.append("clipped_frame")
        if late[k]:
            remarks.append("dropped_before")
        if remarks:
            tags[k] = replace(tags[k], reasons=(*tags[k].reasons, *remarks))
    return tags


def _warnings(analysis: Analysis) -> list[str]:
    """Sentences on the whole sequence."""
    found, flicker = analysis.found, analysis.flicker
    out = []
    if not any(frame.flash == 1 for frame in analysis.frames):
        out.append(
            "No frame is lit in every row: the pulses are too short for this shutter; make them longer "
            "than exposure, "
            "readout and frame interval together."
        )
    if found.rhythm is None:
        out.append(f"{len(found.windows)} pulses are too few to tell a period.")
    else:
        if found.rhythm.missed:
            times = ", ".join(f"{t:.2f}" for t in missed_times(found)[:5])
            out.append(
                f"{len(found.rhythm.missed)} pulses did not come (at {times} s); those frames are without "
                "flash."
            )
        extra = int(np.sum(found.rhythm.cycle < 0))
        if extra:
            out.append(
                f"{extra} pulses are outside of the rhythm; their frames are tagged by what they show."
            )
    if found.doubtful:
        out.append(
            f"{len(found.doubtful)} bright moments do not look like the flash; their frames are left "
            "untagged."
        )
    if flicker is not None:
        out.append(
            f"The room light flickers at {flicker.frequency_hz:.1f} Hz by {100 * flicker.depth:.1f} %; "
            "expose for a multiple "
            f"of {1e3 / flicker.frequency_hz:.1f} ms, or use daylight."
        )
    return out + analysis.drift.warnings()


def result_of(
    profiles: FrameProfiles,
    seen: NDArray[np.int_],
    analysis: Analysis,
    config: TaggingConfig,
    check: PriorCheck | None = None,
    more: Sequence[str] = (),
) -> TagResult:
    """Everything about a sequence of which the readable frames have been analysed.

    Args:
        profiles: of all frames.
        seen: [K] the readable ones.
        analysis: of those.
        config: limits of clipping.
        check: of a schedule.
        more: warnings that come with it.
    """
    tags = with_remarks(profiles, seen, analysis.frames, analysis.drift.affected, config)
    found, flicker = analysis.found, analysis.flicker
    shutter, rhythm = found.shutter, found.rhythm
    known = shutter_is_known(shutter, profiles.take(seen).interval_s)
    return TagResult(
        frames=tuple(tags),
        pulses=tuple(pulses_of(found, seen)),
        period_s=rhythm.period_s if rhythm is not None else None,
        period_sigma_s=rhythm.period_sigma_s if rhythm is not None else None,
        jitter_s=rhythm.jitter_s if rhythm is not None else None,
        missed_s=tuple(missed_times(found)),
        readout_s=shutter.readout_s if known else None,
        readout_sigma_s=shutter.readout_sigma_s if known else None,
        exposure_s=shutter.exposure_s if known else None,
        exposure_sigma_s=shutter.exposure_sigma_s if known else None,
        separation=analysis.split.separation,
        flicker_hz=flicker.frequency_hz if flicker is not None else None,
        flicker_depth=flicker.depth if flicker is not None else None,
        prior=check,
        warnings=(*_warnings(analysis), *more),
    )


def shutter_is_known(shutter: Shutter, interval_s: float) -> bool:
    """Whether the readout is known well enough to be told."""
    return shutter.readout_sigma_s < _KNOWN_SHARE * interval_s


def pulses_of(found: Found, seen: NDArray[np.int_]) -> list[Pulse]:
    """The pulses, with the numbers of the frames among all frames [K] = `seen`."""
    labels, rhythm = found.labels, found.rhythm
    pulses = []
    for p, window in enumerate(found.windows):
        touched = window.begin + np.flatnonzero(labels.none[p, : window.end - window.begin] < 0.5)
        first, last = (int(touched[0]), int(touched[-1])) if len(touched) else (window.first, window.last)
        cycle = int(rhythm.cycle[p]) if rhythm is not None and rhythm.cycle[p] >= 0 else None
        pulses.append(
            Pulse(
                t_on_s=float(labels.on_s[p]),
                t_off_s=float(labels.off_s[p]),
                t_on_sigma_s=float(labels.on_sigma_s[p]),
                t_off_sigma_s=float(labels.off_sigma_s[p]),
                gain=float(labels.gain[p]),
                cycle=cycle,
                frames=(int(seen[first]), int(seen[last]) + 1),
            )
        )
    return pulses
