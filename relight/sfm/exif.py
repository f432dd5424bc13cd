"""The focal length that a JPEG file states of itself (Exif 2.32, tag FocalLengthIn35mmFilm and its kin)."""

from __future__ import annotations

import math
import struct

_FULL_FRAME_DIAGONAL_MM = math.hypot(36.0, 24.0)
_EXIF_POINTER, _FOCAL_35MM = 0x8769, 0xA405
_FOCAL_MM, _PLANE_X_RESOLUTION, _PLANE_UNIT, _PIXEL_WIDTH = 0x920A, 0xA20E, 0xA210, 0xA002
_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 7: 1, 9: 4, 10: 8}
_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0}
_MOST_ENTRIES = 1000


def focal_length_px(data: bytes, width: int, height: int) -> float | None:
    """Focal length in pixels of a picture as it is stored; None where the file does not say.

    Args:
        data: Content of the file, or its first 64 kB.
        width: Of the picture, pixels.
        height: Pixels.
    """
    tiff = _exif_block(data)
    if tiff is None:
        return None
    try:
        tags = _tags(tiff)
    except (struct.error, ValueError, ZeroDivisionError):  # a damaged block says nothing
        return None
    film_mm = tags.get(_FOCAL_35MM, 0.0)
    if film_mm > 0:
        return film_mm * math.hypot(width, height) / _FULL_FRAME_DIAGONAL_MM
    focal_mm, resolution = tags.get(_FOCAL_MM, 0.0), tags.get(_PLANE_X_RESOLUTION, 0.0)
    unit_mm = _UNIT_MM.get(int(tags.get(_PLANE_UNIT, 2)))
    if focal_mm > 0 and resolution > 0 and unit_mm is not None:
        taken_width = tags.get(_PIXEL_WIDTH, 0.0) or max(width, height)
        return focal_mm * resolution / unit_mm * max(width, height) / taken_width
    return None


def _exif_block(data: bytes) -> bytes | None:
    """The TIFF structure in a JPEG's APP1 segment."""
    if data[:2] != b"\xff\xd8":
        return None
    position = 2
    while position + 4 <= len(data) and data[position] == 0xFF:
        marker = data[position + 1]
        length = int.from_bytes(data[position + 2 : position + 4], "big")
        if marker == 0xE1 and data[position + 4 : position + 10] == b"Exif\0\0":
            return data[position + 10 : position + 2 + length]
        if marker == 0xDA or length < 2:  # the picture itself, or nonsense
            return None
        position += 2 + length
    return None


def _tags(tiff: bytes) -> dict[int, float]:
    """First numbers of the fields of the main and the Exif directory."""
    order = {b"II": "<", b"MM": ">"}.get(tiff[:2])
    if order is None:
        raise ValueError("no TIFF")
    found: dict[int, float] = {}
    waiting = [struct.unpack_from(order + "I", tiff, 4)[0]]
    for start in waiting:
        (count,) = struct.unpack_from(order + "H", tiff, start)
        for entry in range(min(count, _MOST_ENTRIES)):
            at = start + 2 + 12 * entry
            tag, kind, number = struct.unpack_from(order + "HHI", tiff, at)
            value = _number(tiff, order, kind, number, at + 8)
            if value is None:
                continue
            if tag == _EXIF_POINTER and len(waiting) == 1:
                waiting.append(int(value))
            found.setdefault(tag, value)
    return found


def _number(tiff: bytes, order: str, kind: int, number: int, at: int) -> float | None:
    size = _SIZES.get(kind)
    if size is None or number < 1:
        return None
    if size * number > 4:
        (at,) = struct.unpack_from(order + "I", tiff, at)
    if kind == 3:
        return float(struct.unpack_from(order + "H", tiff, at)[0])
    if kind in (4, 9):
        return float(struct.unpack_from(order + ("I" if kind == 4 else "i"), tiff, at)[0])
    if kind in (5, 10):
        over, under = struct.unpack_from(order + ("II" if kind == 5 else "ii"), tiff, at)
        return float(over / under)
    return None
