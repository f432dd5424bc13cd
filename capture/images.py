"""Pictures as arrays: RGB order, [H, W, C], never rotated, never rescaled.

Eight- and sixteen-bit pictures (PNG, JPEG, TIFF) hold stored values; EXR and Radiance HDR hold float32.
EXIF orientation is ignored on purpose: a frame keeps the sensor's orientation, and the session records the
rotation.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR
from numpy.typing import NDArray

from capture.atomic import atomic_write as atomic_write
from capture.errors import ImageError
from capture.image_header import header_size, is_cut_short

#: Suffixes that `read_image` reads.
IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".tif", ".tiff", ".exr", ".hdr"})

# A bound on what a damaged header may make us allocate; the largest phone sensors have 200 million pixels.
_LARGEST_PIXELS = 1 << 28
_PIXELS_PER_BYTE = 1 << 14  # of a flat picture: deflate packs 8256 1-bit pixels into one, a JPEG 512
_HALF_MAX = 65504.0


# Pictures have noise, in which a search for repetitions finds nothing: 2.5 times as fast without, and smaller
# with the filter that fits noise best. Masks are all repetition.
_PNG_PICTURE = [
    cv2.IMWRITE_PNG_COMPRESSION,
    1,
    cv2.IMWRITE_PNG_STRATEGY,
    cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY,
    cv2.IMWRITE_PNG_FILTER,
    cv2.IMWRITE_PNG_FILTER_AVG,
]
_PNG_MASK = [cv2.IMWRITE_PNG_COMPRESSION, 1]


def natural_order(name: str) -> list[tuple[int, str]]:
    """Sorting key by which frame_2 comes before frame_10."""
    parts = re.split(r"(\d+)", name)
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]


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
    _checked_size(data, path)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as cause:
        raise ImageError(f"{path} cannot be decoded: {cause.err}.") from cause
    if image is None:
        raise ImageError(f"{path} is damaged and cannot be decoded; copy or export it again.")
    if image.dtype not in (np.uint8, np.uint16, np.float32):
        raise ImageError(f"{path} holds {image.dtype} pixels; 8 or 16 bits a channel or float32 are needed.")
    if image.ndim == 3 and image.shape[2] == 4:
        return cv2.cvtColor(image, cv2.COLOR_BGRA2RGB)
    if image.ndim == 3 and image.shape[2] == 3:
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
    return image[..., 0] if image.ndim == 3 else image


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) of a picture in pixels, from its header.

    Raises:
        ImageError: as far as the header and the end of the file tell, the picture cannot be read.
    """
    path = Path(path)
    if path.suffix.lower() == ".exr":
        return _exr_size(_exr_header(path), path)
    return _checked_size(_read_bytes(path), path)


def write_png(path: Path, array: NDArray[Any]) -> None:
    """Writes [H, W] (a mask) or [H, W, 3] (a picture) uint8 or uint16, without loss."""
    if array.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"A PNG holds uint8 or uint16 pixels, not {array.dtype}.")
    atomic_write(path, encode_image(array, ".png", _PNG_PICTURE if array.ndim == 3 else _PNG_MASK))


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
        if {"R", "G", "B"} <= planes.keys():
            return np.stack([planes[name] for name in "RGB"], axis=-1).astype(np.float32, copy=False)
    except (RuntimeError, ValueError, TypeError, MemoryError) as cause:
        raise ImageError(f"{path} cannot be read as OpenEXR: {_one_line(cause)}.") from cause
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


def _checked_size(data: bytes, path: Path) -> tuple[int, int]:
    """(width, height) of a picture that looks whole and not larger than its file can hold."""
    size = header_size(data)
    if size is None:
        raise ImageError(f"{path} is damaged or empty, or no PNG, JPEG, TIFF, HDR or EXR picture.")
    width, height = size
    if not 0 < width * height <= min(_LARGEST_PIXELS, len(data) * _PIXELS_PER_BYTE):
        raise ImageError(f"{path} claims {width} x {height} pixels, which its {len(data)} bytes cannot hold.")
    if is_cut_short(data):
        raise ImageError(f"{path} is cut short or damaged; copy or export it again.")
    return width, height


def _read_bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as cause:
        raise ImageError(f"{path} cannot be read: {cause.strerror or cause}.") from cause


def _one_line(cause: BaseException) -> str:
    return (" ".join(str(cause).split()) or type(cause).__name__).rstrip(".")
