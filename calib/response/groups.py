"""What an exposure sweep says of each small part of the picture: its median stored value in every frame.

A median goes through any rising curve unchanged: median(f(x)) = f(median(x)), clipping included while less
than half is clipped. So the median of a group of pixels obeys the same response as a pixel, whatever the
group shows, and has a small part of its noise; a mean would be bent by the curve.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.errors import ResponseError

Floats = NDArray[np.float64]

_GROUPS = 900  # about so many in a picture, of which half are used
_STRATA = 8  # of brightness
_MOST_PIXELS = 400  # of a group; more do not help against what is no noise
_LEAST_SIDE_PX = 6


@dataclass(frozen=True, eq=False)
class SweepFrame:
    """A picture of a sweep.

    Attributes:
        name: for people.
        exposure_s: the time that it claims, seconds; only ratios count.
        image: [H, W, 3] RGB or [H, W], uint8 or uint16, as stored.
    """

    name: str
    exposure_s: float
    image: NDArray[Any]


@dataclass(frozen=True, eq=False)
class SweepGroups:
    """The groups' medians in every frame: K frames, G groups, three channels.

    Attributes:
        names: [K] of the frames.
        exposures_s: [K].
        size: (width, height) of the pictures, pixels.
        step: of stored values: 1/255 or 1/65535.
        median: [K, G, 3] stored value 0..1.
        sigma: [K, G, 3] standard deviation that noise and rounding should leave in `median`; an upper bound
            where the group is textured.
        clipped: [K, G] share of pixels in which some channel is at the largest value of the sweep.
        grey: whether the pictures have one channel, repeated here.
    """

    names: tuple[str, ...]
    exposures_s: Floats
    size: tuple[int, int]
    step: float
    median: Floats
    sigma: Floats
    clipped: Floats
    grey: bool


def gather_groups(frames: Iterable[SweepFrame]) -> SweepGroups:
    """The groups of a sweep, one frame at a time.

    Raises:
        ResponseError: pictures of different sizes or kinds, exposure times that are none, or no frame.
    """
    names: list[str] = []
    exposures: list[float] = []
    medians, spreads, sigmas, clips = [], [], [], []
    first: NDArray[Any] | None = None
    kept: list[NDArray[Any]] = []
    top = 0
    for frame in frames:
        image = frame.image
        if image.dtype not in (np.uint8, np.uint16):
            raise ResponseError(
                f"{frame.name} holds {image.dtype} pixels, which are linear already; a response is found "
                "from pictures of 8 or 16 bits as the camera stores them."
            )
        if first is None:
            first = image
        if image.shape != first.shape or image.dtype != first.dtype:
            raise ResponseError(
                f"{frame.name} is {_kind(image)}, the pictures before it are {_kind(first)}; a sweep is of "
                "one size and format."
            )
        if not (np.isfinite(frame.exposure_s) and frame.exposure_s > 0):
            raise ResponseError(
                f"{frame.name} claims an exposure of {frame.exposure_s:g} s; it must be positive."
            )
        names.append(frame.name)
        exposures.append(float(frame.exposure_s))
        blocks = _blocks(image)
        kept.append(blocks)
        top = max(top, int(blocks.max()))
    if first is None:
        raise ResponseError("There are no pictures; give those of an exposure sweep.")
    white = np.iinfo(first.dtype).max
    # A camera may stop short of the largest code (235, 250): a largest value that many share is its clip.
    if top < white and not any((blocks >= top).mean() > 0.001 for blocks in kept):
        top = white
    for blocks in kept:
        clips.append((blocks >= top).any(axis=-1).mean(axis=1))
        middle, spread = grouped_median(blocks)
        medians.append(middle / white)
        spreads.append(spread)
        sigmas.append(_median_sigma(spread, blocks.shape[1]) / white)
    even = _evenest(np.stack(spreads), np.stack(medians))
    return SweepGroups(
        tuple(names),
        np.array(exposures),
        (first.shape[1], first.shape[0]),
        1.0 / white,
        np.stack(medians)[:, even],
        np.stack(sigmas)[:, even],
        np.stack(clips)[:, even],
        first.ndim == 2,
    )


def grouped_median(blocks: NDArray[Any]) -> tuple[Floats, Floats]:
    """Median and spread of whole numbers that were rounded from finer ones, per group and channel.

    Args:
        blocks: [G, n, C] codes.

    Returns:
        [G, C] median, interpolated within its code by the share of pixels below it; and [G, C] robust
        standard deviation, both in codes.
    """
    count = blocks.shape[1]
    middle = np.partition(blocks, count // 2, axis=1)[:, count // 2]
    below = (blocks < middle[:, None]).mean(axis=1)
    at = (blocks == middle[:, None]).mean(axis=1)
    median = middle - 0.5 + (0.5 - below) / at
    low, high = np.quantile(blocks, (0.1587, 0.8413), axis=1)
    # Within one code the quantiles do not tell; the share at the code does: its width is 1.
    narrow = at > 0.6
    spread = np.where(
        narrow, 0.35 * np.sqrt(1.0 - at) + 0.2 * (1.0 - at), np.maximum(0.5 * (high - low), 0.3)
    )
    return median.astype(np.float64), spread


def choose_frames(groups: SweepGroups, kept: Sequence[int]) -> SweepGroups:
    """The same with some of its frames."""
    index = np.asarray(kept, dtype=int)
    return SweepGroups(
        tuple(groups.names[k] for k in index),
        groups.exposures_s[index],
        groups.size,
        groups.step,
        groups.median[index],
        groups.sigma[index],
        groups.clipped[index],
        groups.grey,
    )


def _evenest(spread: Floats, median: Floats) -> NDArray[np.int64]:
    """The less textured half of the groups, of each brightness.

    Where two surfaces meet in a group, few pixels lie at the median and noise moves it far.

    Args:
        spread: [K, G, C] of the groups, in any unit.
        median: [K, G, C] stored values.
    """
    level = np.log(np.maximum(median, 1e-4))
    texture = np.log(np.maximum(spread, 0.05))
    edges = np.quantile(level, np.linspace(0.0, 1.0, _STRATA + 1))
    usual = np.array(
        [np.median(texture[(level >= low) & (level <= high)]) for low, high in itertools.pairwise(edges)]
    )
    beyond = texture - np.interp(level, 0.5 * (edges[:-1] + edges[1:]), usual)
    score = beyond.mean(axis=(0, 2))
    order = np.argsort(level.mean(axis=(0, 2)))
    kept = [part[np.argsort(score[part])[: -(-len(part) // 2)]] for part in np.array_split(order, _STRATA)]
    return np.sort(np.concatenate(kept))


def _median_sigma(spread: Floats, count: int) -> Floats:
    """Standard deviation of a grouped median of `count` codes, in codes.

    Noise (the asymptotic 1.2533 sigma / sqrt(n)), and what rounding leaves: 1/12 without noise, which dies
    away as exp(-4 pi^2 sigma^2) when noise dithers the steps (Widrow and Kollár 2008, chapter 5).
    """
    noise = 1.2533**2 * (spread**2 + 1.0 / 12.0) / count
    rounding = np.exp(-4.0 * np.pi**2 * spread**2) / 12.0
    return np.asarray(np.sqrt(noise + rounding))


def _blocks(image: NDArray[Any]) -> NDArray[Any]:
    """[G, n, 3] pixels of square groups that tile the picture."""
    height, width = image.shape[:2]
    side = max(_LEAST_SIDE_PX, int(np.sqrt(height * width / _GROUPS)))
    rows, columns = height // side, width // side
    if rows * columns < 12:
        raise ResponseError(f"The pictures are {_kind(image)}; at least 32 x 32 pixels are needed.")
    planes = image[: rows * side, : columns * side].reshape(rows, side, columns, side, -1)
    blocks = planes.transpose(0, 2, 1, 3, 4).reshape(rows * columns, side * side, -1)
    blocks = blocks[:, :: max(1, blocks.shape[1] // _MOST_PIXELS)]
    return np.repeat(blocks, 3, axis=2) if blocks.shape[2] == 1 else blocks[:, :, :3]


def _kind(image: NDArray[Any]) -> str:
    return f"{image.shape[1]} x {image.shape[0]} pixels of {image.dtype}"
