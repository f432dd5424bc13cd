"""What a picture file says of itself, looked at before a decoder is trusted with it."""

from __future__ import annotations

import re
import struct

_PNG = b"\x89PNG\r\n\x1a\n"
_TIFF_WIDTH, _TIFF_HEIGHT = 256, 257
_TIFF_INTEGERS = {3: "H", 4: "I"}  # field types SHORT and LONG


def header_size(data: bytes) -> tuple[int, int] | None:
    """(width, height) of a PNG, JPEG, TIFF or Radiance HDR; None = another format, or a damaged header."""
    if data[:8] == _PNG and len(data) >= 24:
        width, height = struct.unpack(">II", data[16:24])
        return width, height
    if data[:2] == b"\xff\xd8":
        return _jpeg_size(data)
    if data[:4] in (b"II*\0", b"MM\0*"):
        return _tiff_size(data, "<" if data[:2] == b"II" else ">")
    if data[:2] == b"#?" and (match := re.search(rb"\n-Y +(\d{1,9}) +\+X +(\d{1,9})\n", data[:8192])):
        return int(match[2]), int(match[1])
    return None


def is_cut_short(data: bytes) -> bool:
    """Whether a PNG or JPEG lacks its end; never so for other formats, of which the decoder sees it."""
    if data[:8] == _PNG:
        # OpenCV takes memory for a chunk by its stated length before it looks whether the chunk is there.
        position = 8
        while position + 12 <= len(data):
            length, kind = struct.unpack_from(">I4s", data, position)
            position += 12 + length
            if kind == b"IEND":
                return position > len(data)
        return True
    # libjpeg fills what is missing with grey; a start of scan without an end of image after it tells.
    return data[:2] == b"\xff\xd8" and data.rfind(b"\xff\xd9") < data.rfind(b"\xff\xda")


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    """Walks the segments to the start of frame (ITU-T T.81, annex B)."""
    position = 2
    while position + 9 <= len(data) and data[position] == 0xFF:
        marker = data[position + 1]
        if marker == 0xFF:  # fill byte
            position += 1
        elif marker == 0x01 or 0xD0 <= marker <= 0xD7:  # markers without a length
            position += 2
        elif 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack(">HH", data[position + 5 : position + 9])
            return width, height
        else:
            position += 2 + struct.unpack(">H", data[position + 2 : position + 4])[0]
    return None


def _tiff_size(data: bytes, order: str) -> tuple[int, int] | None:
    """Reads the first directory of fields (TIFF 6.0, section 2)."""
    found = {}
    try:
        (directory,) = struct.unpack_from(order + "I", data, 4)
        (count,) = struct.unpack_from(order + "H", data, directory)
        for entry in range(count):
            start = directory + 2 + 12 * entry
            tag, kind, _ = struct.unpack_from(order + "HHI", data, start)
            if tag in (_TIFF_WIDTH, _TIFF_HEIGHT) and kind in _TIFF_INTEGERS:
                (found[tag],) = struct.unpack_from(order + _TIFF_INTEGERS[kind], data, start + 8)
    except struct.error:  # the file ends inside the directory
        return None
    return (found[_TIFF_WIDTH], found[_TIFF_HEIGHT]) if len(found) == 2 else None
