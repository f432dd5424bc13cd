"""Which frames stand out: a two-class split of the log gain over the local no-flash reference.

A flash adds light nearly everywhere at once, for a short time, with the same spatial pattern every time;
camera motion raises some blocks and lowers others, with no pattern that comes back. So the score of a frame
is its block-wise log gain over the unlit frames before and after it, projected on the pattern of the frames
found lit so far (a matched filter), and pattern and classes are found in turn.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from capture.errors import TaggingError
from capture.tagging.config import TaggingConfig

Floats = NDArray[np.float64]

#: Blocks a side. Wide enough that motion between neighbouring frames stays inside a block, small enough
#: to tell the head
#: from the wall behind it.
BLOCKS = 16
# Log gains beyond this are motion of a window or a lamp, not flash shape; e^1.5 = 4.5 times still counts in
# full.
_LARGEST_LOG_GAIN = 1.5
# Rounds of finding pattern and classes, at most; in the first the classes are still unknown to the reference.
_ROUNDS, _BLIND_ROUNDS = 14, 3
# Log gain that quantisation leaves in a block when nothing moves; keeps still blocks from taking all the
# weight.
_LEAST_NOISE = 1e-3
# Of a reference: frames on each side. More would average noise but reach further into the camera's motion.
_SIDE = 3
# A class mean below 2 % gain is under what a phone's own noise reduction and exposure ripple do.
_LEAST_LOG_GAIN = 0.02


@dataclass(frozen=True, eq=False)
class Split:
    """The two classes.

    Attributes:
        score: [K] 0 for a typical unlit frame, 1 for a typical lit one.
        spread: robust standard deviation of the unlit frames' score.
        core: [K] bool, lit for the larger part.
        separation: distance of the class means in units of the unlit spread.
        log_gain: mean log gain of the lit class, weighted by the pattern.
        pattern: [n, n] log gain of the flash.
    """

    score: Floats
    spread: float
    core: NDArray[np.bool_]
    separation: float
    log_gain: float
    pattern: Floats


def split_frames(
    pts_s: Floats,
    blocks: NDArray[np.float32],
    config: TaggingConfig,
    *,
    most_lit: float = 0.4,
    known: Floats | None = None,
) -> Split:
    """Split a sequence into lit and unlit frames.

    Args:
        pts_s: [K] increasing.
        blocks: [K, n, n] mean linear light, positive.
        config: limits.
        most_lit: share of lit frames above which this is no flash.
        known: [n, n] log gain of the flash, from before; None = looked for without.

    Raises:
        TaggingError: fewer than 8 frames, or no two classes.
    """
    count, side = blocks.shape[0], blocks.shape[1]
    if count < 8:
        raise TaggingError(
            f"{count} frames are too few to tell lit from unlit ones; at least 8 with both kinds are needed."
        )
    log = np.log(blocks.astype(np.float64)).reshape(count, -1)
    gain = np.clip(symmetric_gain(pts_s, log, config), -_LARGEST_LOG_GAIN, _LARGEST_LOG_GAIN)
    noise = _spread(gain) + _LEAST_NOISE
    # Before the pattern is known: how many blocks rise together, each counted in its own noise and at most
    # twice.
    score = np.clip(gain / noise, -2, 2).mean(axis=1)
    core = _brief(pts_s, score > otsu_threshold(score), config)
    if known is not None:
        weight = known.ravel() / noise**2
        core = _brief(pts_s, gain @ weight > 0.5 * float(known.ravel() @ weight), config)
    pattern = np.zeros(log.shape[1])
    for turn in range(_ROUNDS):
        if not core.any():
            break
        unlit = ~ndimage.binary_dilation(core, iterations=1)
        if not unlit.any():
            break
        if turn >= _BLIND_ROUNDS:  # the classes are good enough to look only at unlit frames, and nearer ones
            gain = np.clip(local_gain(pts_s, log, unlit), -_LARGEST_LOG_GAIN, _LARGEST_LOG_GAIN)
            noise = _spread(gain[unlit]) + _LEAST_NOISE
        # Smoothing leaves the pattern few degrees of freedom, so that chance cannot carve one out of noise.
        rough = np.median(gain[core], axis=0) - np.median(gain[unlit], axis=0)
        pattern = np.maximum(ndimage.gaussian_filter(rough.reshape(side, side), side / 10), 0).ravel()
        weight = pattern / noise**2
        if not weight.any():
            break
        score = gain @ weight / (pattern @ weight)
        score = score - np.median(score[unlit])
        before, core = core, _brief(pts_s, score > 0.5 * np.median(score[core]), config)
        if turn > _BLIND_ROUNDS and np.array_equal(before, core):
            break
    return _checked(score, core, pattern, noise, side, config, most_lit)


def _checked(
    score: Floats,
    core: NDArray[np.bool_],
    pattern: Floats,
    noise: Floats,
    side: int,
    config: TaggingConfig,
    most_lit: float,
) -> Split:
    """The split with its score normalised, or the refusal."""
    weight = pattern / noise**2
    away = ~ndimage.binary_dilation(core, iterations=2)
    if core.any() and away.sum() >= 4 and weight.any():
        middle = float(np.median(score[away]))
        scatter = np.abs(score[away] - middle)
        # the larger of the bulk's and the tail's spread: motion has heavy tails (2.17 = normal quantile of
        # 98.5 %)
        spread = max(1.4826 * float(np.median(scatter)), float(np.quantile(scatter, 0.97)) / 2.17, 1e-4)
        lit = float(np.median(score[core]))
        separation = (lit - middle) / spread
        log_gain = (lit - middle) * float(pattern @ weight / weight.sum())
    else:
        middle, spread, lit, separation, log_gain = 0.0, 1.0, 1.0, 0.0, 0.0
    share = float(core.mean())
    if separation < config.min_separation or log_gain < _LEAST_LOG_GAIN:
        raise TaggingError(
            f"The frames do not fall into lit and unlit ones (separation {separation:.1f}, at least "
            f"{config.min_separation:g} needed; gain {100 * np.expm1(log_gain):.1f} %): the flash was "
            "always off or always "
            "on, or it is too weak for the room; check it, darken the room or come closer, and record again."
        )
    if share > most_lit:
        raise TaggingError(
            f"{100 * share:.0f} % of the frames look lit, more than the {100 * most_lit:.0f} % of any "
            "blinking flash; "
            "this is a change of the room light, not a flash."
        )
    scale = lit - middle
    return Split(
        score=(score - middle) / scale,
        spread=spread / scale,
        core=core,
        separation=separation,
        log_gain=log_gain,
        pattern=pattern.reshape(side, side),
    )


def _brief(pts_s: Floats, lit: NDArray[np.bool_], config: TaggingConfig) -> NDArray[np.bool_]:
    """Without the runs that are longer than any pulse: those are changes of the scene."""
    runs, count = ndimage.label(lit)
    kept = np.zeros_like(lit)
    for run in range(1, count + 1):
        index = np.flatnonzero(runs == run)
        if pts_s[index[-1]] - pts_s[index[0]] <= config.longest_on_s:
            kept[index] = True
    return kept


def otsu_threshold(values: Floats) -> float:
    """The threshold that maximises the variance between two classes (Otsu 1979), over the sorted values
    themselves."""
    ordered = np.sort(values)
    n = len(ordered)
    below = np.cumsum(ordered)[:-1]
    size = np.arange(1, n)
    between = size * (n - size) * (below / size - (ordered.sum() - below) / (n - size)) ** 2
    best = int(np.argmax(between))
    return float(0.5 * (ordered[best] + ordered[best + 1]))


def _spread(values: Floats) -> Floats:
    """Robust standard deviation over the first axis (1.4826 = normal quantile of 75 %)."""
    return 1.4826 * np.median(np.abs(values - np.median(values, axis=0)), axis=0)


def symmetric_gain(pts_s: Floats, log: Floats, config: TaggingConfig) -> Floats:
    """[K, N] log gain over the median of symmetric pairs of neighbours: a steady trend cancels, classes
    unknown yet."""
    count = len(pts_s)
    interval = float(np.median(np.diff(pts_s)))
    nearest = max(1, round(0.1 / interval))
    farthest = max(nearest, min(round(config.longest_on_s / interval), (count - 1) // 2))
    offsets = np.unique(np.linspace(nearest, farthest, min(8, farthest - nearest + 1)).round().astype(int))
    k = np.arange(count)
    pairs = []
    for m in offsets:
        before, after = k - m, k + m
        # at the ends both partners lie on the side that exists
        before, after = np.where(before < 0, after, before), np.where(after >= count, before, after)
        pairs.append(0.5 * (log[before] + log[after]))
    return log - np.median(pairs, axis=0)


def local_gain(pts_s: Floats, log: Floats, unlit: NDArray[np.bool_]) -> Floats:
    """[K, N] log gain over a straight line in time through the nearest unlit frames on both sides.

    At an end, where a line would extrapolate, over the mean of the two nearest on the other side.
    """
    index, k = np.flatnonzero(unlit), np.arange(len(pts_s))
    # An unlit frame leaves itself and its neighbours out, as a lit frame has none: their spreads compare.
    first_after = np.searchsorted(index, k + 2)
    last_before = np.searchsorted(index, k - 2, side="right") - 1
    reach = np.arange(_SIDE)
    place = np.concatenate(
        [last_before[:, None] - reach, first_after[:, None] + reach], axis=1
    )  # [K, 2 SIDE]
    there: NDArray[np.bool_] = np.asarray((place >= 0) & (place < len(index)))
    alone: NDArray[np.bool_] = np.asarray(~(there[:, :_SIDE].any(axis=1) & there[:, _SIDE:].any(axis=1)))
    there[alone[:, None] & (np.tile(reach, 2) >= 2)] = False
    near = index[np.clip(place, 0, len(index) - 1)]
    count = np.maximum(there.sum(axis=1, keepdims=True), 1)
    t = np.where(there, pts_s[near], 0.0)
    middle = t.sum(axis=1, keepdims=True) / count
    t = np.where(there, t - middle, 0.0)
    slope = (pts_s[:, None] - middle) * t / np.maximum((t**2).sum(axis=1, keepdims=True), 1e-12)
    weight = np.where(there, 1 / count + np.where(alone[:, None], 0.0, slope), 0.0)
    return log - np.einsum("km,kmn->kn", weight, log[near])
