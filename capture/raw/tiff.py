"""Directories of a TIFF, of a DNG or of the TIFF-like part of a camera's RAW (TIFF 6.0, section 2).

Only looked at, never decoded: LibRaw does the pixels. A damaged file costs bounded time and memory: nothing
is allocated by a count that the file cannot hold, and no directory is visited twice.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from fractions import Fraction

from capture.errors import ImageError

SUB_DIRECTORIES, EXIF_DIRECTORY = 330, 34665

# Field types of TIFF 6.0 and 13 = IFD: (bytes, struct code); rationals are two integers.
_KINDS = {
    1: (1, "B"),
    2: (1, "s"),
    3: (2, "H"),
    4: (4, "I"),
    5: (8, "II"),
    6: (1, "b"),
    7: (1, "B"),
    8: (2, "h"),
    9: (4, "i"),
    10: (8, "ii"),
    11: (4, "f"),
    12: (8, "d"),
    13: (4, "I"),
}
_RATIONALS = (5, 10)
# After the byte order: 42 = TIFF; Olympus writes RO and RS, Panasonic U.
_MAGIC = {42, 0x4F52, 0x5352, 0x55}
_MOST_DIRECTORIES = 64  # a DNG of many previews has about ten
_MOST_NUMBERS = 1 << 20  # of one field that is read as numbers; a LinearizationTable has 65536
_EXIF_WITHIN = 1 << 20  # bytes at the head of other formats in which their Exif block is looked for


@dataclass(frozen=True)
class Directory:
    """One image file directory.

    Attributes:
        data: the file, or the part that offsets count from.
        order: "<" or ">".
        fields: tag -> (type, count, offset of the value).
    """

    data: bytes
    order: str
    fields: Mapping[int, tuple[int, int, int]]

    def __contains__(self, tag: int) -> bool:
        return tag in self.fields

    def value(self, tag: int) -> bytes:
        """The value of a field as it is stored.

        Raises:
            ImageError: it is missing or reaches beyond the file.
        """
        if tag not in self.fields:
            raise ImageError(f"the TIFF tag {tag} is missing")
        kind, count, offset = self.fields[tag]
        size = count * _KINDS[kind][0] if kind in _KINDS else 0
        if kind not in _KINDS or offset + size > len(self.data):
            raise ImageError(f"the TIFF tag {tag} (type {kind}, {count} values) reaches beyond the file")
        return self.data[offset : offset + size]

    def numbers(self, tag: int) -> tuple[float, ...]:
        """The numbers of a field; rationals as floats (n/0 as nan).

        Raises:
            ImageError: it is missing, damaged or no numbers.
        """
        raw = self.value(tag)
        kind, count, _ = self.fields[tag]
        size, code = _KINDS[kind]
        if code == "s" or count > _MOST_NUMBERS:
            raise ImageError(f"the TIFF tag {tag} (type {kind}, {count} values) holds no numbers")
        if kind in _RATIONALS:
            parts = struct.unpack(f"{self.order}{2 * count}{code[0]}", raw)
            return tuple(_ratio(*parts[2 * k : 2 * k + 2]) for k in range(count))
        return tuple(struct.unpack(f"{self.order}{count}{code}", raw[: count * size]))

    def number(self, tag: int, default: float) -> float:
        """The first number of a field, or the default where there is no such field."""
        return next(iter(self.numbers(tag)), default) if tag in self else default

    def text(self, tag: int) -> str:
        """An ASCII field without its zeros and outer blanks; empty where there is none, or it is damaged."""
        try:
            raw = self.value(tag)[:1024]
        except ImageError:
            return ""
        text = raw.split(b"\0")[0].decode("utf-8", "replace").strip()
        return "".join(letter if letter.isprintable() else " " for letter in text)


def read_directories(data: bytes) -> list[Directory]:
    """All directories of a file: the chain of main ones, their sub-directories and Exif; [] for no TIFF.

    Formats that are no TIFF but carry one (Fujifilm's RAF in its preview's Exif, Canon's CR3 in its boxes
    CMT1 and CMT2) give the directories of that.
    """
    return [directory for part in _tiff_parts(data) for directory in _walk(part)]


def _tiff_parts(data: bytes) -> Iterator[bytes]:
    if _order(data):
        yield data
        return
    head = data[:_EXIF_WITHIN]
    for mark in (b"Exif\0\0", b"CMT1", b"CMT2"):
        place = head.find(mark)
        if place >= 0 and _order(part := data[place + len(mark) : place + len(mark) + _EXIF_WITHIN]):
            yield part


def _order(data: bytes) -> str:
    """Byte order of a TIFF; empty for anything else."""
    order = {b"II": "<", b"MM": ">"}.get(data[:2], "")
    return order if order and len(data) >= 8 and _number(data, order + "H", 2) in _MAGIC else ""


def _walk(data: bytes) -> Iterator[Directory]:
    order = _order(data)
    waiting = [_number(data, order + "I", 4)]
    seen: set[int] = set()
    while waiting and len(seen) < _MOST_DIRECTORIES:
        offset = waiting.pop(0)
        if offset in seen or not 8 <= offset <= len(data) - 2:
            continue
        seen.add(offset)
        count = min(_number(data, order + "H", offset), (len(data) - offset - 2) // 12)
        fields = {}
        for entry in range(count):
            place = offset + 2 + 12 * entry
            tag, kind, values = struct.unpack_from(order + "HHI", data, place)
            inline = kind in _KINDS and values * _KINDS[kind][0] <= 4
            fields[tag] = (kind, values, place + 8 if inline else _number(data, order + "I", place + 8))
        directory = Directory(data, order, fields)
        yield directory
        for tag in (SUB_DIRECTORIES, EXIF_DIRECTORY):
            if tag in fields and fields[tag][1] <= _MOST_DIRECTORIES:
                waiting += _offsets(directory, tag)
        following = offset + 2 + 12 * count
        if following + 4 <= len(data):
            waiting.append(_number(data, order + "I", following))


def _offsets(directory: Directory, tag: int) -> list[int]:
    try:
        return [int(number) for number in directory.numbers(tag) if number == number]
    except (ImageError, OverflowError):
        return []


def _number(data: bytes, code: str, offset: int) -> int:
    return int(struct.unpack_from(code, data, offset)[0])


def _ratio(above: int, below: int) -> float:
    return float(Fraction(above, below)) if below else float("nan")
