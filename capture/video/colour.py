"""Colour of a video stream: what its tags say, what is decided where they are silent, YUV to RGB accordingly.

Tags are the code points of ITU-T H.273 as FFmpeg numbers them. Three matrices are met in phone video: BT.601,
BT.709 and BT.2020 with non-constant luminance; a stream without a matrix tag is decided by its size, as
players do, and says so.

8-bit pictures are converted by swscale with matrix and range set explicitly (checked in the tests to be
correctly rounded); deeper ones in float32 here, because swscale's 16-bit RGB is off by up to one 8-bit step.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from av.video.frame import VideoFrame
from av.video.reformatter import Interpolation, VideoReformatter
from numpy.typing import NDArray

from capture.errors import SourceError

Pixels = NDArray[np.uint8] | NDArray[np.uint16]

#: Luma weights (red, blue) of a matrix: ITU-R BT.601, BT.709, BT.2020.
LUMA_WEIGHTS = {"bt601": (0.299, 0.114), "bt709": (0.2126, 0.0722), "bt2020": (0.2627, 0.0593)}
_SWSCALE_MATRIX = {"bt601": 5, "bt709": 1, "bt2020": 9}
_SWSCALE_EXACT = (
    Interpolation.BILINEAR
    | Interpolation.ACCURATE_RND
    | Interpolation.FULL_CHR_H_INT
    | Interpolation.FULL_CHR_H_INP
)

#: Name -> H.273 code point, for writing; the first name of a code point is the one that reading gives.
MATRIX_CODES = {"bt601": 6, "bt709": 1, "bt2020": 9}
PRIMARIES_CODES = {"bt601": 6, "bt709": 1, "bt2020": 9}
RANGE_CODES = {"limited": 1, "full": 2}
TRANSFER_CODES = {"rec709": 1, "srgb": 13, "gamma:2.2": 4, "gamma:2.8": 5, "linear": 8, "pq": 16, "hlg": 18}

_UNSPECIFIED = (0, 2)  # 0 is "reserved" for primaries and transfer; some phones write it for "unknown"
_MATRIX_NAMES = {1: "bt709", 5: "bt601", 6: "bt601", 9: "bt2020"}
_PRIMARIES_NAMES = {1: "bt709", 5: "bt601", 6: "bt601", 9: "bt2020"}
# 1, 6, 14 and 15 are one function (H.273 table 3).
_TRANSFER_NAMES = {
    1: "rec709",
    6: "rec709",
    14: "rec709",
    15: "rec709",
    4: "gamma:2.2",
    5: "gamma:2.8",
    8: "linear",
    13: "srgb",
}
_HDR_NAMES = {16: "PQ (SMPTE ST 2084)", 18: "HLG (ARIB STD-B67)"}


@dataclass(frozen=True)
class VideoColour:
    """How the code values of a stream are meant.

    Attributes:
        matrix: "bt601", "bt709" or "bt2020".
        color_range: "limited" (16..235 of 8 bits) or "full" (0..255).
        transfer: a name of `capture.transfer`.
        primaries: "bt601", "bt709", "bt2020" or "unknown"; recorded only.
        warnings: one sentence for everything that was decided here and not said by the stream.
    """

    matrix: str
    color_range: str
    transfer: str
    primaries: str
    warnings: tuple[str, ...] = ()


def default_matrix(width: int, height: int) -> str:
    """The matrix of an untagged stream by its size: BT.601 up to standard definition, else BT.709."""
    return "bt709" if max(width, height) >= 1280 or min(width, height) > 576 else "bt601"


def colour_of_frame(frame: VideoFrame, name: str) -> VideoColour:
    """What the tags of a decoded frame say.

    Args:
        frame: any frame of the stream (the tags are the stream's).
        name: the file's name, for messages.

    Raises:
        SourceError: an HDR transfer (PQ, HLG), a matrix that phone video does not have, or a pixel format
            that is not 8- to 16-bit YUV.
    """
    _require_yuv(frame, name)
    warnings: list[str] = []
    size = f"{frame.width} x {frame.height}"

    primaries = _PRIMARIES_NAMES.get(frame.color_primaries, "unknown")
    matrix_code = int(frame.colorspace)
    if matrix_code in _MATRIX_NAMES:
        matrix = _MATRIX_NAMES[matrix_code]
    elif matrix_code != 2:
        raise SourceError(
            f"{name} uses the colour matrix {matrix_code} of H.273, which is not supported; record it as "
            "BT.601, BT.709 or BT.2020 (non-constant luminance)."
        )
    elif primaries != "unknown":
        matrix = primaries
        warnings.append(f"{name} has no matrix tag; {_title(matrix)} was taken from its primaries.")
    else:
        matrix = default_matrix(frame.width, frame.height)
        warnings.append(f"{name} has no matrix tag; {_title(matrix)} was chosen by its size {size}.")

    if frame.color_range in RANGE_CODES.values():
        color_range = "full" if frame.color_range == RANGE_CODES["full"] else "limited"
    else:
        color_range = "full" if frame.format.name.startswith("yuvj") else "limited"
        if color_range == "limited":
            warnings.append(f"{name} has no range tag; limited range was assumed, as the codecs prescribe.")

    transfer_code = int(frame.color_trc)
    if transfer_code in _HDR_NAMES:
        raise SourceError(
            f"{name} is HDR video with the {_HDR_NAMES[transfer_code]} transfer, which phones tone map by "
            "the scene and which cannot be linearised; switch HDR off in the camera app and record again."
        )
    if transfer_code in _TRANSFER_NAMES:
        transfer = _TRANSFER_NAMES[transfer_code]
    elif transfer_code in _UNSPECIFIED:
        transfer = "rec709"
        warnings.append(
            f"{name} has no transfer tag; BT.709 was assumed; name the curve that was used if you know it."
        )
    else:
        raise SourceError(
            f"{name} has the transfer characteristic {transfer_code} of H.273, which is not supported; "
            "record with a BT.709 or sRGB profile."
        )
    return VideoColour(matrix, color_range, transfer, primaries, tuple(warnings))


def bit_depth(frame: VideoFrame) -> int:
    """Bits of one luma sample."""
    return int(frame.format.components[0].bits)


def plane(frame: VideoFrame, index: int) -> Pixels:
    """A view of one plane, code values [h, w], without copying; it lives as long as it is referenced."""
    data = frame.planes[index]
    dtype = np.dtype(np.uint8 if bit_depth(frame) == 8 else np.uint16)
    rows = np.frombuffer(memoryview(data), dtype)[: data.height * (data.line_size // dtype.itemsize)]
    return rows.reshape(data.height, -1)[:, : data.width]


def luma_levels(colour: VideoColour, bits: int) -> tuple[float, float]:
    """Code values of black and white in the planes of `full_scale_planes`."""
    zero, span, _, _ = _levels(colour.color_range, bits)
    shift = 0 if bits == 8 else 16 - bits
    return float(zero << shift), float((zero + span) << shift)


def full_scale_planes(frame: VideoFrame) -> tuple[Pixels, Pixels, Pixels]:
    """The Y', Cb and Cr planes, in code values; deeper than 8 bits they are shifted up to fill 16."""
    depth = bit_depth(frame)
    planes = (plane(frame, 0), plane(frame, 1), plane(frame, 2))
    if depth in (8, 16):
        return planes
    luma, blue, red = (np.left_shift(samples, 16 - depth) for samples in planes)
    return luma, blue, red


def rgb_from_frame(
    frame: VideoFrame, colour: VideoColour, reformatter: VideoReformatter | None = None
) -> Pixels:
    """Display-referred R'G'B' [H, W, 3] of a frame: uint8 for 8-bit video, else uint16 of the full scale.

    Args:
        frame: planar YUV of any subsampling.
        colour: matrix and range to use; the frame's own tags are not looked at.
        reformatter: kept between frames it saves swscale's set-up; must not be shared by threads.
    """
    if bit_depth(frame) > 8:
        return _rgb_from_deep_frame(frame, colour)
    matrix = _SWSCALE_MATRIX[colour.matrix]
    converted = (reformatter or VideoReformatter()).reformat(
        frame,
        format="rgb24",
        src_colorspace=matrix,
        dst_colorspace=matrix,
        src_color_range=RANGE_CODES[colour.color_range],
        dst_color_range=RANGE_CODES["full"],
        interpolation=_SWSCALE_EXACT,
        threads=1,
    )
    return np.asarray(converted.to_ndarray(), dtype=np.uint8)


def _rgb_from_deep_frame(frame: VideoFrame, colour: VideoColour) -> NDArray[np.uint16]:
    """R'G'B' by ITU-R BT.2020-2, tables 4 and 5 (BT.709 and BT.601 differ only in the weights)."""
    bits = bit_depth(frame)
    luma_zero, luma_span, chroma_zero, chroma_span = _levels(colour.color_range, bits)
    luma = (plane(frame, 0).astype(np.float32) - luma_zero) / luma_span
    size = (frame.width, frame.height)
    blue_difference, red_difference = (
        (_upsample_chroma(plane(frame, index), size) - chroma_zero) / chroma_span for index in (1, 2)
    )
    red_weight, blue_weight = LUMA_WEIGHTS[colour.matrix]
    red = luma + 2.0 * (1.0 - red_weight) * red_difference
    blue = luma + 2.0 * (1.0 - blue_weight) * blue_difference
    green = (luma - red_weight * red - blue_weight * blue) / (1.0 - red_weight - blue_weight)
    rgb = cv2.merge([red, green, blue])
    np.clip(rgb, 0.0, 1.0, out=rgb)
    return np.rint(rgb * np.float32(65535)).astype(np.uint16)


def _upsample_chroma(chroma: Pixels, size: tuple[int, int]) -> NDArray[np.float32]:
    """Linear interpolation to (width, height), with samples sited left, the default of H.264 and HEVC.

    Left siting: a chroma sample lies on the even luma column, and between two luma rows.
    """
    width, height = size
    rows, columns = chroma.shape
    across, down = width / columns, height / rows
    # In sample indices, x_chroma = x_luma / across (co-sited) and y_chroma = (y_luma + 0.5) / down - 0.5.
    chroma_from_luma = np.array([[1 / across, 0, 0], [0, 1 / down, 0.5 / down - 0.5]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    samples = chroma.astype(np.float32)
    return np.asarray(
        cv2.warpAffine(samples, chroma_from_luma, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    )


def fill_frame(frame: VideoFrame, rgb: NDArray[np.uint8], matrix: str, color_range: str) -> None:
    """Writes R'G'B' [H, W, 3] into a yuv420p frame of 8 bits or more: the inverse of `rgb_from_frame`.

    Computed in float32, because swscale rounds full-range chroma down and puts it between the columns, where
    no decoder looks for it.
    """
    luma_zero, luma_span, chroma_zero, chroma_span = _levels(color_range, bit_depth(frame))
    red, blue = LUMA_WEIGHTS[matrix]
    luma = np.array([red, 1.0 - red - blue, blue])
    blue_difference = (np.array([0.0, 0.0, 1.0]) - luma) / (2.0 * (1.0 - blue))
    red_difference = (np.array([1.0, 0.0, 0.0]) - luma) / (2.0 * (1.0 - red))
    spans = np.array([[luma_span], [chroma_span], [chroma_span]]) / 255.0
    yuv_from_rgb = np.hstack(
        [
            spans * np.array([luma, blue_difference, red_difference]),
            [[luma_zero], [chroma_zero], [chroma_zero]],
        ]
    )
    planes = cv2.split(cv2.transform(rgb.astype(np.float32), yuv_from_rgb))
    largest = (1 << bit_depth(frame)) - 1  # a full-range difference of +0.5 is one code beyond it
    plane(frame, 0)[:] = np.rint(planes[0])
    for index in (1, 2):
        plane(frame, index)[:] = np.minimum(np.rint(_subsample_chroma(np.asarray(planes[index]))), largest)


def _subsample_chroma(chroma: NDArray[np.float32]) -> NDArray[np.float32]:
    """Half of the rows and columns, sited left: on the even column (1 2 1), between two rows (1 1)."""
    rows = 0.5 * (chroma[0::2] + chroma[1::2])
    left = np.concatenate([rows[:, :1], rows[:, 1:-2:2]], axis=1)
    subsampled: NDArray[np.float32] = 0.25 * (left + 2.0 * rows[:, 0::2] + rows[:, 1::2])
    return subsampled


def _levels(color_range: str, bits: int) -> tuple[int, int, int, int]:
    """Luma's code of black and span to white, chroma's code of grey and span (BT.709-6, 4.6; H.273, 8.3)."""
    step = 1 << (bits - 8)
    if color_range == "full":
        return 0, (1 << bits) - 1, 128 * step, (1 << bits) - 1
    return 16 * step, 219 * step, 128 * step, 224 * step


def _require_yuv(frame: VideoFrame, name: str) -> None:
    layout = frame.format
    components = layout.components
    planar_yuv = (
        len(components) == 3
        and layout.name.startswith("yuv")
        and layout.is_planar
        and not layout.is_big_endian
        and len({component.plane for component in components}) == 3
    )
    if not planar_yuv:
        raise SourceError(
            f"{name} has the pixel format {layout.name}, which no phone records; convert it to yuv420p first."
        )


def _title(matrix: str) -> str:
    return matrix.upper().replace("BT", "BT.")
