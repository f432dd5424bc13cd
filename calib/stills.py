"""Pictures whose exposure is known, from folders, single files, a list of exposures, or sessions.

A list is a CSV file of two columns, picture and seconds: `IMG_0001.png, 1/60`; a first line without a number
is a heading. Beside it a picture's own Exif data counts: exposure time, times sensitivity, over the square of
the f-number, as far as these are there.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture.controls import UNKNOWN, Controls, controls_of_session
from capture.errors import ImageError, SourceError
from capture.images import IMAGE_SUFFIXES, decode_image
from capture.raw.tiff import read_directories
from capture.session import Session

#: Exif 2.32.
_EXPOSURE_TIME, _F_NUMBER, _SENSITIVITY = 33434, 33437, 34855
#: The list that a folder of a sweep may hold.
EXPOSURE_LIST = "exposures.csv"


@dataclass(frozen=True, eq=False)
class Still:
    """A picture as it is stored.

    Attributes:
        name: for people.
        image: [H, W, 3] RGB or [H, W], uint8, uint16 or float32.
        exposure_s: exposure time, seconds, brought to the same sensitivity and aperture for all; None = not
            known.
        controls: settings that it was taken with, as far as they are known.
    """

    name: str
    image: NDArray[Any]
    exposure_s: float | None
    controls: Controls = UNKNOWN


def read_stills(sources: Sequence[Path]) -> Iterator[Still]:
    """All pictures of the sources in turn.

    Args:
        sources: folders, pictures, exposure lists (.csv) or sessions.

    Raises:
        SourceError: there are none, or a list cannot be understood.
        ImageError, SessionError: one cannot be read.
    """
    for source in map(Path, sources):
        if (source / "session.json").is_file():
            yield from _of_session(source)
        elif source.is_dir() and (source / EXPOSURE_LIST).is_file():
            yield from _of_list(source / EXPOSURE_LIST)
        elif source.is_dir():
            files = sorted(file for file in source.iterdir() if file.suffix.lower() in IMAGE_SUFFIXES)
            if not files:
                raise SourceError(
                    f"{source} holds no picture ({', '.join(sorted(IMAGE_SUFFIXES))}); give the folder with "
                    "the pictures."
                )
            yield from map(_of_file, files)
        elif source.suffix.lower() == ".csv":
            yield from _of_list(source)
        elif not source.is_file():
            raise SourceError(f"{source} does not exist.")
        else:
            yield _of_file(source)


def _of_file(path: Path, exposure_s: float | None = None) -> Still:
    try:
        data = path.read_bytes()
    except OSError as cause:
        raise ImageError(f"{path} cannot be read: {cause.strerror or cause}.") from cause
    image = decode_image(data, path)
    found = _exif(data)
    gain = found[_SENSITIVITY] / 100.0 if _SENSITIVITY in found else None
    controls = Controls(
        width=image.shape[1], height=image.shape[0], exposure_s=found.get(_EXPOSURE_TIME), gain=gain
    )
    return Still(path.name, image, exposure_s or _light(found), controls)


def _of_list(path: Path) -> Iterator[Still]:
    try:
        rows = [row for row in csv.reader(path.read_text(encoding="utf-8-sig").splitlines()) if any(row)]
    except (OSError, UnicodeDecodeError, csv.Error) as cause:
        raise SourceError(f"{path} cannot be read as a list of exposures: {cause}.") from cause
    if rows and _seconds(rows[0]) is None:
        rows = rows[1:]
    if not rows:
        raise SourceError(f"{path} lists no pictures; each line is `picture, seconds`, as `a.png, 1/60`.")
    for row in rows:
        seconds = _seconds(row)
        if seconds is None:
            raise SourceError(
                f"{path}: {', '.join(row)!r} is no `picture, seconds` with a positive time, as `a.png, 1/60`."
            )
        yield _of_file(path.parent / row[0].strip(), seconds)


def _of_session(path: Path) -> Iterator[Still]:
    session = Session.open(path)
    records = [record for record in session.frames if record.file is not None]
    if not records:
        raise SourceError(f"{path} holds no pictures; give a session that keeps its frames.")
    for record in records:
        own = controls_of_session(session.info, [record])
        yield Still(f"frame {record.index}", session.load_image(record), record.exposure_s, own)


def _seconds(row: list[str]) -> float | None:
    """The time in a list's line; None where there is none."""
    try:
        seconds = float(Fraction(row[1].strip()))
    except (IndexError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return seconds if 0.0 < seconds < 1e6 else None


def _exif(data: bytes) -> dict[int, float]:
    """Exposure time, f-number and sensitivity of a picture's Exif data, those that are there and positive."""
    found: dict[int, float] = {}
    try:
        for directory in read_directories(data):
            for tag in (_EXPOSURE_TIME, _F_NUMBER, _SENSITIVITY):
                if tag in directory:
                    found.setdefault(tag, directory.number(tag, np.nan))
    except ImageError:
        return {}
    return {tag: value for tag, value in found.items() if np.isfinite(value) and value > 0}


def _light(found: dict[int, float]) -> float | None:
    """Exposure time at ISO 100 and f/1, where the Exif data names these; None without a time."""
    if _EXPOSURE_TIME not in found:
        return None
    light = found[_EXPOSURE_TIME] * found.get(_SENSITIVITY, 100.0) / 100.0 / found.get(_F_NUMBER, 1.0) ** 2
    return light if np.isfinite(light) and light > 0 else None
