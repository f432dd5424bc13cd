"""Black and white: which numbers of a sensor are no light, and which are all that it can tell.

A DNG says it (DNG 1.7.1, BlackLevel, BlackLevelDeltaH, BlackLevelDeltaV, WhiteLevel), in fractions and by
place in the mosaic, where LibRaw rounds; of other files LibRaw's own list of cameras is taken.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture.errors import ImageError
from capture.raw.tiff import Directory

DNG_VERSION = 50706
SUBFILE_TYPE, IMAGE_WIDTH, IMAGE_HEIGHT, PHOTOMETRIC = 254, 256, 257, 262
_SAMPLE_FORMAT, _ACTIVE_AREA = 339, 50829
_BLACK_REPEAT, _BLACK, _BLACK_DELTA_H, _BLACK_DELTA_V, _WHITE = 50713, 50714, 50715, 50716, 50717
_STRIPS, _TILES = (273, 279), (324, 325)
_CFA, _LINEAR_RAW = 32803, 34892
_FLOAT_SAMPLES = 3
_COMPRESSION, _LOSSY_JPEG = 259, 34892
_LARGEST_REPEAT = 64

#: Share of the way from black to white from which a sample is clipped: sensors reach full well with some
#: noise and spread, and the last percent tells nothing for sure.
CLIPPED_SHARE = 0.99
# Without a stated white level: this many samples at the largest value, and more than these times as many as
# at the values just below, are a clip that lies under LibRaw's white.
_LEAST_PILE, _PILE_OVER_NEXT = 32, 8


@dataclass(frozen=True, eq=False)
class Levels:
    """Levels of a sensor.

    Attributes:
        black: [V, H, S] repeated over the picture from its top left sample; S = 1 for a mosaic.
        rows: [H] added to it by rows.
        columns: [W] added to it by columns.
        white: [S] or, without the tag, [1].
        stated: whether the file states them itself.
    """

    black: NDArray[np.float32]
    rows: NDArray[np.float32]
    columns: NDArray[np.float32]
    white: NDArray[np.float32]
    stated: bool

    def linear(self, stored: NDArray[np.uint16]) -> NDArray[np.float32]:
        """Radiance of samples, [H, W] or [H, W, S]: 0 = black, 1.0 = white; noise below black stays negative.

        As the specification has it: the range is from the largest black of a plane to its white.
        """
        stack = stored[..., None] if stored.ndim == 2 else stored
        values = stack.astype(np.float32)
        down, across, _ = self.black.shape
        for row, column in np.ndindex(down, across):
            values[row::down, column::across] -= self.black[row, column]
        if self.rows.any():
            values -= self.rows[:, None, None]
        if self.columns.any():
            values -= self.columns[None, :, None]
        values *= np.float32(1.0) / self._range()
        return values[..., 0] if stored.ndim == 2 else values

    def _range(self) -> NDArray[np.float32]:
        largest = self.black.max(axis=(0, 1))
        for deltas in (self.rows, self.columns):
            largest = largest + (deltas.max() if deltas.size else np.float32(0.0))
        return np.asarray(self.white - largest, np.float32)


def raw_directory(directories: Sequence[Directory]) -> Directory | None:
    """The directory of a DNG's full picture; None for no DNG.

    Raises:
        ImageError: a DNG without one.
    """
    if not any(DNG_VERSION in directory for directory in directories):
        return None
    raws = [
        directory
        for directory in directories
        if directory.number(PHOTOMETRIC, -1) in (_CFA, _LINEAR_RAW) and directory.number(SUBFILE_TYPE, 0) == 0
    ]
    if not raws:
        raise ImageError("the DNG has no picture from a sensor")
    return max(raws, key=lambda d: d.number(IMAGE_WIDTH, 0) * d.number(IMAGE_HEIGHT, 0))


def check_whole(raw: Directory) -> None:
    """Refuses a DNG whose strips or tiles reach beyond the file; LibRaw would fill in black.

    Raises:
        ImageError: cut short.
    """
    for offsets, sizes in (_STRIPS, _TILES):
        if offsets not in raw or sizes not in raw:
            continue
        ends = np.add(*(np.array(raw.numbers(tag), np.int64) for tag in (offsets, sizes)))
        if len(ends) and ends.max() > len(raw.data):
            raise ImageError(f"its picture should reach to byte {ends.max()}, the file has {len(raw.data)}")


def active_area(raw: Directory, shape: tuple[int, ...]) -> tuple[int, int, int, int]:
    """Top, left, bottom, right of the light-sensitive samples.

    Raises:
        ImageError: an area that is not within the picture.
    """
    if _ACTIVE_AREA not in raw:
        return 0, 0, shape[0], shape[1]
    area = tuple(int(number) for number in raw.numbers(_ACTIVE_AREA)[:4])
    if len(area) != 4 or not (0 <= area[0] < area[2] <= shape[0] and 0 <= area[1] < area[3] <= shape[1]):
        raise ImageError(f"its ActiveArea {list(area)} is not within {shape[1]} x {shape[0]} samples")
    return area


def dng_levels(raw: Directory, shape: tuple[int, ...]) -> Levels | None:
    """Levels that a DNG states for a picture [H, W] or [H, W, S]; None for floating-point or lossy samples.

    Those LibRaw brings to 16 bits by itself, and then knows the levels.

    Raises:
        ImageError: levels that cannot be.
    """
    if raw.number(_SAMPLE_FORMAT, 1) == _FLOAT_SAMPLES or is_lossy(raw) or _WHITE not in raw:
        return None
    samples = shape[2] if len(shape) == 3 else 1
    repeat = [int(n) for n in raw.numbers(_BLACK_REPEAT)[:2]] if _BLACK_REPEAT in raw else [1, 1]
    if len(repeat) != 2 or not all(1 <= n <= _LARGEST_REPEAT for n in repeat):
        raise ImageError(f"its BlackLevelRepeatDim is {repeat}, not two numbers of 1..{_LARGEST_REPEAT}")
    black = np.array(raw.numbers(_BLACK) if _BLACK in raw else [0.0], np.float32)
    if black.size not in (1, repeat[0] * repeat[1], repeat[0] * repeat[1] * samples):
        raise ImageError(f"its BlackLevel has {black.size} values for a pattern of {repeat}")
    places = repeat if black.size > 1 else [1, 1]
    black = np.broadcast_to(black.reshape(*places, -1), (*places, samples)).copy()
    white = np.array(raw.numbers(_WHITE), np.float32)
    white = white[:samples] if white.size >= samples else white[:1]
    rows, columns = _deltas(raw, _BLACK_DELTA_V, shape[0]), _deltas(raw, _BLACK_DELTA_H, shape[1])
    levels = Levels(black, rows, columns, white, stated=True)
    _check(levels)
    return levels


def is_lossy(raw: Directory) -> bool:
    """Whether a DNG's samples are JPEGs of 8 bits under a curve, its MapPolynomial, which LibRaw undoes."""
    return raw.number(_COMPRESSION, 1) == _LOSSY_JPEG


