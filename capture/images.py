"""Pictures as arrays: RGB order, [H, W, C], never rotated, never rescaled.

Eight- and sixteen-bit pictures (PNG, JPEG, TIFF, WebP) hold stored values; EXR and Radiance HDR hold float32.
EXIF orientation is ignored on purpose: a frame keeps the sensor's orientation, and the session records the
rotation.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR
from numpy.typing import NDArray

from capture.atomic import atomic_write as atomic_write
from capture.errors import ImageError

#: Suffixes that `read_image` reads.
IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".bmp", ".exr", ".hdr"})

# A bound on what a damaged header may make us allocate; the largest phone sensors have 200 million pixels.
_LARGEST_PIXELS = 1 << 28
_HALF_MAX = 65504.0


def read_image(path: Path) -> NDArray[Any]:
    """A picture as it is stored.

    Returns:
        [H, W, 3] RGB or [H, W], of uint8, uint16 or float32 (.exr, .hdr). An alpha channel is dropped.

    Raises:
        ImageError: missing, cut short, damaged or of another kind.
    """
    path = Path(path)
    if path.suffix.lower() == ".exr":
        return read_exr(path)
    return decode_image(_read_bytes(path), path)


def decode_image(data: bytes, path: Path) -> NDArray[Any]:
    """As `read_image`, from a file's content; `path` is for messages."""
    _check_header(data, path)
    if data[:2] == b"\xff\xd8" and data.rfind(b"\xff\xd9") < data.rfind(b"\xff\xda"):
        # libjpeg fills what is missing with grey; a start-of-scan without an end-of-image after it tells.
        raise ImageError(f"{path} is cut short (the JPEG has no end); copy or export it again.")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as cause:
        raise ImageError(f"{path} cannot be decoded: {cause.err}.") from cause
    if image is None:
        raise ImageError(f"{path} is damaged, empty or no picture (PNG, JPEG, TIFF, WebP, BMP, HDR or EXR).")
    if image.dtype not in (np.uint8, np.uint16, np.float32):
        raise ImageError(f"{path} holds {image.dtype} pixels; 8 or 16 bits a channel or float32 are needed.")
    if image.ndim == 3 and image.shape[2] == 4:
        return cv2.cvtColor(image, cv2.COLOR_BGRA2RGB)
    if image.ndim == 3 and image.shape[2] == 3:
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
    return image[..., 0] if image.ndim == 3 else image


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) of a picture in pixels, from its header where that is enough (PNG, JPEG, EXR)."""
    path = Path(path)
    if path.suffix.lower() == ".exr":
        return _exr_size(_exr_header(path), path)
    data = _read_bytes(path)
    if size := _header_size(data):
        return size
    height, width = decode_image(data, path).shape[:2]
    return width, height


def write_png(path: Path, array: NDArray[Any], compression: int = 1) -> None:
    """Writes [H, W] or [H, W, 3] uint8 or uint16; `compression` 0..9 (1: fast, a tenth larger than 6)."""
    if array.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"A PNG holds uint8 or uint16 pixels, not {array.dtype}.")
    atomic_write(path, encode_image(array, ".png", [cv2.IMWRITE_PNG_COMPRESSION, compression]))


def write_jpeg(path: Path, array: NDArray[np.uint8], quality: int = 95) -> None:
    """Writes [H, W] or [H, W, 3] uint8 without chroma subsampling."""
    if array.dtype != np.uint8:
        raise ValueError(f"A JPEG holds uint8 pixels, not {array.dtype}.")
    parameters = [
        cv2.IMWRITE_JPEG_QUALITY,
        quality,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
    ]
    atomic_write(path, encode_image(array, ".jpg", parameters))


def write_image(path: Path, array: NDArray[Any]) -> None:
    """Writes a picture in the format of its suffix: .png, .jpg, .jpeg or .exr."""
    writers: dict[str, Callable[[Path, NDArray[Any]], None]] = {
        ".png": write_png,
        ".jpg": write_jpeg,
        ".jpeg": write_jpeg,
        ".exr": write_exr,
    }
    suffix = Path(path).suffix.lower()
    if suffix not in writers:
        raise ValueError(f"Pictures are written as .png, .jpg or .exr, not {suffix!r}.")
    writers[suffix](path, array)


def encode_image(array: NDArray[Any], suffix: str, parameters: list[int]) -> bytes:
    """The bytes of an RGB or grey picture in the format of a suffix, with OpenCV's parameters."""
    if array.ndim not in (2, 3) or (array.ndim == 3 and array.shape[2] not in (1, 3)) or array.size == 0:
        raise ValueError(f"A picture has the shape [H, W] or [H, W, 3], not {list(array.shape)}.")
    bgr = cv2.cvtColor(array, cv2.COLOR_RGB2BGR) if array.ndim == 3 and array.shape[2] == 3 else array
    ok, data = cv2.imencode(suffix, np.ascontiguousarray(bgr), parameters)
    if not ok:
        raise ImageError(f"A {suffix} picture of shape {list(array.shape)} could not be encoded.")
    return data.tobytes()


