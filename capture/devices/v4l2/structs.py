"""The part of linux/videodev2.h that a camera needs: structures, ioctl numbers, control ids, flags.

Layouts are those of 64-bit Linux (the fields of x86-64 and AArch64 agree); the tests hold sizes, offsets and
numbers against what a C compiler makes of the header. Names are the header's, without their V4L2 prefix where
nothing is lost.
"""

from __future__ import annotations

import ctypes
from ctypes import c_char, c_int32, c_int64, c_long, c_uint8, c_uint32, c_uint64, c_void_p

# ----------------------------------------------------------------------------------------- structures


class Capability(ctypes.Structure):
    """struct v4l2_capability."""

    _fields_ = [
        ("driver", c_char * 16),
        ("card", c_char * 32),
        ("bus_info", c_char * 32),
        ("version", c_uint32),
        ("capabilities", c_uint32),
        ("device_caps", c_uint32),
        ("reserved", c_uint32 * 3),
    ]


class FormatDescription(ctypes.Structure):
    """struct v4l2_fmtdesc."""

    _fields_ = [
        ("index", c_uint32),
        ("type", c_uint32),
        ("flags", c_uint32),
        ("description", c_char * 32),
        ("pixelformat", c_uint32),
        ("mbus_code", c_uint32),
        ("reserved", c_uint32 * 3),
    ]


class Fraction(ctypes.Structure):
    """struct v4l2_fract."""

    _fields_ = [("numerator", c_uint32), ("denominator", c_uint32)]


class FrameSizeStepwise(ctypes.Structure):
    """struct v4l2_frmsize_stepwise; a discrete size is its first two fields, width and height."""

    _fields_ = [
        ("min_width", c_uint32),
        ("max_width", c_uint32),
        ("step_width", c_uint32),
        ("min_height", c_uint32),
        ("max_height", c_uint32),
        ("step_height", c_uint32),
    ]


class FrameSize(ctypes.Structure):
    """struct v4l2_frmsizeenum."""

    _fields_ = [
        ("index", c_uint32),
        ("pixel_format", c_uint32),
        ("type", c_uint32),
        ("size", FrameSizeStepwise),
        ("reserved", c_uint32 * 2),
    ]


class FrameIntervalStepwise(ctypes.Structure):
    """struct v4l2_frmival_stepwise; a discrete interval is its first field."""

    _fields_ = [("min", Fraction), ("max", Fraction), ("step", Fraction)]


class FrameInterval(ctypes.Structure):
    """struct v4l2_frmivalenum."""

    _fields_ = [
        ("index", c_uint32),
        ("pixel_format", c_uint32),
        ("width", c_uint32),
        ("height", c_uint32),
        ("type", c_uint32),
        ("interval", FrameIntervalStepwise),
        ("reserved", c_uint32 * 2),
    ]


class PixelFormat(ctypes.Structure):
    """struct v4l2_pix_format."""

    _fields_ = [
        ("width", c_uint32),
        ("height", c_uint32),
        ("pixelformat", c_uint32),
        ("field", c_uint32),
        ("bytesperline", c_uint32),
        ("sizeimage", c_uint32),
        ("colorspace", c_uint32),
        ("priv", c_uint32),
        ("flags", c_uint32),
        ("ycbcr_enc", c_uint32),
        ("quantization", c_uint32),
        ("xfer_func", c_uint32),
    ]


class _FormatUnion(ctypes.Union):
    # struct v4l2_window has pointers, so the union is aligned as one.
    _fields_ = [("pix", PixelFormat), ("raw_data", c_uint8 * 200), ("aligned", c_void_p)]


class Format(ctypes.Structure):
    """struct v4l2_format."""

    _fields_ = [("type", c_uint32), ("fmt", _FormatUnion)]


class CaptureParameters(ctypes.Structure):
    """struct v4l2_captureparm."""

    _fields_ = [
        ("capability", c_uint32),
        ("capturemode", c_uint32),
        ("timeperframe", Fraction),
        ("extendedmode", c_uint32),
        ("readbuffers", c_uint32),
        ("reserved", c_uint32 * 4),
    ]


