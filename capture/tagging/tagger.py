"""From profiles to tags: the order in which the parts are asked.

1. mains flicker of the room light is found and taken out (`flicker`),
2. frames are split into lit and unlit (`split`); no two classes, no tags,
3. around each pulse the gain over the motion-compensated unlit frames is measured (`windows`, `reference`,
   `bands`),
4. readout and exposure are fitted for the sequence, the edges for each pulse (`shutter_fit`, `edges`),
5. labels follow from the edges and their rhythm, and are checked against the light that was measured
   (`labels`),
6. what is left is said of single frames and of the sequence: clipping, drift, gaps, a schedule that does
   not fit.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from capture.errors import TaggingError
from capture.tagging.bands import BandGains, band_gains
from capture.tagging.config import TaggingConfig
from capture.tagging.drift import Drift, measure_drift
from capture.tagging.flicker import Flicker, find_flicker
from capture.tagging.labels import EdgeLabels, label_frames
from capture.tagging.prior import check_prior
from capture.tagging.profiles import THUMBNAIL_ROWS, FrameProfiles
from capture.tagging.reference import BANDS, PulseGain, Reference
from capture.tagging.result import FlashPrior, FrameTag, PriorCheck, Pulse, TagResult
from capture.tagging.schedule import Rhythm, fit_rhythm
from capture.tagging.shutter_fit import Shutter, fit_shutter
from capture.tagging.split import BLOCKS, Split, split_frames
from capture.tagging.windows import PulseWindow, edge_range, find_windows

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

# Frames farther apart than this many usual intervals have others missing between them.
_GAP = 1.5
# Light that differs from what the edges say by more than this share of the pulse, beyond twice its noise,
# is not believed: a lamp still rising, or something that is no pulse. Less is droop.
_DIM, _GLOW = 0.07, 0.05
# A candidate without any mostly lit frame must have this share of the usual pulse's light.
_LEAST_GAIN = 0.3
# A blinking flash gives at least this share of the pulses that the longest period allows.
_LEAST_PULSES = 0.4
# The pulses' patterns over the picture agree when their correlation is above the first; chance patterns of
# motion have nothing in common. One pulse that does not fit the others, below the second, is another light.
_AGREEMENT, _LEAST_AGREEMENT = 0.25, 0.1
_PATTERN_BLOCKS = 8
# A flicker with fewer waves over the rows does not measure the readout.
_LEAST_WAVES = 0.7
# A readout that is known no better than this share of the frame interval is not told.
_KNOWN_SHARE = 0.25
# Tails of the scores in the confidence of frames far from any pulse: motion's are heavy (Student-t).
_TAIL = 3.0
_LIT_SPREAD = 0.15


def tag(
    profiles: FrameProfiles, *, schedule: FlashPrior | None = None, config: TaggingConfig | None = None
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
    split, flicker, blocks = _split(readable, config)
    found = _find_pulses(readable, split, flicker, config)
    frames = _frame_labels(readable, split, found, config)
    unlit = np.array([frame.flash == 0 for frame in frames])
    drift = measure_drift(readable.pts_s, blocks, readable.color, unlit)
    check, warnings = None, _warnings(found, flicker, drift, frames)
    if schedule is not None:
        on_s, off_s = found.labels.on_s, found.labels.off_s
        check, more = check_prior(schedule, on_s, off_s, float(readable.pts_s[0]), float(readable.pts_s[-1]))
        warnings += more
    tags = _with_remarks(profiles, seen, frames, drift, config)
    return _result(tags, seen, found, split, flicker, check, warnings, readable.interval_s)


@dataclass(frozen=True, eq=False)
class _Found:
    """The pulses of the readable frames."""

    windows: list[PulseWindow]
    doubtful: list[PulseWindow]
    data: BandGains
    labels: EdgeLabels
    shutter: Shutter
    rhythm: Rhythm | None


def _split(
    profiles: FrameProfiles, config: TaggingConfig
) -> tuple[Split, Flicker | None, NDArray[np.float32]]:
    """Lit and unlit frames, with the room's flicker taken out of the unlit part where there is any."""
    blocks = profiles.blocks(BANDS, BLOCKS)
    rows = np.log(blocks).mean(axis=2).astype(float)
    level = rows.mean(axis=1)
    # before any class is known: frames that stand out of their neighbourhood are left out
    stands_out = level - np.array([np.median(level[max(k - 15, 0) : k + 16]) for k in range(len(level))])
    usual = 1.4826 * np.median(np.abs(stands_out)) + 1e-6
    flicker = find_flicker(profiles.pts_s, rows, np.abs(stands_out) < 4 * usual, BANDS, config)
    if flicker is not None:
        blocks = np.asarray(blocks / flicker.row_gain[:, :, None], np.float32)
    square = blocks.reshape(len(profiles), BLOCKS, BANDS // BLOCKS, BLOCKS).mean(axis=2)
    split = split_frames(profiles.pts_s, square, config)
    if flicker is not None:  # again, from the frames that are unlit, for the rows of the thumbnails
        unlit = ~ndimage.binary_dilation(split.score > 0.25, iterations=2)
        flicker = find_flicker(profiles.pts_s, rows, unlit, THUMBNAIL_ROWS, config) or flicker
    return split, flicker, square


def _find_pulses(
    profiles: FrameProfiles, split: Split, flicker: Flicker | None, config: TaggingConfig
) -> _Found:
    """Pulses, their edges and the shutter."""
    pts_s, interval_s = profiles.pts_s, profiles.interval_s
    candidates = find_windows(pts_s, split, config)
    usable = flicker is not None and flicker.row_gain.shape[1] == THUMBNAIL_ROWS
    reference = Reference(profiles, flicker.row_gain if flicker is not None and usable else None)
    gains = [reference.gain(np.arange(w.begin, w.end), w.before, w.after) for w in candidates]
    credible = _credible(candidates, gains, float(pts_s[-1] - pts_s[0]), config)
    windows = [w for w, good in zip(candidates, credible, strict=True) if good]
    doubtful = [w for w, good in zip(candidates, credible, strict=True) if not good]
    data = band_gains([g for g, good in zip(gains, credible, strict=True) if good], split.pattern, pts_s)
    strong = np.array([not w.weak for w in windows])
    # the brightest frame of each pulse, over the pulses
    gain_prior = np.maximum(np.median(data.gain[strong].max(axis=1), axis=0), 1e-3)
    middle_s = np.array([0.5 * (pts_s[w.first] + pts_s[w.last]) for w in windows])
    coarse = fit_rhythm(middle_s, config)
    cycle = coarse.cycle if coarse is not None else np.full(len(windows), -1)
    if flicker is not None and config.readout_s is None and abs(flicker.waves) > _LEAST_WAVES:
        config = replace(config, readout_s=flicker.readout_s)  # the wave over the rows measures it
    edges = edge_range(pts_s, windows, interval_s, config)
    shutter = fit_shutter(data, edges, cycle, gain_prior, interval_s, config)
    labels = label_frames(data, edges, shutter, gain_prior, config)
    rhythm = fit_rhythm(0.5 * (labels.on_s + labels.off_s), config)
    return _Found(windows, doubtful, data, labels, shutter, rhythm)


def _credible(
    windows: list[PulseWindow], gains: list[PulseGain], duration_s: float, config: TaggingConfig
) -> list[bool]:
    """Which candidates are pulses of one flash.

    Raises:
        TaggingError: they are too few, or have no pattern in common.
    """
    strong = [i for i, w in enumerate(windows) if not w.weak]
    due = _LEAST_PULSES * duration_s / config.longest_period_s
    if len(strong) < max(due, 1):
        raise TaggingError(
            f"Only {len(strong)} pulses of light were found in {duration_s:.1f} s; a flash that blinks every "
            f"{config.shortest_period_s:g} to {config.longest_period_s:g} s gives at least "
            f"{int(np.ceil(due))}. Check that "
            "it blinked, and that it is bright enough for the room."
        )
    maps = np.array([_map(w, g) for w, g in zip(windows, gains, strict=True)])
    if len(strong) < 2:
        return [not w.weak for w in windows]
    total = maps[strong].sum(axis=0)
    agreement = np.array([float(m @ (total - m * (i in strong))) for i, m in enumerate(maps)])
    agreement /= [np.linalg.norm(total - m * (i in strong)) + 1e-9 for i, m in enumerate(maps)]
    usual = float(np.median(agreement[strong]))
    if usual < _AGREEMENT:
        raise TaggingError(
            f"The {len(strong)} bright moments found have no pattern in common (correlation {usual:.2f}, "
            "at least "
            f"{_AGREEMENT} needed): they are motion or other lights, not one flash. Check that the flash "
            "blinked, and "
            "that it is bright enough for the room."
        )
    return [bool(a >= _LEAST_AGREEMENT) for a in agreement]


def _map(window: PulseWindow, gain: PulseGain) -> Floats:
    """Unit vector of the light's pattern over the picture in the window's lit frames."""
    lit = gain.gain[window.first - window.begin : window.last + 1 - window.begin]
    # one passing lamp must not make the pattern
    middle = np.clip(np.median(lit, axis=0), -0.5, 3.0).astype(np.float32)
    small = (
        cv2.resize(middle, (_PATTERN_BLOCKS, _PATTERN_BLOCKS), interpolation=cv2.INTER_AREA)
        .astype(float)
        .ravel()
    )
    return small / (np.linalg.norm(small) + 1e-9)


def _frame_labels(
    profiles: FrameProfiles, split: Split, found: _Found, config: TaggingConfig
) -> list[FrameTag]:
    """Tags of the readable frames, flash only."""
    tags = [_far_label(score, split.spread) for score in split.score]
    for window in found.doubtful:
        for k in range(window.begin, window.end):
            if split.score[k] > 4 * split.spread:
                tags[k] = FrameTag(None, None, 0.5, ("flash_uncertain",))
    labels = found.labels
    for p, i in zip(*np.nonzero(found.data.frames >= 0), strict=True):
        k = int(found.data.frames[p, i])
        tags[k] = _near_label(
            full=float(labels.full[p, i]),
            none=float(labels.none[p, i]),
            lit=float(labels.lit[p, i]),
            excess=float(labels.excess[p, i]),
            sigma=float(labels.excess_sigma[p, i]),
            config=config,
        )
    return tags


def _far_label(score: float, spread: float) -> FrameTag:
    """Tag of a frame away from all pulses, by its score alone."""
    unlit = (1 + (score / spread) ** 2 / _TAIL) ** (-(_TAIL + 1) / 2) / spread
    lit = (1 + ((score - 1) / _LIT_SPREAD) ** 2 / _TAIL) ** (-(_TAIL + 1) / 2) / _LIT_SPREAD
    probability = unlit / (unlit + lit)
    if score > 0.5:
        return FrameTag(None, None, float(max(probability, 1 - probability)), ("flash_uncertain",))
    return FrameTag(0, 0.0, float(probability), ())


def _near_label(
    *, full: float, none: float, lit: float, excess: float, sigma: float, config: TaggingConfig
) -> FrameTag:
    """Tag of a frame at a pulse, by the edges' posterior and the light that was measured."""
    partial = max(1.0 - full - none, 0.0)
    if full >= 1 - config.risk:
        if excess + 2 * sigma < -_DIM:
            return FrameTag(None, min(max(lit + excess, 0.0), 1.0), 0.9, ("partial_flash",))
        return FrameTag(1, lit, full, ())
    if none >= 1 - config.risk:
        if excess - 2 * sigma > _GLOW:
            return FrameTag(None, min(max(lit + excess, 0.0), 1.0), 0.5, ("flash_uncertain",))
        return FrameTag(0, lit, none, ())
    if partial > 0.5:
        return FrameTag(None, lit, partial, ("partial_flash",))
    return FrameTag(None, lit, partial, ("flash_uncertain",))


def _with_remarks(
    profiles: FrameProfiles,
    seen: NDArray[np.int_],
    frames: list[FrameTag],
    drift: Drift,
    config: TaggingConfig,
) -> list[FrameTag]:
    """Tags of all frames, with what is to be said besides the flash."""
    tags = [FrameTag(None, None, 0.0, ("unreadable",))] * len(profiles)
    for k, frame, drifted in zip(seen, frames, drift.affected, strict=True):
        tags[k] = replace(frame, reasons=(*frame.reasons, "drift")) if drifted else frame
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


def _warnings(found: _Found, flicker: Flicker | None, drift: Drift, frames: list[FrameTag]) -> list[str]:
    """Sentences on the whole sequence."""
    out = []
    if not any(frame.flash == 1 for frame in frames):
        out.append(
            "No frame is lit in every row: the pulses are too short for this shutter; make them longer "
            "than exposure, "
            "readout and frame interval together."
        )
    if found.rhythm is None:
        out.append(f"{len(found.windows)} pulses are too few to tell a period.")
    else:
        if found.rhythm.missed:
            times = ", ".join(f"{t:.2f}" for t in _missed_times(found)[:5])
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
    return out + drift.warnings()


def _missed_times(found: _Found) -> list[float]:
    """When the missed pulses were due: between their neighbours, in proportion."""
    rhythm = found.rhythm
    if rhythm is None:
        return []
    known = rhythm.cycle >= 0
    times = np.interp(
        np.array(rhythm.missed, float), rhythm.cycle[known].astype(float), found.labels.on_s[known]
    )
    return [float(t) for t in times]


def _result(
    tags: list[FrameTag],
    seen: NDArray[np.int_],
    found: _Found,
    split: Split,
    flicker: Flicker | None,
    check: PriorCheck | None,
    warnings: list[str],
    interval_s: float,
) -> TagResult:
    labels, shutter, rhythm = found.labels, found.shutter, found.rhythm
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
    known = shutter.readout_sigma_s < _KNOWN_SHARE * interval_s
    return TagResult(
        frames=tuple(tags),
        pulses=tuple(pulses),
        period_s=rhythm.period_s if rhythm is not None else None,
        period_sigma_s=rhythm.period_sigma_s if rhythm is not None else None,
        jitter_s=rhythm.jitter_s if rhythm is not None else None,
        missed_s=tuple(_missed_times(found)),
        readout_s=shutter.readout_s if known else None,
        readout_sigma_s=shutter.readout_sigma_s if known else None,
        exposure_s=shutter.exposure_s if known else None,
        exposure_sigma_s=shutter.exposure_sigma_s if known else None,
        separation=split.separation,
        flicker_hz=flicker.frequency_hz if flicker is not None else None,
        flicker_depth=flicker.depth if flicker is not None else None,
        prior=check,
        warnings=tuple(warnings),
    )
