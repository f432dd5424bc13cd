"""Frames of Motion-JPEG cameras: JPEG pictures that lean on a convention, with what the buffer held before.

A camera may leave out the Huffman tables, because every reader of Motion-JPEG knows them (ITU-T T.81, annex
K.3), and may fill its buffer beyond the end of the picture. What is written into a session has the tables and
ends where the picture ends; nothing between is touched.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from capture.errors import CameraError

_START, _END = b"\xff\xd8", b"\xff\xd9"
_HUFFMAN_TABLES, _START_OF_SCAN = 0xC4, 0xDA
_FRAME_HEADERS = frozenset({0xC0, 0xC1, 0xC2})
_REDUCED = {
    1: cv2.IMREAD_COLOR,
    2: cv2.IMREAD_REDUCED_COLOR_2,
    4: cv2.IMREAD_REDUCED_COLOR_4,
    8: cv2.IMREAD_REDUCED_COLOR_8,
}

#: ITU-T T.81, tables K.3, K.5, K.4, K.6: class and destination, 16 counts, the symbols.
_STANDARD_TABLES = bytes.fromhex(
    "0000010501010101010100000000000000000102030405060708090a0b100002010303020403050504040000017d0102"
    "0300041105122131410613516107227114328191a1082342b1c11552d1f02433627282090a161718191a25262728292a"
    "3435363738393a434445464748494a535455565758595a636465666768696a737475767778797a838485868788898a92"
    "939495969798999aa2a3a4a5a6a7a8a9aab2b3b4b5b6b7b8b9bac2c3c4c5c6c7c8c9cad2d3d4d5d6d7d8d9dae1e2e3e4"
    "e5e6e7e8e9eaf1f2f3f4f5f6f7f8f9fa0100030101010101010101010000000000000102030405060708090a0b110002"
    "0102040403040705040400010277000102031104052131061241510761711322328108144291a1b1c109233352f01562"
    "72d10a162434e125f11718191a262728292a35363738393a434445464748494a535455565758595a636465666768696a"
    "737475767778797a82838485868788898a92939495969798999aa2a3a4a5a6a7a8a9aab2b3b4b5b6b7b8b9bac2c3c4c5"
    "c6c7c8c9cad2d3d4d5d6d7d8d9dae2e3e4e5e6e7e8e9eaf2f3f4f5f6f7f8f9fa"
)


class FrameDataError(CameraError, ValueError):
    """The bytes of one frame are no picture of the stream's format; the next may be sound."""


def complete_jpeg(data: bytes, width: int, height: int) -> bytes:
    """A frame as a JPEG file that every reader opens: same scan data, Huffman tables put in where missing.

    Args:
        data: As the camera gave it.
        width: That the stream promises, pixels.
        height: Likewise.

    Raises:
        FrameDataError: Not a JPEG picture, of another size, or cut short.
    """
    start = data.find(_START, 0, 64)
    if start < 0:
        raise FrameDataError(f"A frame of {len(data)} bytes does not begin as a JPEG picture does.")
    position = start + 2
    has_tables = False
    size = None
    while True:
        if position + 4 > len(data) or data[position] != 0xFF:
            raise FrameDataError(f"A JPEG frame of {len(data)} bytes is damaged at byte {position}.")
        marker = data[position + 1]
        if marker == 0xFF:  # fill byte
            position += 1
            continue
        if marker == _START_OF_SCAN:
            break
        if marker in _FRAME_HEADERS and position + 9 <= len(data):
            size = (
                int.from_bytes(data[position + 7 : position + 9], "big"),
                int.from_bytes(data[position + 5 : position + 7], "big"),
            )
        has_tables |= marker == _HUFFMAN_TABLES
        position += 2 + max(2, int.from_bytes(data[position + 2 : position + 4], "big"))
    if size != (width, height):
        found = "no size" if size is None else f"{size[0]} x {size[1]} pixels"
        raise FrameDataError(f"A JPEG frame has {found}; the stream has {width} x {height}.")
    end = data.find(_END, position)  # scan data has no such pair: 0xFF is followed by 0 there
    if end < 0:
        raise FrameDataError(f"A JPEG frame of {len(data)} bytes is cut short.")
    tables = b"" if has_tables else _huffman_segment()
    if not tables and start == 0 and end + 2 == len(data):
        return data
    return data[start:position] + tables + data[position : end + 2]


def decode_jpeg(data: bytes, width: int, height: int, reduction: int = 1) -> NDArray[np.uint8]:
    """R'G'B' [H, W, 3] of a frame, at 1/`reduction` of its size (1, 2, 4 or 8), sizes rounded up.

    JPEG pictures are full-range BT.601 (JFIF 1.02); libjpeg converts and interpolates the chroma.

    Raises:
        FrameDataError: As `complete_jpeg`, or the decoder refuses it.
    """
    whole = complete_jpeg(data, width, height)
    flags = _REDUCED[reduction] | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        bgr = cv2.imdecode(np.frombuffer(whole, np.uint8), flags)
    except cv2.error as cause:
        raise FrameDataError(f"A JPEG frame cannot be decoded: {cause.err}.") from cause
    if bgr is None:
        raise FrameDataError(f"A JPEG frame of {len(data)} bytes is damaged and cannot be decoded.")
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def strip_huffman_tables(data: bytes) -> bytes:
    """The inverse of what `complete_jpeg` puts in, for simulated cameras: a JPEG without its tables."""
    kept, position = [data[:2]], 2
    while data[position + 1] != _START_OF_SCAN:
        length = 2 + int.from_bytes(data[position + 2 : position + 4], "big")
        if data[position + 1] != _HUFFMAN_TABLES:
            kept.append(data[position : position + length])
        position += length
    return b"".join([*kept, data[position:]])


def _huffman_segment() -> bytes:
    length = (2 + len(_STANDARD_TABLES)).to_bytes(2, "big")
    return bytes((0xFF, _HUFFMAN_TABLES)) + length + _STANDARD_TABLES
