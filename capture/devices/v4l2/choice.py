"""Which of a camera's modes a capture takes, and how the pictures of a format are meant."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

from capture.devices.camera import CameraProfile, StreamFormat
from capture.devices.pixel_formats import JPEG_FORMATS, KNOWN_FORMATS, RAW_FORMATS, YUV_FORMATS
from capture.devices.v4l2 import structs as v4l2
from capture.devices.v4l2.node import Mode
from capture.errors import CameraError

#: Rate that is wished where the profile names none, and what still does.
_WISHED_FPS, _LEAST_FPS = 30.0, 24.0
#: A picture from here on shows a head well; beyond the larger, writing it costs more than it shows.
_USEFUL_PIXELS, _LARGEST_PIXELS = 1280 * 720, 1920 * 1088
#: Cameras round 30 to 29.97 and the like.
_SAME_RATE = 0.98


@dataclass(frozen=True)
class Choice:
    """A mode and what was said for it.

    Attributes:
        mode: With the size that is to be set.
        fps: Rate to ask for; None = the driver lists none, and none was asked for.
        warnings: Where it is not what was asked.
    """

    mode: Mode
    fps: float | None
    warnings: tuple[str, ...] = ()


def choose_mode(modes: Iterable[Mode], profile: CameraProfile, path: str) -> Choice:
    """The mode for a profile: uncompressed where it is fast enough at a useful size, else Motion-JPEG.

    Raises:
        CameraError: The camera has no mode of the format that was asked for, or none that can be decoded.
    """
    offered = tuple(modes)
    usable = _usable(offered, profile.pixel_format, path)
    wished = profile.fps or _LEAST_FPS
    if profile.width is not None and profile.height is not None:
        return _of_size(usable, profile, profile.width, profile.height)
    useful = [mode for mode in usable if _fast(mode, wished) and _pixels(mode) >= _USEFUL_PIXELS]
    moderate = [mode for mode in useful if _pixels(mode) <= _LARGEST_PIXELS]
    for fitting in (moderate, useful):
        for kind in (_is_uncompressed, _is_jpeg, _is_other):
            if among := [mode for mode in fitting if kind(mode)]:
                # Uncompressed frames are compressed by us, without loss, at a cost that grows with them.
                largest = kind is _is_jpeg and fitting is moderate
                return _choice((max if largest else min)(among, key=_pixels), profile)
    fast = [mode for mode in usable if _fast(mode, wished)]
    if fast:
        return _choice(max(fast, key=lambda mode: (_pixels(mode), _is_uncompressed(mode))), profile)
    fastest = max(usable, key=lambda mode: (max(mode.rates, default=0.0), _pixels(mode)))
    return _choice(fastest, profile)


def stream_format(pix: v4l2.PixelFormat, fps: float | None) -> StreamFormat:
    """What the driver's answer means (linux/videodev2.h: V4L2_MAP_YCBCR_ENC_DEFAULT and its kin)."""
    name = v4l2.fourcc_name(pix.pixelformat)
    space = pix.colorspace
    encoding = pix.ycbcr_enc
    if encoding == v4l2.YCBCR_ENC_DEFAULT:
        of_709 = space in (v4l2.COLORSPACE_REC709, v4l2.COLORSPACE_DCI_P3)
        encoding = v4l2.YCBCR_ENC_709 if of_709 else v4l2.YCBCR_ENC_601
    quantization = pix.quantization
    if quantization == v4l2.QUANTIZATION_DEFAULT:
        full = space == v4l2.COLORSPACE_JPEG
    else:
        full = quantization == v4l2.QUANTIZATION_FULL_RANGE
    return StreamFormat(
        width=pix.width,
        height=pix.height,
        pixel_format=name,
        fps=fps,
        transfer="linear" if name in RAW_FORMATS else _transfer(pix.xfer_func, space),
        matrix="bt709" if encoding in (v4l2.YCBCR_ENC_709, v4l2.YCBCR_ENC_XV709) else "bt601",
        full_range=full or name in JPEG_FORMATS,
        stride_bytes=0 if name in JPEG_FORMATS else pix.bytesperline,
    )


