"""What the frames show: lit and unlit ones, the pulses' edges, and a label for each frame.

The order in which the parts are asked:

1. mains flicker of the room light is found and taken out (`flicker`),
2. frames are split into lit and unlit (`split`); no two classes, no tags,
3. around each pulse the gain over the motion-compensated unlit frames is measured (`windows`, `reference`,
   `bands`),
4. readout and exposure are fitted for the sequence, the edges for each pulse (`shutter_fit`, `edges`),
5. labels follow from the edges and their rhythm, and are checked against the light that was measured
   (`labels`).
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
from capture.tagging.known import Commands, KnownFlash
from capture.tagging.labels import EdgeLabels, label_frames
from capture.tagging.profiles import THUMBNAIL_ROWS, FrameProfiles
from capture.tagging.reference import BANDS, PulseGain, Reference
from capture.tagging.result import FrameTag
from capture.tagging.schedule import Rhythm, fit_rhythm
from capture.tagging.shutter_fit import Shutter, fit_shutter
from capture.tagging.split import BLOCKS, Split, split_frames
from capture.tagging.windows import PulseWindow, edge_range, find_windows

Floats = NDArray[np.float64]

# Light that differs from what the edges say by more than this share of the pulse, beyond twice its noise,
# is not believed: a lamp still rising, or something that is no pulse. Less is droop.
_DIM, _GLOW = 0.07, 0.05
# A blinking flash gives at least this share of the pulses that the longest period allows.
_LEAST_PULSES = 0.4
# The pulses' patterns over the picture agree when their correlation is above the first; chance patterns of
# motion have nothing in common. One pulse that does not fit the others, below the second, is another light.
_AGREEMENT, _LEAST_AGREEMENT = 0.25, 0.1
# Light weaker than this share of a flash that is known from before, in log gain, is not that flash.
_LEAST_KNOWN_GAIN = 0.3
_PATTERN_BLOCKS = 8
# Frames farther apart than this many usual intervals have others missing between them.
_GAP = 1.5
# A frame beside lost ones has a trace of light when its score is above so many spreads.
_TRACE_SPREADS = 2.0
# A flicker with fewer waves over the rows does not measure the readout.
_LEAST_WAVES = 0.7
# Tails of the scores in the confidence of frames far from any pulse: motion's are heavy (Student-t).
_TAIL = 3.0
_LIT_SPREAD = 0.15


@dataclass(frozen=True, eq=False)
class Found:
    """The pulses of the readable frames.

    Attributes:
        windows: of the pulses.
        doubtful: of bright moments that are not the flash.
        data: band gains around the pulses.
        labels: what the edges say of the frames.
        shutter: readout and exposure.
        rhythm: of the pulses; None = too few.
        map: unit vector of the light's pattern over the picture.
    """

    windows: list[PulseWindow]
    doubtful: list[PulseWindow]
    data: BandGains
    labels: EdgeLabels
    shutter: Shutter
    rhythm: Rhythm | None
    map: Floats


@dataclass(frozen=True, eq=False)
class Analysis:
    """What readable frames show.

    Attributes:
        frames: a tag for each, the flash only.
        found: the pulses.
        split: lit and unlit frames.
        flicker: of the room light, None = none seen.
        drift: of exposure and white balance over the unlit frames.
        squares: [K, n, n] mean light of blocks, flicker taken out.
    """

    frames: list[FrameTag]
    found: Found
    split: Split
    flicker: Flicker | None
    drift: Drift
    squares: NDArray[np.float32]


def analyse(
    profiles: FrameProfiles,
    config: TaggingConfig,
    known: KnownFlash | None = None,
    commands: Commands | None = None,
) -> Analysis:
    """Labels frames by their light.

    Args:
        profiles: of readable frames, in order.
        config: limits, and what is known of the camera.
        known: what earlier frames of the same capture have taught; it learns from these.
        commands: when the flash was asked to go on; None = only the pulses' own rhythm is known.

    Raises:
        TaggingError: no flash, a flash that is always on, or too few frames.
    """
    split, flicker, squares = _split(profiles, config, known)
    found = _find_pulses(profiles, split, flicker, config, known, commands)
    frames = _frame_labels(profiles, split, found, config)
    unlit = np.array([frame.flash == 0 for frame in frames])
    drift = measure_drift(profiles.pts_s, squares, profiles.color, unlit)
    if known is not None:
        known.learn_pattern(split.pattern, found.map, split.log_gain)
    return Analysis(frames, found, split, flicker, drift, squares)


def _split(
    profiles: FrameProfiles, config: TaggingConfig, known: KnownFlash | None
) -> tuple[Split, Flicker | None, NDArray[np.float32]]:
    """Lit and unlit frames, with the room's flicker taken out of the unlit part where there is any."""
    square, flicker, rows = steady_squares(profiles, config)
    split = split_frames(profiles.pts_s, square, config, known=None if known is None else known.pattern)
    if known is not None and split.log_gain < _LEAST_KNOWN_GAIN * known.log_gain:
        raise TaggingError(
            f"The brightest frames are {100 * np.expm1(split.log_gain):.1f} % brighter than the others; the "
            f"flash made {100 * np.expm1(known.log_gain):.1f} % before, so this is not the flash."
        )
    if flicker is not None:  # again, from the frames that are unlit, for the rows of the thumbnails
        unlit = ~ndimage.binary_dilation(split.score > 0.25, iterations=2)
        flicker = find_flicker(profiles.pts_s, rows, unlit, THUMBNAIL_ROWS, config) or flicker
    return split, flicker, square


