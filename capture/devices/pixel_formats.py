"""The bytes of a camera's frame as pictures: R'G'B', the file of a session, a small picture for tagging.

Formats have V4L2's four characters (linux/videodev2.h; the layouts are in the kernel's "Image Formats"):

    MJPG JPEG                           Motion-JPEG, full-range BT.601
    YUYV YUY2 UYVY YVYU VYUY            Y'CbCr 4:2:2, packed
    NV12 NV21 NV16 NV61                 Y'CbCr, luma plane and interleaved chroma plane
    YU12 I420 YV12 422P                 Y'CbCr, three planes
    RGB3 BGR3                           8 bits a channel, or a picture [H, W, 3] as it is
    GREY "Y10 " "Y12 " "Y16 "           luma alone, full range
    BA81 GBRG GRBG RGGB                 Bayer, 8 bits
    xx10 xx12 xx14 xx16 BYR2            Bayer in 16-bit words, little endian (RG10, BG12, ...)
    pxAA pxCC                           Bayer of 10 and 12 bits, packed as MIPI CSI-2 does

Y'CbCr is converted in float32 by the format's matrix and range and rounded once. V4L2 puts the chroma samples
in the middle of the pixels that share them. Raw pictures are linear, scaled to the full range of uint8 or
uint16, neither black level nor white balance touched.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from capture.devices.camera import StreamFormat
from capture.devices.motion_jpeg import FrameDataError as FrameDataError
from capture.devices.motion_jpeg import complete_jpeg, decode_jpeg
from capture.devices.raw_mosaic import MOSAICS, demosaic, half_size, unpack_mosaic
from capture.images import encode_image

Chroma = tuple[NDArray[np.uint8], NDArray[np.uint8]]

JPEG_FORMATS = frozenset({"MJPG", "JPEG"})
#: Places of Y', Cb, Cr in two pixels.
_PACKED = {"YUYV": (0, 1, 3), "YUY2": (0, 1, 3), "UYVY": (1, 0, 2), "YVYU": (0, 3, 1), "VYUY": (1, 2, 0)}
#: Rows of chroma for a row of luma, as a divisor; whether Cr comes first.
_SEMI_PLANAR = {"NV12": (2, False), "NV21": (2, True), "NV16": (1, False), "NV61": (1, True)}
_PLANAR = {"YU12": (2, False), "I420": (2, False), "YV12": (2, True), "422P": (1, False)}
#: Bits of one sample.
_GREY = {"GREY": 8, "Y10 ": 10, "Y12 ": 12, "Y16 ": 16}
YUV_FORMATS = frozenset({*_PACKED, *_SEMI_PLANAR, *_PLANAR})
RAW_FORMATS = frozenset(MOSAICS)
#: Everything that `decode_rgb` takes.
KNOWN_FORMATS = JPEG_FORMATS | YUV_FORMATS | RAW_FORMATS | frozenset(_GREY) | {"RGB3", "BGR3"}

#: Luma weights of red and blue: ITU-R BT.601-7, BT.709-6.
_LUMA_WEIGHTS = {"bt601": (0.299, 0.114), "bt709": (0.2126, 0.0722)}
#: Rows that are converted at a time: the float pictures of a strip stay in the second-level cache.
_STRIP_ROWS = 32
#: As `capture.images` writes pictures: noise has no repetitions to be searched for.
_FAST_PNG = [
    cv2.IMWRITE_PNG_COMPRESSION,
    1,
    cv2.IMWRITE_PNG_STRATEGY,
    cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY,
    cv2.IMWRITE_PNG_FILTER,
    cv2.IMWRITE_PNG_FILTER_AVG,
]


def decode_rgb(data: bytes | NDArray[Any], format: StreamFormat) -> NDArray[Any]:
    """A frame as a picture.

    Args:
        data: The frame's bytes, or for "RGB3" a picture [H, W, 3], which is returned as it is.
        format: What the camera said it delivers.

    Returns:
        [H, W, 3] RGB, display-referred (`format.transfer`), uint8; raw formats linear and, beyond 8 bits,
        uint16. Grey formats have three equal channels.

    Raises:
        FrameDataError: Too short, damaged, or not of that format and size.
        ValueError: The format is not known.
    """
    name = format.pixel_format
    if name in JPEG_FORMATS:
        return decode_jpeg(_bytes(data), format.width, format.height)
    if name in ("RGB3", "BGR3"):
        return _rgb_picture(data, format)
    if name in RAW_FORMATS:
        return demosaic(unpack_mosaic(_bytes(data), format), name)
    if name in _GREY:
        return np.asarray(cv2.cvtColor(_grey(_bytes(data), format), cv2.COLOR_GRAY2RGB))
    luma, chroma = _planes(_bytes(data), format)
    return _rgb_of_planes(luma, chroma, format)


def picture_file(data: bytes | NDArray[Any], format: StreamFormat) -> tuple[bytes, str]:
    """A frame as the content of a file that loses nothing, and its suffix.

    A JPEG frame goes as it came (see `complete_jpeg`), ".jpg"; every other is a PNG of `decode_rgb`.

    Raises:
        FrameDataError: As `decode_rgb`; of a JPEG only its frame is looked at, not its scan.
    """
    if format.pixel_format in JPEG_FORMATS:
        return complete_jpeg(_bytes(data), format.width, format.height), ".jpg"
    return encode_image(decode_rgb(data, format), ".png", _FAST_PNG), ".png"


def small_planes(
    data: bytes | NDArray[Any], format: StreamFormat, min_side: int = 480
) -> tuple[NDArray[Any], Chroma | None]:
    """A frame reduced by averaging, as cheaply as its format allows, for tagging and metering.

    The reduction is the largest that leaves `min_side` pixels on the short side; it depends on the format
    alone, so all frames of a stream have one size. Rows stay in the sensor's order.

    Returns:
        Either luma [h, w] in code values (`luma_levels` says where black and white are) with its Cb and Cr
        planes, or a picture [h, w, 3] or [h, w] and None.

    Raises:
        FrameDataError: As `decode_rgb`.
    """
    name = format.pixel_format
    factor = max(1, min(format.width, format.height) // min_side)
    if name in JPEG_FORMATS:
        reduction = next(step for step in (8, 4, 2, 1) if step <= factor)
        return decode_jpeg(_bytes(data), format.width, format.height, reduction), None
    if name in YUV_FORMATS:
        luma, chroma = _planes(_bytes(data), format)
        small = _shrunk(chroma, factor)
        blue, red = (np.asarray(cv2.extractChannel(small, index), dtype=np.uint8) for index in (0, 1))
        return _shrunk(luma, factor), (blue, red)
    if name in _GREY:
        return _shrunk(_grey(_bytes(data), format), factor), None
    if name in RAW_FORMATS and factor >= 2:
        return _shrunk(half_size(unpack_mosaic(_bytes(data), format), name), factor // 2), None
    return _shrunk(decode_rgb(data, format), factor), None


def luma_levels(format: StreamFormat) -> tuple[float, float] | None:
    """Code values of black and white in the luma that `small_planes` gives; None = full range of the type."""
    return (16.0, 235.0) if format.pixel_format in YUV_FORMATS and not format.full_range else None


def yuv_of_rgb(
    rgb: NDArray[np.uint8], matrix: str, levels: tuple[float, float]
) -> tuple[NDArray[np.uint8], Chroma]:
    """Luma and full-size chroma in code values of a picture [H, W, 3]: the inverse of `decode_rgb`.

    Args:
        rgb: R'G'B'.
        matrix: "bt601" or "bt709".
        levels: Code values of black and white in the luma.
    """
    red, blue = _LUMA_WEIGHTS[matrix]
    black, white = levels
    picture = rgb.astype(np.float32)
    luma = picture @ np.array([red, 1.0 - red - blue, blue], np.float32)
    span = (224.0 if black > 0 else 255.0) / 255.0
    cb = 128.0 + span * (picture[..., 2] - luma) / (2.0 * (1.0 - blue))
    cr = 128.0 + span * (picture[..., 0] - luma) / (2.0 * (1.0 - red))
    codes = (np.clip(np.round(plane), 0, 255).astype(np.uint8) for plane in (cb, cr))
    y = black + luma * ((white - black) / 255.0)
    return np.clip(np.round(y), 0, 255).astype(np.uint8), (next(codes), next(codes))


def frame_bytes(format: StreamFormat) -> int | None:
    """Bytes of a whole frame; None where it varies (JPEG)."""
    name, height = format.pixel_format, format.height
    if name in JPEG_FORMATS:
        return None
    stride = line_bytes(format)
    if name in _SEMI_PLANAR:
        return stride * (height + -(-height // _SEMI_PLANAR[name][0]))
    if name in _PLANAR:
        return stride * height + 2 * (-(-stride // 2)) * -(-height // _PLANAR[name][0])
    return stride * height


def line_bytes(format: StreamFormat) -> int:
    """Bytes from one line (of luma) to the next.

    Raises:
        ValueError: The format is not known, or its stride is shorter than a line.
    """
    name, width = format.pixel_format, format.width
    if name in _PACKED:
        least = 4 * -(-width // 2)
    elif name in _SEMI_PLANAR or name in _PLANAR:
        least = 2 * -(-width // 2)
    elif name in ("RGB3", "BGR3"):
        least = 3 * width
    elif name in _GREY:
        least = width * (1 if name == "GREY" else 2)
    elif name in MOSAICS:
        least = MOSAICS[name].line_bytes(width)
    else:
        known = ", ".join(sorted(KNOWN_FORMATS))
        raise ValueError(f"The pixel format {name!r} is not known; known are {known}.")
    if format.stride_bytes and format.stride_bytes < least:
        raise ValueError(f"A line of {width} {name} pixels has {least} bytes, not {format.stride_bytes}.")
    return format.stride_bytes or least


def _planes(data: bytes, format: StreamFormat) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Luma [H, W] and chroma [h, w, 2] (Cb, Cr) in code values."""
    name, width, height = format.pixel_format, format.width, format.height
    stride = line_bytes(format)
    half = -(-width // 2)
    samples = _samples(data, format)
    if name in _PACKED:
        pairs = samples.reshape(height, stride)[:, : 4 * half].reshape(height, half, 4)
        luma_place, blue, red = _PACKED[name]
        chroma = np.empty((height, half, 2), np.uint8)
        cv2.mixChannels([pairs], [chroma], [blue, 0, red, 1])
        luma = cv2.extractChannel(pairs.reshape(height, 2 * half, 2), luma_place)
        return np.asarray(luma, dtype=np.uint8)[:, :width], chroma
    luma = samples[: stride * height].reshape(height, stride)[:, :width]
    rest = samples[stride * height :]
    if name in _SEMI_PLANAR:
        divisor, red_first = _SEMI_PLANAR[name]
        chroma = rest.reshape(-(-height // divisor), stride)[:, : 2 * half].reshape(-1, half, 2)
        return luma, np.ascontiguousarray(chroma[:, :, ::-1] if red_first else chroma)
    divisor, red_first = _PLANAR[name]
    first, second = rest.reshape(2, -(-height // divisor), -(-stride // 2))[:, :, :half]
    ordered = [second, first] if red_first else [first, second]
    return luma, np.asarray(cv2.merge([np.ascontiguousarray(plane) for plane in ordered]), dtype=np.uint8)


def _rgb_of_planes(
    luma: NDArray[np.uint8], chroma: NDArray[np.uint8], format: StreamFormat
) -> NDArray[np.uint8]:
    """R'G'B' [H, W, 3] of Y'CbCr, correctly rounded from float32 (ITU-R BT.601-7, BT.709-6)."""
    height, width = luma.shape
    across, down = -(-width // chroma.shape[1]), -(-height // chroma.shape[0])
    matrix = _rgb_from_yuv(format.matrix, format.full_range)
    nothing = np.zeros(4)
    rgb = np.empty((height, width, 3), np.uint8)
    for top in range(0, height, _STRIP_ROWS):
        rows = min(_STRIP_ROWS, height - top)
        # One more row of chroma on each side, so that strips join as if interpolated at once.
        low, high = max(0, top // down - 1), min(chroma.shape[0], -(-(top + rows) // down) + 1)
        part = chroma[low:high].astype(np.float32)
        full = cv2.resize(
            part, (part.shape[1] * across, part.shape[0] * down), interpolation=cv2.INTER_LINEAR
        )
        full = full[top - low * down :][:rows, :width]
        yuv = np.empty((rows, width, 3), np.float32)
        cv2.mixChannels([luma[top : top + rows].astype(np.float32), full], [yuv], [0, 0, 1, 1, 2, 2])
        # Adding nothing rounds and clips.
        cv2.add(cv2.transform(yuv, matrix), nothing, rgb[top : top + rows], dtype=cv2.CV_8U)
    return rgb


def _rgb_from_yuv(name: str, full_range: bool) -> NDArray[np.float32]:
    """[3, 4] affine map from code values to code values."""
    if name not in _LUMA_WEIGHTS:
        raise ValueError(f"The matrix {name!r} is not known; use {' or '.join(_LUMA_WEIGHTS)}.")
    red, blue = _LUMA_WEIGHTS[name]
    green = 1.0 - red - blue
    black, luma_span, chroma_span = (0.0, 255.0, 255.0) if full_range else (16.0, 219.0, 224.0)
    y = 255.0 / luma_span
    from_red, from_blue = 2.0 * (1.0 - red) * 255.0 / chroma_span, 2.0 * (1.0 - blue) * 255.0 / chroma_span
    linear = np.array(
        [
            [y, 0.0, from_red],
            [y, -from_blue * blue / green, -from_red * red / green],
            [y, from_blue, 0.0],
        ]
    )
    offset = -linear @ np.array([black, 128.0, 128.0])
    return np.hstack([linear, offset[:, None]]).astype(np.float32)


def _rgb_picture(data: bytes | NDArray[Any], format: StreamFormat) -> NDArray[Any]:
    shape = (format.height, format.width, 3)
    if isinstance(data, np.ndarray):
        if data.shape != shape or data.dtype not in (np.uint8, np.uint16):
            raise FrameDataError(
                f"A picture is {data.dtype}{list(data.shape)}; the stream has uint8 or uint16 {list(shape)}."
            )
        picture: NDArray[Any] = data
    else:
        lines = _samples(data, format).reshape(format.height, -1)
        picture = np.ascontiguousarray(lines[:, : 3 * format.width]).reshape(shape)
    if format.pixel_format == "BGR3":
        return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB))
    return picture


def _grey(data: bytes, format: StreamFormat) -> NDArray[Any]:
    bits = _GREY[format.pixel_format]
    lines = _samples(data, format).reshape(format.height, -1)
    if bits == 8:
        return lines[:, : format.width]
    words = np.ascontiguousarray(lines[:, : 2 * format.width]).view("<u2").astype(np.uint16)
    return (words << (16 - bits)) | (words >> (2 * bits - 16))


def _samples(data: bytes, format: StreamFormat) -> NDArray[np.uint8]:
    """The bytes of exactly one frame."""
    needed = frame_bytes(format)
    if needed is None or len(data) < needed:
        raise FrameDataError(
            f"A frame of {format.width} x {format.height} {format.pixel_format} pixels has {needed} bytes; "
            f"{len(data)} came."
        )
    return np.frombuffer(data, np.uint8, needed)


def _shrunk(picture: NDArray[Any], factor: int) -> NDArray[Any]:
    if factor <= 1:
        return picture
    size = (max(1, picture.shape[1] // factor), max(1, picture.shape[0] // factor))
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA))


def _bytes(data: bytes | NDArray[Any]) -> bytes:
    if isinstance(data, np.ndarray):
        raise ValueError("Frames of this format are bytes; a picture [H, W, 3] has the format RGB3.")
    return data