def _transfer(function: int, space: int) -> str:
    if function == v4l2.XFER_FUNC_DEFAULT:
        function = {
            v4l2.COLORSPACE_OPRGB: v4l2.XFER_FUNC_OPRGB,
            v4l2.COLORSPACE_SRGB: v4l2.XFER_FUNC_SRGB,
            v4l2.COLORSPACE_JPEG: v4l2.XFER_FUNC_SRGB,
            0: v4l2.XFER_FUNC_SRGB,  # the driver does not say; webcams mean sRGB
            v4l2.COLORSPACE_RAW: v4l2.XFER_FUNC_NONE,
        }.get(space, v4l2.XFER_FUNC_709)
    return {
        v4l2.XFER_FUNC_SRGB: "srgb",
        v4l2.XFER_FUNC_OPRGB: "gamma:2.2",
        v4l2.XFER_FUNC_NONE: "linear",
    }.get(function, "rec709")


def _usable(offered: tuple[Mode, ...], pixel_format: str | None, path: str) -> list[Mode]:
    names = list(dict.fromkeys(mode.pixel_format for mode in offered))
    listed = ", ".join(names) or "none at all"
    if pixel_format is not None:
        usable = [mode for mode in offered if mode.pixel_format == pixel_format]
        if not usable or pixel_format not in KNOWN_FORMATS:
            raise CameraError(f"{path} cannot give {pixel_format} pictures; it has {listed}.")
        return usable
    # Raw needs a black level and a white balance that a camera's driver does not give: only where asked.
    usable = [mode for mode in offered if mode.pixel_format in KNOWN_FORMATS - RAW_FORMATS]
    if not usable:
        raw = [name for name in names if name in RAW_FORMATS]
        advice = f"; ask for one of its raw formats ({', '.join(raw)}) by name" if raw else ""
        raise CameraError(f"{path} has no pixel format that can be decoded, only {listed}{advice}.")
    return usable


def _of_size(usable: list[Mode], profile: CameraProfile, width: int, height: int) -> Choice:
    exact = [mode for mode in usable if (mode.width, mode.height) == (width, height)]
    ranged = [mode for mode in usable if mode.stepwise and mode.width >= width and mode.height >= height]
    exact += [replace(mode, width=width, height=height) for mode in ranged]
    warnings: tuple[str, ...] = ()
    if not exact:
        nearest = min(usable, key=lambda mode: abs(mode.width - width) + abs(mode.height - height))
        exact = [mode for mode in usable if (mode.width, mode.height) == (nearest.width, nearest.height)]
        sizes = ", ".join(dict.fromkeys(f"{mode.width}x{mode.height}" for mode in usable))
        warnings = (
            f"The camera has no pictures of {width} x {height}; {nearest.width} x {nearest.height} is the "
            f"nearest (it has {sizes}).",
        )
    wished = profile.fps or _LEAST_FPS
    fast = [mode for mode in exact if _fast(mode, wished)]
    for kind in (_is_uncompressed, _is_jpeg, _is_other):
        if among := [mode for mode in fast if kind(mode)]:
            return _choice(among[0], profile, warnings)
    return _choice(max(exact, key=lambda mode: max(mode.rates, default=0.0)), profile, warnings)


def _choice(mode: Mode, profile: CameraProfile, warnings: tuple[str, ...] = ()) -> Choice:
    wished = profile.fps or _WISHED_FPS
    if not mode.rates:
        return Choice(mode, profile.fps, warnings)
    reached = [rate for rate in mode.rates if rate >= wished * _SAME_RATE]
    fps = min(reached) if reached else max(mode.rates)
    if profile.fps is not None and fps < profile.fps * _SAME_RATE:
        warnings += (
            f"The camera gives {mode.width} x {mode.height} {mode.pixel_format} at {fps:g} frames a "
            f"second at most, not {profile.fps:g}; a smaller picture or MJPG may be faster.",
        )
    return Choice(mode, profile.fps or fps, warnings)


def _fast(mode: Mode, fps: float) -> bool:
    return not mode.rates or max(mode.rates) >= fps * _SAME_RATE


def _pixels(mode: Mode) -> int:
    return mode.width * mode.height


def _is_uncompressed(mode: Mode) -> bool:
    return mode.pixel_format in YUV_FORMATS or mode.pixel_format in ("RGB3", "BGR3")


def _is_jpeg(mode: Mode) -> bool:
    return mode.pixel_format in JPEG_FORMATS


def _is_other(mode: Mode) -> bool:
    return not _is_uncompressed(mode) and not _is_jpeg(mode)