def libraw_levels(raw: Any, cell: NDArray[np.uint8], shape: tuple[int, ...]) -> Levels:
    """Levels that LibRaw has for an unpacked file.

    Args:
        raw: the rawpy object.
        cell: [n, n] LibRaw's own colour indices 0..3 of the picture's top left samples.
        shape: of the picture, [H, W] or [H, W, S].

    Raises:
        ImageError: levels that cannot be.
    """
    by_colour = np.array(raw.black_level_per_channel, np.float32)
    black = by_colour[cell][..., None] if len(shape) == 2 else by_colour[None, None, : shape[2]]
    white = np.array([raw.white_level], np.float32)
    none = np.zeros(0, np.float32)
    levels = Levels(black, none, none, white, stated=False)
    _check(levels)
    return levels


def clipped_samples(
    stored: NDArray[np.uint16], linear: NDArray[np.float32], levels: Levels
) -> NDArray[np.bool_]:
    """Which samples are at the white clip, [H, W] or [H, W, S].

    Where the file states no white level, a pile of samples at the largest value counts too.
    """
    clipped = linear >= CLIPPED_SHARE
    if not levels.stated and (top := _pile(stored, linear)) is not None:
        clipped |= stored >= top
    return clipped


def _pile(stored: NDArray[np.uint16], linear: NDArray[np.float32]) -> int | None:
    """The largest value, where so many samples have it that it is a clip; None where they do not."""
    top = int(stored.max())
    if float(linear.max()) < 0.5:
        return None
    counts = np.bincount(stored.ravel(), minlength=top + 1)
    below = int(counts[max(top - 4, 0) : top].max(initial=0))
    return top if counts[top] >= _LEAST_PILE and counts[top] > _PILE_OVER_NEXT * below else None


def _deltas(raw: Directory, tag: int, count: int) -> NDArray[np.float32]:
    if tag not in raw:
        return np.zeros(0, np.float32)
    deltas = np.array(raw.numbers(tag), np.float32)
    if deltas.size != count:
        raise ImageError(f"its TIFF tag {tag} has {deltas.size} values for {count} rows or columns")
    return deltas


def _check(levels: Levels) -> None:
    numbers = [levels.black, levels.rows, levels.columns, levels.white]
    if not levels.white.size:
        raise ImageError("its white level is empty")
    if not all(np.isfinite(values).all() for values in numbers) or not (levels._range() > 0).all():
        raise ImageError(
            f"its white level ({', '.join(f'{w:g}' for w in levels.white)}) is not above its black level "
            f"({float(levels.black.max()):g})"
        )