def steady_squares(
    profiles: FrameProfiles, config: TaggingConfig
) -> tuple[NDArray[np.float32], Flicker | None, Floats]:
    """[K, n, n] mean light of blocks without the room's flicker, the flicker, [K, B] log rows."""
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
    return square, flicker, rows


def _find_pulses(
    profiles: FrameProfiles,
    split: Split,
    flicker: Flicker | None,
    config: TaggingConfig,
    known: KnownFlash | None,
    commands: Commands | None,
) -> Found:
    """Pulses, their edges and the shutter."""
    pts_s, interval_s = profiles.pts_s, profiles.interval_s
    candidates = find_windows(pts_s, split, config)
    usable = flicker is not None and flicker.row_gain.shape[1] == THUMBNAIL_ROWS
    reference = Reference(profiles, flicker.row_gain if flicker is not None and usable else None)
    gains = [reference.gain(np.arange(w.begin, w.end), w.before, w.after) for w in candidates]
    maps = np.array([_map(w, g) for w, g in zip(candidates, gains, strict=True)])
    credible = _credible(candidates, maps, float(pts_s[-1] - pts_s[0]), config, known)
    windows = [w for w, good in zip(candidates, credible, strict=True) if good]
    doubtful = [w for w, good in zip(candidates, credible, strict=True) if not good]
    data = band_gains([g for g, good in zip(gains, credible, strict=True) if good], split.pattern, pts_s)
    strong = np.array([not w.weak for w in windows])
    # the brightest frame of each pulse, over the pulses
    gain_prior = np.maximum(np.median(data.gain[strong].max(axis=1), axis=0), 1e-3)
    middle_s = np.array([0.5 * (pts_s[w.first] + pts_s[w.last]) for w in windows])
    coarse = fit_rhythm(middle_s, config)
    cycle = coarse.cycle if coarse is not None else np.full(len(windows), -1)
    learnt = known is not None and known.shutter is not None
    if not learnt and flicker is not None and config.readout_s is None and abs(flicker.waves) > _LEAST_WAVES:
        config = replace(config, readout_s=flicker.readout_s)  # the wave over the rows measures it
    edges = edge_range(pts_s, windows, interval_s, config)
    if known is not None and known.shutter is not None:
        known.fit_again(gain_prior, interval_s, config)
        shutter = known.shutter
    else:
        shutter = fit_shutter(data, edges, cycle, gain_prior, interval_s, config)
        if known is not None:
            shutter = known.first_shutter(shutter, config)
    labels = label_frames(data, edges, shutter, gain_prior, config, commands)
    if known is not None:
        asked_s = np.full(len(windows), np.nan)
        locked = None if commands is None else commands.partners(labels.on_s)
        if commands is not None and locked is not None:
            asked_s = np.where(locked[0] >= 0, commands.times_s[locked[0]], np.nan)
        sure = np.flatnonzero([not w.weak and w.before is not None and w.after is not None for w in windows])
        known.learn_pulses(data.take(sure), edges.take(sure), labels.on_s[sure], asked_s[sure], interval_s)
    rhythm = fit_rhythm(0.5 * (labels.on_s + labels.off_s), config)
    common = maps[np.flatnonzero(credible)][strong].sum(axis=0)
    return Found(windows, doubtful, data, labels, shutter, rhythm, common / (np.linalg.norm(common) + 1e-9))


