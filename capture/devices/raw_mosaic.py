"""Raw Bayer frames: bits into uint8 or uint16 words of full scale, and each pixel's colour."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from capture.devices.camera import StreamFormat
from capture.devices.motion_jpeg import FrameDataError

#: Edge-aware: follows the edge instead of averaging across it.
_EDGE_AWARE = {
    "RGGB": cv2.COLOR_BayerRGGB2RGB_EA,
    "BGGR": cv2.COLOR_BayerBGGR2RGB_EA,
    "GRBG": cv2.COLOR_BayerGRBG2RGB_EA,
    "GBRG": cv2.COLOR_BayerGBRG2RGB_EA,
}


@dataclass(frozen=True)
class Mosaic:
    """How a raw format is laid out.

    Attributes:
        pattern: Colours of the first two rows' first two pixels: "RGGB", ...
        bits: Of a sample.
        packed: As MIPI CSI-2 packs 10 and 12 bits; otherwise 8-bit or little-endian 16-bit words.
    """

    pattern: str
    bits: int
    packed: bool = False

    def line_bytes(self, width: int) -> int:
        """Of a line without padding."""
        if not self.packed:
            return width * (1 if self.bits == 8 else 2)
        return -(-width // 4) * 5 if self.bits == 10 else -(-width // 2) * 3


#: By V4L2's four characters.
MOSAICS = {
    "BA81": Mosaic("BGGR", 8),
    "GBRG": Mosaic("GBRG", 8),
    "GRBG": Mosaic("GRBG", 8),
    "RGGB": Mosaic("RGGB", 8),
    "BG10": Mosaic("BGGR", 10),
    "GB10": Mosaic("GBRG", 10),
    "BA10": Mosaic("GRBG", 10),
    "RG10": Mosaic("RGGB", 10),
    "BG12": Mosaic("BGGR", 12),
    "GB12": Mosaic("GBRG", 12),
    "BA12": Mosaic("GRBG", 12),
    "RG12": Mosaic("RGGB", 12),
    "BG14": Mosaic("BGGR", 14),
    "GB14": Mosaic("GBRG", 14),
    "GR14": Mosaic("GRBG", 14),
    "RG14": Mosaic("RGGB", 14),
    "BYR2": Mosaic("BGGR", 16),
    "GB16": Mosaic("GBRG", 16),
    "GR16": Mosaic("GRBG", 16),
    "RG16": Mosaic("RGGB", 16),
    "pBAA": Mosaic("BGGR", 10, packed=True),
    "pGAA": Mosaic("GBRG", 10, packed=True),
    "pgAA": Mosaic("GRBG", 10, packed=True),
    "pRAA": Mosaic("RGGB", 10, packed=True),
    "pBCC": Mosaic("BGGR", 12, packed=True),
    "pGCC": Mosaic("GBRG", 12, packed=True),
    "pgCC": Mosaic("GRBG", 12, packed=True),
    "pRCC": Mosaic("RGGB", 12, packed=True),
}


def unpack_mosaic(data: bytes, format: StreamFormat) -> NDArray[Any]:
    """Samples [H, W], uint8 or, beyond 8 bits, uint16; the largest code becomes the type's largest value.

    Raises:
        FrameDataError: Too few bytes.
    """
    mosaic = MOSAICS[format.pixel_format]
    width, height = format.width, format.height
    least = mosaic.line_bytes(width)
    stride = max(format.stride_bytes, least)
    if len(data) < stride * height:
        raise FrameDataError(
            f"A frame of {width} x {height} {format.pixel_format} pixels has {stride * height} bytes; "
            f"{len(data)} came."
        )
    lines = np.frombuffer(data, np.uint8, stride * height).reshape(height, stride)[:, :least]
    if mosaic.bits == 8:
        return np.ascontiguousarray(lines)
    if mosaic.packed:
        words = _unpack_ten(lines) if mosaic.bits == 10 else _unpack_twelve(lines)
        words = words[:, :width]
    else:
        words = np.ascontiguousarray(lines).view("<u2").astype(np.uint16)
    # Bits beyond the format's are said to be zero; some drivers leave rubbish there.
    words = words & np.uint16((1 << mosaic.bits) - 1)
    return (words << (16 - mosaic.bits)) | (words >> (2 * mosaic.bits - 16))


def demosaic(samples: NDArray[Any], pixel_format: str) -> NDArray[Any]:
    """Linear RGB [H, W, 3] of a mosaic [H, W], in its type; each pixel keeps the sample it has."""
    if min(samples.shape) < 4:
        raise FrameDataError(
            f"A mosaic of {samples.shape[1]} x {samples.shape[0]} is too small; 4 x 4 is the least."
        )
    code = _EDGE_AWARE[MOSAICS[pixel_format].pattern]
    return np.asarray(cv2.demosaicing(np.ascontiguousarray(samples), code))


def half_size(samples: NDArray[Any], pixel_format: str) -> NDArray[Any]:
    """Linear RGB [H // 2, W // 2, 3]: a pixel from each 2 x 2 cell, its two greens averaged."""
    pattern = MOSAICS[pixel_format].pattern
    rows, columns = samples.shape[0] // 2 * 2, samples.shape[1] // 2 * 2
    cells = [samples[y:rows:2, x:columns:2] for y in (0, 1) for x in (0, 1)]
    first, second = (index for index, colour in enumerate(pattern) if colour == "G")
    green = cv2.addWeighted(cells[first], 0.5, cells[second], 0.5, 0.0)
    red, blue = (np.ascontiguousarray(cells[pattern.index(colour)]) for colour in "RB")
    return np.asarray(cv2.merge([red, green, blue]))


def _unpack_ten(lines: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """Four samples in five bytes: the high eight bits of each, then the low two of all, the first lowest."""
    groups = lines.reshape(lines.shape[0], -1, 5).astype(np.uint16)
    low = (groups[:, :, 4:] >> np.arange(0, 8, 2, dtype=np.uint16)) & 3
    return np.asarray((groups[:, :, :4] << 2) | low, dtype=np.uint16).reshape(lines.shape[0], -1)


def _unpack_twelve(lines: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """Two samples in three bytes: the high eight bits of each, then the low four, the first lowest."""
    groups = lines.reshape(lines.shape[0], -1, 3).astype(np.uint16)
    low = (groups[:, :, 2:] >> np.arange(0, 8, 4, dtype=np.uint16)) & 15
    return np.asarray((groups[:, :, :2] << 4) | low, dtype=np.uint16).reshape(lines.shape[0], -1)
