"""What a RAW file says of its camera and of the exposure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import numpy as np

from capture.errors import ImageError
from capture.raw.tiff import Directory

# LibRaw's orientation, sizes.flip -> clockwise turn that shows the picture upright.
_ROTATION_DEG = {0: 0, 3: 180, 5: 270, 6: 90}
# Exif 2.32 and TIFF/EP tags.
_MAKE, _MODEL, _DATE, _SUB_SECOND, _CAMERA_NAME = 271, 272, 36867, 37521, 50708
_COLOR_MATRICES = (50722, 50721)  # the second is of the illuminant nearer to daylight, as a rule
_LEAST_YEAR = 1980  # cameras whose clock was never set count from 1970


@dataclass(frozen=True)
class RawFacts:
    """What is known of a RAW picture.

    Attributes:
        camera: maker and model; empty = not known.
        width: of the picture, pixels, sensor orientation.
        height: pixels.
        rotation_deg: clockwise turn that shows it upright.
        taken: local time of the camera's clock; None = not known.
        exposure_s: exposure time, seconds; None = not known, as for the next three.
        iso: sensitivity.
        aperture: f-number.
        focal_length_mm: of the lens, not of an equivalent.
        white_balance: as-shot multipliers of R, G, B, the least 1; None = not known.
        cfa: letters of the mosaic's top left cell by rows, as "RGGB"; empty = no mosaic.
        black: black levels that were subtracted, by the places of their pattern.
        white: white levels by colour plane: what became 1.0.
        camera_from_xyz: 9 numbers by rows, ColorMatrix of the DNG or LibRaw's for the camera; None = not
            known.
        largest_gain: a bound on what the file's gain maps multiply a pixel by; at least 1.
        applied: names of the DNG opcodes that were carried out.
        left_out: names of those that were not.
        warnings: sentences for the user.
    """

    camera: str
    width: int
    height: int
    rotation_deg: int
    taken: datetime | None
    exposure_s: float | None
    iso: float | None
    aperture: float | None
    focal_length_mm: float | None
    white_balance: tuple[float, float, float] | None
    cfa: str
    black: tuple[float, ...]
    white: tuple[float, ...]
    camera_from_xyz: tuple[float, ...] | None
    largest_gain: float = 1.0
    applied: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

    @property
    def light(self) -> float | None:
        """Exposure times sensitivity over the square of the f-number, whose ratios are those of the radiance.

        None where exposure or sensitivity is not known; a lens without contacts has no f-number, and counts
        as f/1.
        """
        if self.exposure_s is None or self.iso is None:
            return None
        return self.exposure_s * self.iso / 100.0 / (self.aperture or 1.0) ** 2


def camera_name(directories: Sequence[Directory]) -> str:
    """Maker and model, the maker's name not twice."""
    for directory in directories:
        make, model = directory.text(_MAKE), directory.text(_MODEL)
        if model or make:
            known = model.lower().startswith(make.split(" ")[0].lower()) if make else True
            return model if known and model else f"{make} {model}".strip()
    return next((name for d in directories if (name := d.text(_CAMERA_NAME))), "")


def time_taken(directories: Sequence[Directory], fallback: Any) -> datetime | None:
    """The Exif time with its fraction of a second, else LibRaw's; None where the clock was never set."""
    for directory in directories:
        text = directory.text(_DATE)
        try:
            taken = datetime.strptime(text, "%Y:%m:%d %H:%M:%S")
        except ValueError:
            continue
        fraction = directory.text(_SUB_SECOND)
        if fraction.isascii() and fraction.isdigit():
            taken = taken.replace(microsecond=int(f"{fraction:0<6}"[:6]))
        return taken if taken.year >= _LEAST_YEAR else None
    if isinstance(fallback, datetime) and fallback.year >= _LEAST_YEAR:
        return fallback.replace(tzinfo=None)
    return None


def rotation_deg(flip: int) -> int:
    """The clockwise turn of LibRaw's orientation; mirrored ones, which no camera makes, as not turned."""
    return _ROTATION_DEG.get(flip, 0)


def positive(value: float) -> float | None:
    """A measured number; None for what LibRaw gives where it knows none."""
    return float(value) if np.isfinite(value) and value > 0 else None


def balanced(multipliers: Sequence[float]) -> tuple[float, float, float] | None:
    """White balance with a least multiplier of 1; None where the file has none that is possible."""
    red, green, blue = (float(value) for value in multipliers[:3])
    values = np.array([red, green, blue])
    if not (np.isfinite(values) & (values > 0)).all() or values.max() > 64 * values.min():
        return None
    red, green, blue = (values / values.min()).tolist()
    return red, green, blue


def camera_from_xyz(directories: Sequence[Directory], libraw: Any) -> tuple[float, ...] | None:
    """The nine numbers by which a DNG, or else LibRaw's list, takes XYZ to this camera's colours."""
    for tag in _COLOR_MATRICES:
        for directory in directories:
            try:
                numbers = directory.numbers(tag) if tag in directory else ()
            except ImageError:
                continue
            if len(numbers) == 9 and np.isfinite(numbers).all():
                return numbers
    matrix = np.asarray(libraw, float)[:3]
    if matrix.shape == (3, 3) and np.isfinite(matrix).all() and matrix.any():
        return tuple(matrix.ravel().tolist())
    return None
