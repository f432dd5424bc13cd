"""Layouts and numbers as a C compiler gives them for linux/videodev2.h on a 64-bit machine."""

import ctypes
import shutil
import subprocess
from pathlib import Path

import pytest

from capture.devices.v4l2 import structs

HEADER = Path("/usr/include/linux/videodev2.h")

#: struct -> (its class, sizeof, {field: offsetof})
LAYOUTS = {
    "v4l2_capability": (structs.Capability, 104, {"capabilities": 84, "device_caps": 88}),
    "v4l2_fmtdesc": (structs.FormatDescription, 64, {"description": 12, "pixelformat": 44}),
    "v4l2_frmsizeenum": (structs.FrameSize, 44, {"reserved": 36}),
    "v4l2_frmivalenum": (structs.FrameInterval, 52, {"reserved": 44}),
    "v4l2_pix_format": (
        structs.PixelFormat,
        48,
        {"pixelformat": 8, "priv": 28, "ycbcr_enc": 36, "xfer_func": 44},
    ),
    "v4l2_format": (structs.Format, 208, {"fmt": 8}),
    "v4l2_streamparm": (structs.StreamParameters, 204, {"parm": 4}),
    "v4l2_captureparm": (structs.CaptureParameters, 40, {"timeperframe": 8, "readbuffers": 20}),
    "v4l2_query_ext_ctrl": (
        structs.QueryExtControl,
        232,
        {"minimum": 40, "default_value": 64, "flags": 72, "elem_size": 76, "dims": 88},
    ),
    "v4l2_querymenu": (structs.QueryMenu, 44, {"name": 8, "reserved": 40}),
    "v4l2_ext_control": (structs.ExtControl, 20, {"size": 4, "value": 12, "value64": 12}),
    "v4l2_ext_controls": (structs.ExtControls, 32, {"count": 4, "error_idx": 8, "controls": 24}),
    "v4l2_requestbuffers": (structs.RequestBuffers, 20, {"capabilities": 12, "flags": 16}),
    "v4l2_buffer": (
        structs.Buffer,
        88,
        {"flags": 12, "timestamp": 24, "timecode": 40, "sequence": 56, "memory": 60, "m": 64, "length": 72},
    ),
    "v4l2_event_subscription": (structs.EventSubscription, 32, {"id": 4}),
    "v4l2_event": (
        structs.Event,
        136,
        {"u": 8, "pending": 72, "sequence": 76, "timestamp": 80, "id": 96},
    ),
    "v4l2_event_ctrl": (structs.EventControl, 40, {"value64": 8, "flags": 16}),
}
NUMBERS = {
    "QUERYCAP": 0x80685600,
    "ENUM_FMT": 0xC0405602,
    "G_FMT": 0xC0D05604,
    "S_FMT": 0xC0D05605,
    "REQBUFS": 0xC0145608,
    "QUERYBUF": 0xC0585609,
    "QBUF": 0xC058560F,
    "DQBUF": 0xC0585611,
    "STREAMON": 0x40045612,
    "STREAMOFF": 0x40045613,
    "G_PARM": 0xC0CC5615,
    "S_PARM": 0xC0CC5616,
    "QUERYMENU": 0xC02C5625,
    "G_EXT_CTRLS": 0xC0205647,
    "S_EXT_CTRLS": 0xC0205648,
    "ENUM_FRAMESIZES": 0xC02C564A,
    "ENUM_FRAMEINTERVALS": 0xC034564B,
    "DQEVENT": 0x80885659,
    "SUBSCRIBE_EVENT": 0x4020565A,
    "QUERY_EXT_CTRL": 0xC0E85667,
}


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_structure_is_laid_out_as_in_c(name):
    kind, size, offsets = LAYOUTS[name]
    assert ctypes.sizeof(kind) == size
    assert {field: getattr(kind, field).offset for field in offsets} == offsets


@pytest.mark.parametrize("name", NUMBERS)
def test_an_ioctl_has_its_number(name):
    assert getattr(structs, name) == NUMBERS[name]


def test_four_characters_are_a_number():
    assert structs.fourcc("YUYV") == 0x56595559
    assert structs.fourcc_name(structs.fourcc("Y10 ")) == "Y10 "
    with pytest.raises(ValueError, match="four characters"):
        structs.fourcc("YUV")


@pytest.mark.skipif(not (shutil.which("cc") and HEADER.exists()), reason="no C compiler or kernel headers")
def test_the_compiler_agrees(tmp_path):
    lines, expected = [], []
    for name, (kind, _, offsets) in LAYOUTS.items():
        lines.append(f"sizeof(struct {name})")
        expected.append(ctypes.sizeof(kind))
        for field in offsets:
            lines.append(f"offsetof(struct {name}, {field})")
            expected.append(getattr(kind, field).offset)
    for name in NUMBERS:
        lines.append(f"VIDIOC_{name}")
        expected.append(getattr(structs, name))
    constants = [
        name
        for name in vars(structs)
        if name.split("_")[0] in ("CAP", "BUF", "CTRL", "CID", "EVENT", "COLORSPACE", "YCBCR")
        or name.startswith(("QUANTIZATION_", "XFER_", "FIELD_", "MEMORY_", "EXPOSURE_"))
    ]
    for name in constants:
        lines.append(f"V4L2_{name}")
        expected.append(getattr(structs, name))
    source = "#include <stdio.h>\n#include <stddef.h>\n#include <linux/videodev2.h>\nint main(void) {\n"
    source += "".join(f'printf("%lu\\n", (unsigned long)({line}));\n' for line in lines) + "return 0; }\n"
    (tmp_path / "layout.c").write_text(source)
    program = tmp_path / "layout"
    subprocess.run(["cc", "-o", program, tmp_path / "layout.c"], check=True)
    printed = subprocess.run([program], check=True, capture_output=True, text=True).stdout.split()
    wrong = {
        line: (int(c), ours) for line, c, ours in zip(lines, printed, expected, strict=True) if int(c) != ours
    }
    assert not wrong
    assert len(constants) > 60