class _StreamUnion(ctypes.Union):
    _fields_ = [("capture", CaptureParameters), ("raw_data", c_uint8 * 200)]


class StreamParameters(ctypes.Structure):
    """struct v4l2_streamparm."""

    _fields_ = [("type", c_uint32), ("parm", _StreamUnion)]


class QueryExtControl(ctypes.Structure):
    """struct v4l2_query_ext_ctrl."""

    _fields_ = [
        ("id", c_uint32),
        ("type", c_uint32),
        ("name", c_char * 32),
        ("minimum", c_int64),
        ("maximum", c_int64),
        ("step", c_uint64),
        ("default_value", c_int64),
        ("flags", c_uint32),
        ("elem_size", c_uint32),
        ("elems", c_uint32),
        ("nr_of_dims", c_uint32),
        ("dims", c_uint32 * 4),
        ("reserved", c_uint32 * 32),
    ]


class QueryMenu(ctypes.Structure):
    """struct v4l2_querymenu (packed); `name` begins where the 64-bit value of an integer menu does."""

    _pack_ = 1
    _fields_ = [
        ("id", c_uint32),
        ("index", c_uint32),
        ("name", c_char * 32),
        ("reserved", c_uint32),
    ]


class _ControlValue(ctypes.Union):
    _pack_ = 1
    _fields_ = [("value", c_int32), ("value64", c_int64), ("pointer", c_void_p)]


class ExtControl(ctypes.Structure):
    """struct v4l2_ext_control (packed)."""

    _pack_ = 1
    _anonymous_ = ("u",)
    _fields_ = [("id", c_uint32), ("size", c_uint32), ("reserved2", c_uint32), ("u", _ControlValue)]


class ExtControls(ctypes.Structure):
    """struct v4l2_ext_controls."""

    _fields_ = [
        ("which", c_uint32),
        ("count", c_uint32),
        ("error_idx", c_uint32),
        ("request_fd", c_int32),
        ("reserved", c_uint32),
        ("controls", ctypes.POINTER(ExtControl)),
    ]


class RequestBuffers(ctypes.Structure):
    """struct v4l2_requestbuffers."""

    _fields_ = [
        ("count", c_uint32),
        ("type", c_uint32),
        ("memory", c_uint32),
        ("capabilities", c_uint32),
        ("flags", c_uint8),
        ("reserved", c_uint8 * 3),
    ]


class TimeValue(ctypes.Structure):
    """struct timeval."""

    _fields_ = [("tv_sec", c_long), ("tv_usec", c_long)]


class TimeCode(ctypes.Structure):
    """struct v4l2_timecode."""

    _fields_ = [
        ("type", c_uint32),
        ("flags", c_uint32),
        ("frames", c_uint8),
        ("seconds", c_uint8),
        ("minutes", c_uint8),
        ("hours", c_uint8),
        ("userbits", c_uint8 * 4),
    ]


class _BufferMemory(ctypes.Union):
    _fields_ = [("offset", c_uint32), ("userptr", ctypes.c_ulong), ("planes", c_void_p), ("fd", c_int32)]


class Buffer(ctypes.Structure):
    """struct v4l2_buffer."""

    _fields_ = [
        ("index", c_uint32),
        ("type", c_uint32),
        ("bytesused", c_uint32),
        ("flags", c_uint32),
        ("field", c_uint32),
        ("timestamp", TimeValue),
        ("timecode", TimeCode),
        ("sequence", c_uint32),
        ("memory", c_uint32),
        ("m", _BufferMemory),
        ("length", c_uint32),
        ("reserved2", c_uint32),
        ("request_fd", c_int32),
    ]


class EventSubscription(ctypes.Structure):
    """struct v4l2_event_subscription."""

    _fields_ = [("type", c_uint32), ("id", c_uint32), ("flags", c_uint32), ("reserved", c_uint32 * 5)]


class EventControl(ctypes.Structure):
    """struct v4l2_event_ctrl."""

    class _Value(ctypes.Union):
        _fields_ = [("value", c_int32), ("value64", c_int64)]

    _anonymous_ = ("u",)
    _fields_ = [
        ("changes", c_uint32),
        ("type", c_uint32),
        ("u", _Value),
        ("flags", c_uint32),
        ("minimum", c_int32),
        ("maximum", c_int32),
        ("step", c_int32),
        ("default_value", c_int32),
    ]


