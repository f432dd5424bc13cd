"""Camera frames as pictures: golden values, a plain float reference, and whatever a cable does to bytes."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from capture.devices.camera import StreamFormat
from capture.devices.motion_jpeg import complete_jpeg, strip_huffman_tables
from capture.devices.pixel_formats import (
    KNOWN_FORMATS,
    FrameDataError,
    decode_rgb,
    frame_bytes,
    luma_levels,
    picture_file,
    small_planes,
)
from capture.image_header import header_size
from capture.images import decode_image
from capture.tagging import ProfileAccumulator

CODED = {"MJPG", "JPEG"}
BAYER = {"RGGB": "RGGB", "BA81": "BGGR", "GRBG": "GRBG", "GBRG": "GBRG"}


def stream(name, width=8, height=6, **rest):
    return StreamFormat(width=width, height=height, pixel_format=name, fps=None, **rest)


def noise(format, seed=0):
    return np.random.default_rng(seed).integers(0, 256, frame_bytes(format), dtype=np.uint8).tobytes()


def jpeg(rgb, quality=95):
    return cv2.imencode(".jpg", rgb[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


def smooth_picture(width, height):
    y, x = np.mgrid[0:height, 0:width] / [[[height]], [[width]]]
    return np.rint(255 * np.stack([x, y, 1 - x * y], axis=-1)).astype(np.uint8)


def reference_rgb(luma, blue, red, matrix, full_range):
    """ITU-R BT.601-7 / BT.709-6 in float64, from planes at full size."""
    kr, kb = {"bt601": (0.299, 0.114), "bt709": (0.2126, 0.0722)}[matrix]
    black, luma_span, chroma_span = (0, 255, 255) if full_range else (16, 219, 224)
    y, b, r = (
        (luma.astype(float) - black) / luma_span,
        (blue - 128.0) / chroma_span,
        (red - 128.0) / chroma_span,
    )
    rgb = [y + 2 * (1 - kr) * r, None, y + 2 * (1 - kb) * b]
    rgb[1] = (y - kr * rgb[0] - kb * rgb[2]) / (1 - kr - kb)
    return 255 * np.clip(np.stack(rgb, axis=-1), 0, 1)


def centred_upsample(samples, size, axis):
    """Linear interpolation of samples that lie in the middle of two pixels each."""
    at = (np.arange(size) + 0.5) / 2 - 0.5
    place = np.arange(samples.shape[axis])
    return np.apply_along_axis(lambda line: np.interp(at, place, line), axis, samples.astype(float))


@pytest.mark.parametrize(
    ("code", "matrix", "full_range", "rgb"),
    [
        # BT.709-6 and BT.601-7 colour bars of full saturation, computed by hand from the formulas.
        ((16, 128, 128), "bt601", False, (0, 0, 0)),
        ((235, 128, 128), "bt601", False, (255, 255, 255)),
        ((81, 90, 240), "bt601", False, (254, 0, 0)),
        ((145, 54, 34), "bt601", False, (0, 255, 1)),
        ((41, 240, 110), "bt601", False, (0, 0, 255)),
        ((63, 102, 240), "bt709", False, (255, 1, 0)),
        ((76, 85, 255), "bt601", True, (254, 0, 0)),
        ((128, 128, 128), "bt709", True, (128, 128, 128)),
    ],
)
def test_known_codes_give_known_colours(code, matrix, full_range, rgb):
    y, u, v = code
    format = stream("YUYV", 4, 2, matrix=matrix, full_range=full_range)
    picture = decode_rgb(bytes((y, u, y, v)) * 4, format)
    assert (picture == rgb).all(), picture[0, 0]


@pytest.mark.parametrize("matrix", ["bt601", "bt709"])
@pytest.mark.parametrize("full_range", [False, True])
@pytest.mark.parametrize(("width", "height"), [(8, 6), (70, 71), (6, 100)])
def test_packed_frames_are_correctly_rounded_to_the_float_reference(matrix, full_range, width, height):
    format = stream("YUYV", width, height, matrix=matrix, full_range=full_range)
    data = noise(format)
    raw = np.frombuffer(data, np.uint8).reshape(height, width // 2, 4)
    blue, red = (centred_upsample(raw[:, :, place], width, 1) for place in (1, 3))
    expected = reference_rgb(raw[:, :, ::2].reshape(height, width), blue, red, matrix, full_range)
    # Half a code of rounding, and 1e-3 for float32 where the exact value is half-way.
    assert np.abs(decode_rgb(data, format) - expected).max() <= 0.5 + 1e-3


@pytest.mark.parametrize(("width", "height"), [(8, 6), (34, 68), (30, 130)])
def test_nv12_chroma_lies_between_the_pixels_in_both_directions(width, height):
    format = stream("NV12", width, height)
    data = noise(format)
    raw = np.frombuffer(data, np.uint8)
    luma = raw[: width * height].reshape(height, width)
    chroma = raw[width * height :].reshape(height // 2, width // 2, 2)
    blue, red = (
        centred_upsample(centred_upsample(chroma[:, :, place], width, 1), height, 0) for place in (0, 1)
    )
    expected = reference_rgb(luma, blue, red, "bt601", False)
    assert np.abs(decode_rgb(data, format) - expected).max() <= 0.5 + 1e-3  # as above


def test_orders_of_the_same_samples_give_the_same_picture():
    width, height = 12, 10
    rng = np.random.default_rng(1)
    luma = rng.integers(0, 256, (height, width), dtype=np.uint8)
    blue, red = rng.integers(0, 256, (2, height, width // 2), dtype=np.uint8)
    orders = {"YUYV": (0, 1, 3), "UYVY": (1, 0, 2), "YVYU": (0, 3, 1), "VYUY": (1, 2, 0)}
    pictures = []
    for name, (y, u, v) in orders.items():
        packed = np.empty((height, width // 2, 4), np.uint8)
        packed[:, :, y], packed[:, :, y + 2], packed[:, :, u], packed[:, :, v] = (
            luma[:, ::2],
            luma[:, 1::2],
            blue,
            red,
        )
        pictures.append(decode_rgb(packed.tobytes(), stream(name, width, height)))
    pairs = np.stack([blue, red], axis=-1)
    pictures += [
        decode_rgb(luma.tobytes() + pairs.tobytes(), stream("NV16", width, height)),
        decode_rgb(luma.tobytes() + pairs[:, :, ::-1].tobytes(), stream("NV61", width, height)),
        decode_rgb(luma.tobytes() + blue.tobytes() + red.tobytes(), stream("422P", width, height)),
    ]
    assert all((picture == pictures[0]).all() for picture in pictures)

    blue, red = blue[::2], red[::2]
    pairs = np.stack([blue, red], axis=-1)
    halves = {
        "NV12": pairs.tobytes(),
        "NV21": pairs[:, :, ::-1].tobytes(),
        "YU12": blue.tobytes() + red.tobytes(),
        "YV12": red.tobytes() + blue.tobytes(),
    }
    pictures = [
        decode_rgb(luma.tobytes() + chroma, stream(name, width, height)) for name, chroma in halves.items()
    ]
    assert all((picture == pictures[0]).all() for picture in pictures)


@pytest.mark.parametrize("name", sorted(KNOWN_FORMATS - CODED))
def test_padding_at_the_ends_of_lines_changes_nothing(name):
    tight = stream(name, 16, 8)
    data = noise(tight)
    stride = len(data) // tight.height if not small_planes(data, tight)[1] else None
    if stride is None:  # planes: the luma's stride, and all lines of chroma have it or its half
        stride = frame_bytes(stream(name, 16, 1)) if name in ("YUYV", "YUY2", "UYVY", "YVYU", "VYUY") else 16
    padded = replace(tight, stride_bytes=stride + 8)
    lines = []
    at = 0
    total = len(data)
    while at < total:
        chroma_plane = name in ("YU12", "I420", "YV12", "422P") and at >= stride * tight.height
        length, filler = (stride // 2, 4) if chroma_plane else (stride, 8)
        lines.append(data[at : at + length] + b"\xaa" * filler)
        at += length
    assert (decode_rgb(b"".join(lines), padded) == decode_rgb(data, tight)).all()


@pytest.mark.parametrize("name", sorted(BAYER))
def test_a_flat_colour_survives_the_mosaic(name):
    colour = {"R": 200, "G": 90, "B": 30}
    cell = np.array([[colour[letter] for letter in BAYER[name]]], np.uint8).reshape(2, 2)
    data = np.tile(cell, (5, 7)).tobytes()
    format = stream(name, 14, 10, transfer="linear")
    assert (decode_rgb(data, format) == [200, 90, 30]).all()
    small, chroma = small_planes(data, format, min_side=5)
    assert chroma is None
    assert small.shape == (5, 7, 3)
    assert (small == [200, 90, 30]).all()


@pytest.mark.parametrize(("name", "bits"), [("RG10", 10), ("RG12", 12), ("RG14", 14), ("RG16", 16)])
def test_deep_mosaics_fill_sixteen_bits_from_black_to_white(name, bits):
    for code, value in [(0, 0), ((1 << bits) - 1, 65535), (1 << (bits - 1), 32768)]:
        words = np.full((6, 8), code, "<u2")
        picture = decode_rgb(words.tobytes(), stream(name))
        assert picture.dtype == np.uint16
        assert np.abs(picture.astype(int) - value).max() <= 65535 / (1 << bits)  # one code of the format


@pytest.mark.parametrize(("packed", "plain"), [("pRAA", "RG10"), ("pRCC", "RG12"), ("pgAA", "BA10")])
def test_packed_mosaics_hold_the_same_samples_as_plain_ones(packed, plain):
    bits = 10 if packed.endswith("AA") else 12
    words = np.random.default_rng(2).integers(0, 1 << bits, (6, 8)).astype("<u2")
    count = 4 if bits == 10 else 2
    groups = words.reshape(6, -1, count)
    low = sum((groups[:, :, k] & ((1 << (bits - 8)) - 1)) << (k * (bits - 8)) for k in range(count))
    data = np.concatenate([groups >> (bits - 8), low[:, :, None]], axis=-1).astype(np.uint8).tobytes()
    assert len(data) == frame_bytes(stream(packed))
    assert (decode_rgb(data, stream(packed)) == decode_rgb(words.tobytes(), stream(plain))).all()


def test_grey_codes_are_the_picture():
    values = np.arange(48, dtype=np.uint8).reshape(6, 8) * 5
    assert (decode_rgb(values.tobytes(), stream("GREY")) == values[:, :, None]).all()
    words = np.full((6, 8), 1023, "<u2")
    assert (decode_rgb(words.tobytes(), stream("Y10 ")) == 65535).all()
    assert luma_levels(stream("GREY")) is None


def test_a_picture_comes_back_as_it_is():
    picture = smooth_picture(8, 6)
    assert decode_rgb(picture, stream("RGB3")) is picture
    assert (decode_rgb(picture.tobytes(), stream("RGB3")) == picture).all()
    assert (decode_rgb(picture[:, :, ::-1].tobytes(), stream("BGR3")) == picture).all()
    with pytest.raises(FrameDataError, match="6, 8, 3"):
        decode_rgb(picture[:, :4], stream("RGB3"))
    with pytest.raises(ValueError, match="RGB3"):
        decode_rgb(picture, stream("YUYV"))


def test_motion_jpeg_without_huffman_tables_becomes_a_whole_jpeg():
    data = jpeg(smooth_picture(64, 48))
    bare = strip_huffman_tables(data)
    assert b"\xff\xc4" not in bare
    format = stream("MJPG", 64, 48)
    file, suffix = picture_file(bare, format)
    assert suffix == ".jpg"
    assert header_size(file) == (64, 48)
    assert (decode_image(file, "frame.jpg") == decode_image(data, "frame.jpg")).all()
    assert (decode_rgb(bare, format) == decode_rgb(data, format)).all()
    # 4:2:0 and quality 95 leave a smooth picture within a few codes.
    assert np.abs(decode_rgb(bare, format).astype(int) - smooth_picture(64, 48)).max() <= 8


def test_a_sound_jpeg_goes_into_the_session_byte_by_byte():
    data = jpeg(smooth_picture(64, 48))
    assert picture_file(data, stream("MJPG", 64, 48)) == (data, ".jpg")
    assert picture_file(data + b"\xff\xd9\0stale" * 9, stream("MJPG", 64, 48)) == (data, ".jpg")


def test_a_jpeg_of_another_size_or_without_its_end_is_refused():
    data = jpeg(smooth_picture(64, 48))
    with pytest.raises(FrameDataError, match=r"64 x 48.*32 x 48"):
        complete_jpeg(data, 32, 48)
    with pytest.raises(FrameDataError, match="cut short"):
        decode_rgb(data[:-2], stream("MJPG", 64, 48))
    with pytest.raises(FrameDataError, match="0 bytes"):
        decode_rgb(b"", stream("MJPG", 64, 48))


@given(data=st.data())
@settings(max_examples=150, deadline=None)
def test_damaged_jpegs_are_refused_or_decoded_at_the_right_size(data):
    whole = jpeg(smooth_picture(48, 32))
    at = data.draw(st.integers(0, len(whole)))
    scrap = data.draw(st.binary(max_size=6))
    damaged = whole[:at] + scrap + whole[at + data.draw(st.integers(0, 9)) :]
    try:
        picture = decode_rgb(damaged, stream("MJPG", 48, 32))
    except FrameDataError:
        return
    assert picture.shape == (32, 48, 3)


@pytest.mark.parametrize("name", sorted(KNOWN_FORMATS - CODED))
def test_a_frame_that_is_too_short_says_what_is_missing(name):
    format = stream(name)
    data = noise(format)
    assert decode_rgb(data + b"stale", format).shape == (6, 8, 3)
    with pytest.raises(FrameDataError, match=rf"{len(data)} bytes; {len(data) - 1} came"):
        decode_rgb(data[:-1], format)
    with pytest.raises(FrameDataError):
        small_planes(b"", format)


def test_an_unknown_format_lists_the_known_ones():
    with pytest.raises(ValueError, match=r"H264.*MJPG.*YUYV"):
        decode_rgb(b"", stream("H264"))
    with pytest.raises(ValueError, match="16 bytes, not 10"):
        decode_rgb(b"", stream("YUYV", stride_bytes=10))


@pytest.mark.parametrize("name", ["YUYV", "NV12", "RG10", "GREY", "Y16 "])
def test_files_of_uncompressed_frames_lose_nothing(name):
    format = stream(name, 32, 24)
    data = noise(format)
    file, suffix = picture_file(data, format)
    assert suffix == ".png"
    assert (decode_image(file, "frame.png") == decode_rgb(data, format)).all()


@pytest.mark.parametrize("name", ["MJPG", "YUYV", "NV12", "YU12", "RG10", "GREY", "RGB3"])
def test_small_pictures_have_one_size_and_the_levels_of_the_large(name):
    width, height = 640, 480
    format = stream(name, width, height, full_range=name != "NV12")
    grey = np.full((height, width), 100, np.uint8)
    chroma = np.full(width * height // 2, 128, np.uint8)
    data = {
        "MJPG": lambda: jpeg(np.dstack([grey] * 3)),
        "YUYV": lambda: np.dstack([grey, np.full_like(grey, 128)]).tobytes(),
        "NV12": lambda: grey.tobytes() + chroma.tobytes(),
        "YU12": lambda: grey.tobytes() + chroma.tobytes(),
        "RG10": lambda: np.full((height, width), 401, "<u2").tobytes(),
        "GREY": grey.tobytes,
        "RGB3": lambda: np.dstack([grey] * 3),
    }[name]()
    small, colour = small_planes(data, format, min_side=240)
    assert small.shape[:2] == (240, 320)
    levels = luma_levels(format) or (0, np.iinfo(small.dtype).max)
    level = (small.astype(float).mean() - levels[0]) / (levels[1] - levels[0])
    expected = (100 - 16) / 219 if name == "NV12" else 100 / 255
    assert level == pytest.approx(expected, abs=2e-3)  # half a code of 8 bits
    profiles = ProfileAccumulator(320, 240, transfer="srgb", levels=luma_levels(format), matrix=format.matrix)
    profiles.add(small, 0.0, chroma=colour)  # takes them as they are
    if colour is not None:
        assert all((plane == 128).all() and plane.ndim == 2 for plane in colour)