def read_exr(path: Path) -> NDArray[np.float32]:
    """Pixels of an OpenEXR file.

    Returns:
        [H, W, 3] R, G, B (alpha and other channels are dropped), or [H, W] for a file with a single channel.

    Raises:
        ImageError: missing, damaged, or without R, G, B or a single channel.
    """
    path = Path(path)
    _exr_size(_exr_header(path), path)
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            planes = {name: channel.pixels for name, channel in file.channels().items()}
    except (RuntimeError, ValueError, TypeError, MemoryError) as cause:
        raise ImageError(f"{path} cannot be read as OpenEXR: {_one_line(cause)}.") from cause
    if {"R", "G", "B"} <= planes.keys():
        return np.stack([planes[name] for name in "RGB"], axis=-1).astype(np.float32, copy=False)
    if len(planes) == 1:
        return next(iter(planes.values())).astype(np.float32)
    raise ImageError(
        f"{path} has the channels {', '.join(sorted(planes))}; R, G, B or a single one are needed."
    )


def write_exr(path: Path, array: NDArray[Any], half: bool = True) -> None:
    """Writes [H, W] (channel Y) or [H, W, 3] (R, G, B), losslessly compressed.

    Args:
        path: the file.
        array: any float or integer type.
        half: 16-bit floats; values beyond their range (65504) are stored as 32-bit instead.
    """
    array = np.asarray(array)
    if array.ndim not in (2, 3) or (array.ndim == 3 and array.shape[2] != 3) or array.size == 0:
        raise ValueError(f"An EXR picture has the shape [H, W] or [H, W, 3], not {list(array.shape)}.")
    fits = half and bool(np.nanmax(np.abs(array), initial=0.0) <= _HALF_MAX)
    pixels = np.ascontiguousarray(array, dtype=np.float16 if fits else np.float32)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    channels = {"RGB": pixels} if pixels.ndim == 3 else {"Y": pixels}
    with OpenEXR.File(header, channels) as file:
        atomic_write(path, lambda temporary: file.write(str(temporary)))


def _exr_header(path: Path) -> dict[str, Any]:
    try:
        with OpenEXR.File(str(path), header_only=True) as file:
            return dict(file.header())
    except (RuntimeError, ValueError, TypeError, MemoryError) as cause:
        raise ImageError(f"{path} cannot be read as OpenEXR: {_one_line(cause)}.") from cause


def _exr_size(header: dict[str, Any], path: Path) -> tuple[int, int]:
    try:
        low, high = header["dataWindow"]
        width, height = int(high[0]) - int(low[0]) + 1, int(high[1]) - int(low[1]) + 1
    except (KeyError, TypeError, ValueError, IndexError) as cause:
        raise ImageError(f"{path} has no valid data window in its header.") from cause
    if width < 1 or height < 1 or width * height > _LARGEST_PIXELS:
        raise ImageError(
            f"{path} claims {width} x {height} pixels; at most {_LARGEST_PIXELS} pixels are read."
        )
    return width, height


def _check_header(data: bytes, path: Path) -> None:
    size = _header_size(data)
    if size and not 0 < size[0] * size[1] <= _LARGEST_PIXELS:
        raise ImageError(
            f"{path} claims {size[0]} x {size[1]} pixels; 1 to {_LARGEST_PIXELS} pixels are read."
        )


def _header_size(data: bytes) -> tuple[int, int] | None:
    """(width, height) of a PNG or JPEG from its header; None for other formats or a damaged header."""
    if data[:8] == b"\x89PNG\r\n\x1a\n" and len(data) >= 24:
        width, height = struct.unpack(">II", data[16:24])
        return width, height
    if data[:2] == b"\xff\xd8":
        return _jpeg_size(data)
    return None


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    """Walks a JPEG's segments to the start-of-frame (ITU-T T.81, annex B)."""
    position = 2
    while position + 9 <= len(data) and data[position] == 0xFF:
        marker = data[position + 1]
        if marker == 0xFF or marker == 0x01 or 0xD0 <= marker <= 0xD7:
            position += 1 if marker == 0xFF else 2  # fill byte, or a marker without a length
            continue
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack(">HH", data[position + 5 : position + 9])
            return width, height
        position += 2 + struct.unpack(">H", data[position + 2 : position + 4])[0]
    return None


def _read_bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as cause:
        raise ImageError(f"{path} cannot be read: {cause.strerror or cause}.") from cause


def _one_line(cause: BaseException) -> str:
    return (" ".join(str(cause).split()) or type(cause).__name__).rstrip(".")