class _EventUnion(ctypes.Union):
    _fields_ = [("ctrl", EventControl), ("data", c_uint8 * 64)]


class TimeSpec(ctypes.Structure):
    """struct timespec."""

    _fields_ = [("tv_sec", c_long), ("tv_nsec", c_long)]


class Event(ctypes.Structure):
    """struct v4l2_event."""

    _fields_ = [
        ("type", c_uint32),
        ("u", _EventUnion),
        ("pending", c_uint32),
        ("sequence", c_uint32),
        ("timestamp", TimeSpec),
        ("id", c_uint32),
        ("reserved", c_uint32 * 8),
    ]


# -------------------------------------------------------------------------------------- ioctl numbers

_WRITE, _READ = 1, 2  # asm-generic/ioctl.h: direction in bits 30..31, size in 16..29


def _number(direction: int, number: int, argument: type[ctypes._CData]) -> int:
    return direction << 30 | ctypes.sizeof(argument) << 16 | ord("V") << 8 | number


QUERYCAP = _number(_READ, 0, Capability)
ENUM_FMT = _number(_READ | _WRITE, 2, FormatDescription)
G_FMT = _number(_READ | _WRITE, 4, Format)
S_FMT = _number(_READ | _WRITE, 5, Format)
REQBUFS = _number(_READ | _WRITE, 8, RequestBuffers)
QUERYBUF = _number(_READ | _WRITE, 9, Buffer)
QBUF = _number(_READ | _WRITE, 15, Buffer)
DQBUF = _number(_READ | _WRITE, 17, Buffer)
STREAMON = _number(_WRITE, 18, c_int32)
STREAMOFF = _number(_WRITE, 19, c_int32)
G_PARM = _number(_READ | _WRITE, 21, StreamParameters)
S_PARM = _number(_READ | _WRITE, 22, StreamParameters)
QUERYMENU = _number(_READ | _WRITE, 37, QueryMenu)
G_EXT_CTRLS = _number(_READ | _WRITE, 71, ExtControls)
S_EXT_CTRLS = _number(_READ | _WRITE, 72, ExtControls)
ENUM_FRAMESIZES = _number(_READ | _WRITE, 74, FrameSize)
ENUM_FRAMEINTERVALS = _number(_READ | _WRITE, 75, FrameInterval)
DQEVENT = _number(_READ, 89, Event)
SUBSCRIBE_EVENT = _number(_WRITE, 90, EventSubscription)
QUERY_EXT_CTRL = _number(_READ | _WRITE, 103, QueryExtControl)

# ------------------------------------------------------------------------------------------- constants

BUF_TYPE_VIDEO_CAPTURE = 1
MEMORY_MMAP = 1
FIELD_ANY, FIELD_NONE = 0, 1

CAP_VIDEO_CAPTURE = 0x1
CAP_VIDEO_CAPTURE_MPLANE = 0x1000
CAP_STREAMING = 0x4000000
CAP_DEVICE_CAPS = 0x80000000
CAP_TIMEPERFRAME = 0x1000

FRMSIZE_DISCRETE, FRMIVAL_DISCRETE = 1, 1

BUF_FLAG_ERROR = 0x40
BUF_FLAG_TIMESTAMP_MASK, BUF_FLAG_TIMESTAMP_MONOTONIC, BUF_FLAG_TIMESTAMP_COPY = 0xE000, 0x2000, 0x4000
BUF_FLAG_TSTAMP_SRC_MASK, BUF_FLAG_TSTAMP_SRC_EOF, BUF_FLAG_TSTAMP_SRC_SOE = 0x70000, 0x0, 0x10000

CTRL_FLAG_DISABLED = 0x1
CTRL_FLAG_GRABBED = 0x2
CTRL_FLAG_READ_ONLY = 0x4
CTRL_FLAG_INACTIVE = 0x10
CTRL_FLAG_WRITE_ONLY = 0x40
CTRL_FLAG_VOLATILE = 0x80
CTRL_FLAG_HAS_PAYLOAD = 0x100
CTRL_FLAG_NEXT_CTRL = 0x80000000

