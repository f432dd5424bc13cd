import contextlib

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from capture.errors import ImageError
from capture.images import image_size, read_exr, read_image, write_exr, write_image, write_jpeg, write_png


def picture(kind=np.uint8, shape=(11, 17, 3)):
    return np.random.default_rng(1).integers(0, np.iinfo(kind).max, shape, endpoint=True).astype(kind)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
@pytest.mark.parametrize("shape", [(11, 17, 3), (11, 17)])
def test_png_keeps_every_value_and_channel_order(tmp_path, kind, shape):
    array = picture(kind, shape)
    write_png(tmp_path / "a.png", array)
    again = read_image(tmp_path / "a.png")
    assert again.dtype == kind
    assert np.array_equal(again, array)
    assert image_size(tmp_path / "a.png") == (17, 11)


@pytest.mark.parametrize(("suffix", "half"), [(".exr", True), (".exr", False)])
@pytest.mark.parametrize("shape", [(11, 17, 3), (11, 17)])
def test_exr_keeps_floats_of_its_precision(tmp_path, suffix, half, shape):
    array = np.random.default_rng(2).normal(size=shape).astype(np.float16 if half else np.float32)
    write_exr(tmp_path / f"a{suffix}", array, half)
    again = read_image(tmp_path / f"a{suffix}")
    assert again.dtype == np.float32
    assert np.array_equal(again, array.astype(np.float32))
    assert image_size(tmp_path / f"a{suffix}") == (17, 11)


def test_exr_stores_values_beyond_half_as_float(tmp_path):
    array = np.full((2, 3), 1e6, np.float32)
    write_exr(tmp_path / "a.exr", array)
    assert np.array_equal(read_exr(tmp_path / "a.exr"), array)


def test_jpeg_is_close_and_in_rgb_order(tmp_path):
    array = np.zeros((32, 48, 3), np.uint8)
    array[..., 0] = 200
    write_jpeg(tmp_path / "a.jpg", array)
    assert np.abs(read_image(tmp_path / "a.jpg").astype(int) - array).max() <= 3  # quality 95, a flat colour
    assert image_size(tmp_path / "a.jpg") == (48, 32)


def test_alpha_is_dropped(tmp_path):
    array = picture(shape=(4, 5, 4))
    cv2.imwrite(str(tmp_path / "a.png"), array)
    assert np.array_equal(read_image(tmp_path / "a.png"), array[..., 2::-1])


def test_exif_orientation_does_not_turn_a_frame(tmp_path):
    write_jpeg(tmp_path / "a.jpg", np.zeros((8, 16, 3), np.uint8))
    data = (tmp_path / "a.jpg").read_bytes()
    tiff = b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0"  # one tag: orientation 6
    exif = b"\xff\xe1" + (len(tiff) + 8).to_bytes(2, "big") + b"Exif\0\0" + tiff
    (tmp_path / "b.jpg").write_bytes(data[:2] + exif + data[2:])
    assert read_image(tmp_path / "b.jpg").shape == (8, 16, 3)
    assert image_size(tmp_path / "b.jpg") == (16, 8)


@pytest.mark.parametrize("name", ["a.png", "a.jpg"])
def test_a_picture_without_its_end_is_refused(tmp_path, name):
    write_image(tmp_path / name, picture(shape=(64, 64, 3)))
    data = (tmp_path / name).read_bytes()
    for size in (len(data) // 2, len(data) - 3):
        (tmp_path / name).write_bytes(data[:size])
        for read in (read_image, image_size):
            with pytest.raises(ImageError, match="cut short"):
                read(tmp_path / name)
    (tmp_path / name).write_bytes(data + b"trailer of a phone")
    assert read_image(tmp_path / name).shape == (64, 64, 3)


def test_a_header_that_claims_a_huge_picture_is_refused_before_memory_is_taken(tmp_path):
    write_png(tmp_path / "a.png", picture())
    data = bytearray((tmp_path / "a.png").read_bytes())
    whole = bytes(data)
    data[16:24] = b"\0\x0f\xff\xff" * 2
    (tmp_path / "a.png").write_bytes(data)
    with pytest.raises(ImageError, match="cannot hold"):
        read_image(tmp_path / "a.png")
    (tmp_path / "a.png").write_bytes(whole[:33] + b"\x60\0\0\0" + whole[37:])  # length of the next chunk
    with pytest.raises(ImageError, match="cut short or damaged"):
        read_image(tmp_path / "a.png")


@pytest.mark.parametrize(("suffix", "kind"), [(".tif", np.uint8), (".tif", np.uint16), (".hdr", np.float32)])
def test_other_formats_are_read_in_rgb_order(tmp_path, suffix, kind):
    array = picture(np.uint8, (5, 9, 3)).astype(kind)
    assert cv2.imwrite(str(tmp_path / f"a{suffix}"), array[..., ::-1])
    again = read_image(tmp_path / f"a{suffix}")
    assert again.dtype == kind
    # Radiance HDR shares one exponent between the channels: 8 bits of mantissa for the largest
    assert np.abs(again.astype(float) - array).max() <= (1 if suffix == ".hdr" else 0)
    assert image_size(tmp_path / f"a{suffix}") == (9, 5)


def test_a_flat_picture_that_packs_well_is_read(tmp_path):
    for name in ("a.png", "a.jpg"):
        write_image(tmp_path / name, np.full((2000, 3000, 3), 128, np.uint8))
        assert read_image(tmp_path / name).shape == (2000, 3000, 3)


def test_a_missing_picture_names_its_path(tmp_path):
    for name in ("none.png", "none.exr"):
        with pytest.raises(ImageError, match=name):
            read_image(tmp_path / name)


@pytest.mark.parametrize(
    "array", [np.zeros((0, 3, 3), np.uint8), np.zeros((2, 2, 2), np.uint8), np.zeros(4, np.uint8)]
)
def test_what_is_no_picture_is_not_written(tmp_path, array):
    for suffix in (".png", ".exr"):
        with pytest.raises(ValueError, match="shape"):
            write_image(tmp_path / f"a{suffix}", array)
    with pytest.raises(ValueError, match="gif"):
        write_image(tmp_path / "a.gif", np.zeros((2, 2), np.uint8))


@pytest.fixture(scope="module")
def originals(tmp_path_factory):
    folder = tmp_path_factory.mktemp("originals")
    array = picture(shape=(9, 7, 3))
    write_png(folder / "a.png", array)
    write_jpeg(folder / "a.jpg", array)
    write_exr(folder / "a.exr", array.astype(np.float32))
    cv2.imwrite(str(folder / "a.hdr"), array.astype(np.float32))
    cv2.imwrite(str(folder / "a.tif"), array)
    return {path.suffix: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".exr", ".hdr", ".tif"])
@settings(max_examples=60)
@given(data=st.data())
def test_a_damaged_picture_is_read_or_refused(originals, damage, scratch, suffix, data):
    path = scratch / f"damaged{suffix}"
    path.write_bytes(data.draw(damage(originals[suffix])))
    for read in (read_image, image_size):
        with contextlib.suppress(ImageError):
            read(path)
