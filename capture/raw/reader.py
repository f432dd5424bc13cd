"""A RAW file as linear radiance.

In order: LibRaw unpacks (and applies a DNG's LinearizationTable); black is subtracted and white made 1.0;
samples at the clip are noted; OpcodeList2; white balance, if one is asked for; demosaicing; OpcodeList3. No
colour matrix, no automatic brightness, no reconstruction of highlights, no rotation, no cropping beyond the
light-sensitive area.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture.errors import ImageError
from capture.raw import facts as said
from capture.raw.facts import RawFacts
from capture.raw.levels import (
    Levels,
    active_area,
    check_whole,
    clipped_samples,
    dng_levels,
    is_lossy,
    libraw_levels,
    raw_directory,
)
from capture.raw.libraw import binned, demosaic, touched_by, unpacked
from capture.raw.opcodes import OpcodeList, parse_opcodes
from capture.raw.tiff import Directory, read_directories

_OPCODE_LISTS = (51008, 51009, 51022)  # as read, after linearisation, after demosaicing
_LARGEST_PIXELS = 1 << 28  # as `capture.images`: what a damaged header may make us allocate
_LETTERS = "RGB"

Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class RawPicture:
    """A developed RAW picture.

    Attributes:
        radiance: [H, W, 3] linear, the camera's own R, G, B times the white balance that was asked for;
            without one and before any gain map 1.0 is the white clip. Noise below black is negative.
        clipped: [H, W] where a sample at the white clip has gone into the pixel: it is no measurement.
        facts: what the file says.
    """

    radiance: Floats
    clipped: NDArray[np.bool_]
    facts: RawFacts


@dataclass(frozen=True, eq=False)
class RawFile:
    """An unpacked RAW file, between the sensor's numbers and a picture.

    Attributes:
        path: the file.
        samples: [H, W] under a mosaic, or [H, W, 3]: radiance with OpcodeList2 applied.
        at_clip: which of them are at the white clip, of the same shape.
        cell: [n, n] colour indices of the top left samples, 0 red, 1 green, 2 blue; [1, 1] for a sensor
            without colours.
        corner: row and column of the first sample in the file's picture.
        after: OpcodeList3.
        facts: what the file says.
    """

    path: Path
    samples: Floats
    at_clip: NDArray[np.bool_]
    cell: NDArray[np.uint8]
    corner: tuple[int, int]
    after: OpcodeList
    facts: RawFacts

    @classmethod
    def open(cls, path: Path) -> RawFile:
        """Unpacks a file.

        Raises:
            ImageError: missing, damaged or of a kind that LibRaw or this module does not read.
        """
        path = Path(path)
        try:
            data = path.read_bytes()
        except OSError as cause:
            raise ImageError(f"{path} cannot be read: {cause.strerror or cause}.") from cause
        try:
            directories = read_directories(data)
            directory = raw_directory(directories)
            if directory is not None:
                check_whole(directory)
            lists = [_opcodes(directory, tag) for tag in _OPCODE_LISTS]
            with unpacked(path) as raw:
                return _linear(path, raw, directories, directory, lists)
        except ImageError as cause:
            raise ImageError(f"{path} cannot be read as RAW: {cause}; copy or export it again.") from cause

    def develop(self, white_balance: Sequence[float] = (1.0, 1.0, 1.0)) -> RawPicture:
        """The picture in full size.

        Args:
            white_balance: multipliers of R, G, B, at least 1 each; the same for all pictures to be compared.

        Raises:
            ImageError: LibRaw cannot interpolate it.
        """
        balance = np.asarray(white_balance, np.float32)
        if balance.shape != (3,) or not (np.isfinite(balance) & (balance >= 1)).all():
            raise ValueError(f"white_balance is {white_balance}, not three multipliers of at least 1")
        samples = _balanced(self.samples, self.cell, balance)
        if samples.ndim == 3:
            radiance, clipped = samples, np.asarray(self.at_clip.any(axis=2))
        elif self.cell.size == 1:
            radiance, clipped = np.repeat(samples[..., None], 3, axis=2), self.at_clip
        else:
            try:
                radiance, missing = demosaic(self.path, samples, self.cell, self.corner)
            except ImageError as cause:
                raise ImageError(f"{self.path} cannot be developed: {cause}.") from cause
            clipped = touched_by(self.at_clip, self.cell) | missing
        self.after.apply(radiance)
        return RawPicture(radiance, clipped, self.facts)

    def small(self, white_balance: Sequence[float] = (1.0, 1.0, 1.0)) -> Floats:
        """[h, w, 3] one pixel a cell of the mosaic, quickly and for looking only."""
        samples = _balanced(self.samples, self.cell, np.asarray(white_balance, np.float32))
        if samples.ndim == 3:
            radiance = samples
        elif self.cell.size == 1:
            radiance = np.repeat(samples[..., None], 3, axis=2)
        else:
            radiance = binned(samples, self.cell)
        if self.after.steps:
            gain = np.ones((*self.samples.shape[:2], 3), np.float32)
            self.after.apply(gain)
            n = 1 if samples.ndim == 3 else len(self.cell)
            radiance *= gain[n // 2 :: n, n // 2 :: n][: radiance.shape[0], : radiance.shape[1]]
        return radiance


def read_raw(path: Path, white_balance: Sequence[float] = (1.0, 1.0, 1.0)) -> RawPicture:
    """Reads and develops a RAW file; see `RawFile` for both steps.

    Raises:
        ImageError: missing, damaged or of a kind that is not read here.
    """
    return RawFile.open(path).develop(white_balance)


def _linear(
    path: Path,
    raw: Any,
    directories: Sequence[Directory],
    directory: Directory | None,
    lists: Sequence[OpcodeList],
) -> RawFile:
    sizes = raw.sizes
    if sizes.raw_width * sizes.raw_height > _LARGEST_PIXELS:
        raise ImageError(f"it claims {sizes.raw_width} x {sizes.raw_height} samples")
    if raw.num_colors not in (1, 3):
        raise ImageError(f"its sensor has {raw.num_colors} colours, not red, green and blue")
    whole = raw.raw_image
    top, left, bottom, right = (
        (
            sizes.top_margin,
            sizes.left_margin,
            sizes.top_margin + sizes.height,
            sizes.left_margin + sizes.width,
        )
        if directory is None
        else active_area(directory, whole.shape)
    )
    stored = whole[top:bottom, left:right]
    if min(stored.shape[:2]) < 16:
        raise ImageError(f"it has {stored.shape[1]} x {stored.shape[0]} samples, less than any sensor")
    if stored.ndim == 3:
        if raw.num_colors != 3:
            raise ImageError(f"its samples have {raw.num_colors} colours, not red, green and blue")
        stored = stored[..., :3]
    under_mosaic = stored.ndim == 2 and raw.num_colors == 3
    places = _places(raw, top, left) if under_mosaic else np.zeros((1, 1), np.uint8)
    cell = _colours(places, raw.color_desc)
    levels = dng_levels(directory, stored.shape) if directory is not None else None
    levels = levels or libraw_levels(raw, places, stored.shape)
    samples = levels.linear(stored)
    at_clip = clipped_samples(stored, samples, levels)
    lists[1].apply(samples)
    facts = _facts(raw, directories, stored.shape, cell, levels, lists)
    return RawFile(path, samples, at_clip, cell, (top, left), lists[2], facts)


def _facts(
    raw: Any,
    directories: Sequence[Directory],
    shape: tuple[int, ...],
    cell: NDArray[np.uint8],
    levels: Levels,
    lists: Sequence[OpcodeList],
) -> RawFacts:
    other = raw.other
    missed = [name for opcodes in lists for name in opcodes.missed]
    missed += [type(step).__name__ for step in lists[0].steps]
    warnings = (f"The RAW files ask for {', '.join(dict.fromkeys(missed))}, which is not carried out.",)
    return RawFacts(
        camera=said.camera_name(directories),
        width=shape[1],
        height=shape[0],
        rotation_deg=said.rotation_deg(raw.sizes.flip),
        taken=said.time_taken(directories, other.timestamp),
        exposure_s=said.positive(other.shutter_speed),
        iso=said.positive(other.iso_speed),
        aperture=said.positive(other.aperture),
        focal_length_mm=said.positive(other.focal_length),
        white_balance=said.balanced(raw.camera_whitebalance) or said.balanced(raw.daylight_whitebalance),
        cfa="".join(_LETTERS[colour] for colour in cell.ravel()) if len(shape) == 2 and cell.size > 1 else "",
        black=tuple(levels.black.ravel().tolist()),
        white=tuple(levels.white.tolist()),
        camera_from_xyz=said.camera_from_xyz(directories, raw.rgb_xyz_matrix),
        largest_gain=lists[1].largest_gain * lists[2].largest_gain,
        applied=tuple(type(step).__name__ for opcodes in lists[1:] for step in opcodes.steps),
        left_out=tuple(name for opcodes in lists for name in opcodes.left_out),
        warnings=warnings if missed else (),
    )


def _opcodes(directory: Directory | None, tag: int) -> OpcodeList:
    if directory is None or tag not in directory:
        return OpcodeList()
    return parse_opcodes(directory.value(tag), done=("MapPolynomial",) if is_lossy(directory) else ())


def _places(raw: Any, top: int, left: int) -> NDArray[np.uint8]:
    """[n, n] LibRaw's colour indices of a mosaic's top left samples."""
    if raw.raw_pattern is None or (n := len(raw.raw_pattern)) < 2:
        raise ImageError("its mosaic is not described")
    return np.array([[raw.raw_color(top + y, left + x) for x in range(n)] for y in range(n)], np.uint8)


def _colours(places: NDArray[np.uint8], description: bytes) -> NDArray[np.uint8]:
    """Colour indices 0..2 of LibRaw's 0..3, of which two may be green."""
    if places.size == 1:
        return places
    letters = description.decode("ascii", "replace")[:4]
    if not set(letters) <= set(_LETTERS) or int(places.max()) >= len(letters):
        raise ImageError(f"its mosaic has the colours {letters!r}, not red, green and blue")
    cell = np.array([[_LETTERS.index(letters[place]) for place in row] for row in places], np.uint8)
    if set(cell.ravel().tolist()) != {0, 1, 2}:
        raise ImageError("its mosaic lacks a colour")
    return cell


def _balanced(samples: Floats, cell: NDArray[np.uint8], balance: Floats) -> Floats:
    """A copy of the samples times the multiplier of their colour."""
    if samples.ndim == 3:
        return samples * balance
    balanced = samples.copy()
    if cell.size > 1:
        for row, column in np.ndindex(*cell.shape):
            balanced[row :: len(cell), column :: len(cell)] *= balance[cell[row, column]]
    return balanced