CTRL_TYPE_INTEGER, CTRL_TYPE_BOOLEAN, CTRL_TYPE_MENU, CTRL_TYPE_BUTTON = 1, 2, 3, 4
CTRL_TYPE_INTEGER64, CTRL_TYPE_CTRL_CLASS, CTRL_TYPE_STRING, CTRL_TYPE_BITMASK = 5, 6, 7, 8
CTRL_TYPE_INTEGER_MENU = 9

EVENT_CTRL = 3
EVENT_CTRL_CH_VALUE, EVENT_CTRL_CH_FLAGS = 0x1, 0x2

COLORSPACE_SMPTE170M, COLORSPACE_SMPTE240M, COLORSPACE_REC709 = 1, 2, 3
COLORSPACE_JPEG, COLORSPACE_SRGB, COLORSPACE_OPRGB = 7, 8, 9
COLORSPACE_BT2020, COLORSPACE_RAW, COLORSPACE_DCI_P3 = 10, 11, 12
YCBCR_ENC_DEFAULT, YCBCR_ENC_601, YCBCR_ENC_709, YCBCR_ENC_XV601, YCBCR_ENC_XV709 = 0, 1, 2, 3, 4
QUANTIZATION_DEFAULT, QUANTIZATION_FULL_RANGE, QUANTIZATION_LIM_RANGE = 0, 1, 2
XFER_FUNC_DEFAULT, XFER_FUNC_709, XFER_FUNC_SRGB, XFER_FUNC_OPRGB, XFER_FUNC_NONE = 0, 1, 2, 3, 5

CID_BRIGHTNESS = 0x980900
CID_CONTRAST = 0x980901
CID_SATURATION = 0x980902
CID_HUE = 0x980903
CID_AUTO_WHITE_BALANCE = 0x98090C
CID_GAMMA = 0x980910
CID_AUTOGAIN = 0x980912
CID_GAIN = 0x980913
CID_POWER_LINE_FREQUENCY = 0x980918
CID_HUE_AUTO = 0x980919
CID_WHITE_BALANCE_TEMPERATURE = 0x98091A
CID_SHARPNESS = 0x98091B
CID_BACKLIGHT_COMPENSATION = 0x98091C
CID_CHROMA_AGC = 0x98091D
CID_COLORFX = 0x98091F
CID_AUTOBRIGHTNESS = 0x980920
CID_EXPOSURE_AUTO = 0x9A0901
CID_EXPOSURE_ABSOLUTE = 0x9A0902
CID_EXPOSURE_AUTO_PRIORITY = 0x9A0903
CID_FOCUS_ABSOLUTE = 0x9A090A
CID_FOCUS_AUTO = 0x9A090C
CID_AUTO_N_PRESET_WHITE_BALANCE = 0x9A0914
CID_WIDE_DYNAMIC_RANGE = 0x9A0915
CID_IMAGE_STABILIZATION = 0x9A0916
CID_ISO_SENSITIVITY_AUTO = 0x9A0918
CID_SCENE_MODE = 0x9A091A
CID_ANALOGUE_GAIN = 0x9E0903

#: Of CID_EXPOSURE_AUTO. What UVC cameras call automatic is mostly aperture priority: exposure time and gain.
EXPOSURE_AUTO, EXPOSURE_MANUAL, EXPOSURE_SHUTTER_PRIORITY, EXPOSURE_APERTURE_PRIORITY = 0, 1, 2, 3


def fourcc(name: str) -> int:
    """The number of a pixel format's four characters.

    Raises:
        ValueError: Not four characters of ASCII.
    """
    if len(name) != 4 or not name.isascii():
        raise ValueError(f"The pixel format {name!r} does not have four characters.")
    return int.from_bytes(name.encode("ascii"), "little")


def fourcc_name(number: int) -> str:
    """The four characters of a pixel format's number; big-endian formats' last bit is left out."""
    return (number & 0x7FFFFFFF).to_bytes(4, "little").decode("latin-1")
