"""Which mode a capture takes, and what a driver's colour fields mean."""

import pytest

from capture.devices.camera import CameraProfile
from capture.devices.v4l2 import structs as v4l2
from capture.devices.v4l2.choice import choose_mode, stream_format
from capture.devices.v4l2.node import Mode
from capture.errors import CameraError

USB2 = (
    Mode("YUYV", 640, 480, (30.0, 15.0)),
    Mode("YUYV", 1280, 720, (10.0, 5.0)),
    Mode("YUYV", 1920, 1080, (5.0,)),
    Mode("MJPG", 640, 480, (30.0,)),
    Mode("MJPG", 1280, 720, (30.0, 24.0)),
    Mode("MJPG", 1920, 1080, (30.0,)),
    Mode("H264", 1920, 1080, (30.0,)),
)
USB3 = (*USB2, Mode("NV12", 1920, 1080, (60.0, 30.0)), Mode("NV12", 3840, 2160, (30.0,)))


def choose(modes, **profile):
    choice = choose_mode(modes, CameraProfile(**profile), "/dev/video0")
    return (choice.mode.pixel_format, choice.mode.width, choice.mode.height, choice.fps), choice.warnings


def test_uncompressed_is_taken_where_it_is_fast_enough_at_a_useful_size():
    assert choose(USB3) == (("NV12", 1920, 1080, 30.0), ())
    assert choose((*USB3, Mode("YUYV", 1280, 720, (30.0,))))[0] == ("YUYV", 1280, 720, 30.0)


def test_motion_jpeg_is_taken_where_uncompressed_is_slow():
    assert choose(USB2) == (("MJPG", 1920, 1080, 30.0), ())


def test_a_low_rate_that_is_asked_for_may_be_uncompressed():
    assert choose(USB2, fps=10) == (("YUYV", 1280, 720, 10), ())


def test_a_size_that_is_asked_for_is_taken_in_the_best_format_that_is_fast():
    assert choose(USB2, width=640, height=480)[0] == ("YUYV", 640, 480, 30.0)
    assert choose(USB2, width=1280, height=720)[0] == ("MJPG", 1280, 720, 30.0)
    assert choose(USB2, width=1280, height=720, pixel_format="YUYV")[0] == ("YUYV", 1280, 720, 10.0)


def test_what_cannot_be_had_is_said():
    chosen, warnings = choose(USB2, width=800, height=600)
    assert chosen[:3] == ("YUYV", 640, 480)
    assert "no pictures of 800 x 600" in warnings[0]
    chosen, warnings = choose(USB2, width=1280, height=720, pixel_format="YUYV", fps=30)
    assert "10 frames a second at most, not 30" in warnings[0]


def test_small_cameras_give_their_largest_fast_picture():
    modes = (Mode("YUYV", 320, 240, (30.0,)), Mode("YUYV", 640, 480, (25.0,)), Mode("YUYV", 800, 600, (5.0,)))
    assert choose(modes)[0] == ("YUYV", 640, 480, 25.0)
    assert choose((Mode("YUYV", 320, 240, (5.0,)), Mode("GREY", 320, 240, (7.5,))))[0][3] == 7.5


def test_raw_is_taken_only_where_it_is_asked_for():
    modes = (Mode("RG10", 1920, 1080, (30.0,)), Mode("YUYV", 640, 480, (30.0,)))
    assert choose(modes)[0][0] == "YUYV"
    assert choose(modes, pixel_format="RG10")[0] == ("RG10", 1920, 1080, 30.0)
    with pytest.raises(CameraError, match=r"ask for one of its raw formats \(RG10\)"):
        choose(modes[:1])


def test_a_driver_that_lists_no_rates_or_ranges_of_sizes_is_served():
    assert choose((Mode("YUYV", 1280, 720, ()),))[0] == ("YUYV", 1280, 720, None)
    ranged = (Mode("YUYV", 1920, 1200, (60.0,), stepwise=True),)
    assert choose(ranged, width=1280, height=720, fps=25)[0] == ("YUYV", 1280, 720, 25)


@pytest.mark.parametrize("name", ["H264", "NV12"])
def test_a_format_that_it_has_not_or_that_nobody_can_read_is_an_error(name):
    with pytest.raises(CameraError, match=rf"cannot give {name} pictures; it has YUYV, MJPG, H264"):
        choose(USB2, pixel_format=name)


@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        # linux/videodev2.h, V4L2_MAP_*_DEFAULT: sRGB is BT.601 limited with sRGB's curve.
        ({"colorspace": v4l2.COLORSPACE_SRGB}, ("bt601", False, "srgb")),
        ({"colorspace": v4l2.COLORSPACE_REC709}, ("bt709", False, "rec709")),
        ({"colorspace": v4l2.COLORSPACE_SMPTE170M}, ("bt601", False, "rec709")),
        ({"colorspace": v4l2.COLORSPACE_JPEG}, ("bt601", True, "srgb")),
        ({"colorspace": v4l2.COLORSPACE_RAW}, ("bt601", False, "linear")),
        ({"colorspace": 0}, ("bt601", False, "srgb")),
        (
            {
                "colorspace": v4l2.COLORSPACE_SRGB,
                "ycbcr_enc": v4l2.YCBCR_ENC_709,
                "quantization": v4l2.QUANTIZATION_FULL_RANGE,
                "xfer_func": v4l2.XFER_FUNC_709,
            },
            ("bt709", True, "rec709"),
        ),
    ],
)
def test_colour_fields_are_read_as_the_header_says(fields, expected):
    pix = v4l2.PixelFormat(width=64, height=48, pixelformat=v4l2.fourcc("YUYV"), bytesperline=128, **fields)
    format = stream_format(pix, 30.0)
    assert (format.matrix, format.full_range, format.transfer) == expected
    assert format.stride_bytes == 128


def test_jpeg_is_full_range_and_raw_is_linear_whatever_the_driver_says():
    jpeg = v4l2.PixelFormat(
        width=64, height=48, pixelformat=v4l2.fourcc("MJPG"), bytesperline=64, colorspace=8
    )
    assert stream_format(jpeg, None).full_range
    assert stream_format(jpeg, None).stride_bytes == 0
    raw = v4l2.PixelFormat(width=64, height=48, pixelformat=v4l2.fourcc("RG10"), colorspace=8)
    assert stream_format(raw, None).transfer == "linear"