def _credible(
    windows: list[PulseWindow],
    maps: Floats,
    duration_s: float,
    config: TaggingConfig,
    known: KnownFlash | None,
) -> list[bool]:
    """Which candidates are pulses of one flash; of a flash that is known there may be few, or one.

    Raises:
        TaggingError: they are too few, or have no pattern in common.
    """
    strong = [i for i, w in enumerate(windows) if not w.weak]
    before = None if known is None else known.map
    due = _LEAST_PULSES * duration_s / config.longest_period_s if before is None else 1
    if len(strong) < max(due, 1):
        raise TaggingError(
            f"Only {len(strong)} pulses of light were found in {duration_s:.1f} s; a flash that blinks every "
            f"{config.shortest_period_s:g} to {config.longest_period_s:g} s gives at least "
            f"{int(np.ceil(due))}. Check that "
            "it blinked, and that it is bright enough for the room."
        )
    if len(strong) < 2 and before is None:
        return [not w.weak for w in windows]
    total = maps[strong].sum(axis=0)
    agreement = np.array([float(m @ (total - m * (i in strong))) for i, m in enumerate(maps)])
    agreement /= [np.linalg.norm(total - m * (i in strong)) + 1e-9 for i, m in enumerate(maps)]
    if before is not None:
        agreement = np.maximum(agreement, maps @ before)
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
    profiles: FrameProfiles, split: Split, found: Found, config: TaggingConfig
) -> list[FrameTag]:
    """Tags of the readable frames, flash only."""
    tags = [_far_label(score, split.spread) for score in split.score]
    for window in found.doubtful:
        for k in range(window.begin, window.end):
            if split.score[k] > 4 * split.spread:
                tags[k] = FrameTag(None, None, 0.5, ("flash_uncertain",))
    for k in _beside_gaps(profiles, split, found):
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


def _beside_gaps(profiles: FrameProfiles, split: Split, found: Found) -> NDArray[np.int_]:
    """Frames next to lost ones that may show a trace of a pulse that came while frames were lost.

    Those with a little more light than others; and where a pulse was due and none was found, all of them.
    """
    pts_s = profiles.pts_s
    gap = np.flatnonzero(np.diff(pts_s) > _GAP * profiles.interval_s)
    beside = np.unique(np.concatenate([gap, gap + 1]))
    doubtful = split.score[beside] > _TRACE_SPREADS * split.spread
    length_s = float(np.median(found.labels.off_s - found.labels.on_s))
    for time_s in missed_times(found):
        after = pts_s[beside] - time_s
        doubtful |= (after > -2 * profiles.interval_s) & (after < length_s + 2 * profiles.interval_s)
    return beside[doubtful]


def missed_times(found: Found) -> list[float]:
    """When the missed pulses were due: between their neighbours, in proportion."""
    rhythm = found.rhythm
    if rhythm is None:
        return []
    known = rhythm.cycle >= 0
    times = np.interp(
        np.array(rhythm.missed, float), rhythm.cycle[known].astype(float), found.labels.on_s[known]
    )
    return [float(t) for t in times]


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
