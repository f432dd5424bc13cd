"""Directories of TIFF-like files, whole and damaged."""

import contextlib
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from capture.errors import ImageError
from capture.raw.tiff import read_directories


@pytest.mark.parametrize("order", ["<", ">"])
def test_fields_of_every_directory_are_read_in_both_byte_orders(make, order):
    data = make.tiff(
        order,
        {
            "main": {271: (2, "Maker"), 306: (2, "x"), 50706: (1, [1, 4, 0, 0])},
            "raw": {256: (4, [70000]), 258: (3, [16, 14, 12]), 700: (11, [0.5]), 701: (12, [1e300, -2.0])},
            "exif": {33434: (5, [1, 3, 7, 0]), 37380: (10, [-1, 4])},
        },
        b"pixels",
    )
    main, raw, exif = read_directories(data)
    assert main.text(271) == "Maker"
    assert main.text(306) == "x"
    assert main.text(9999) == ""
    assert main.value(50706) == b"\1\4\0\0"
    assert raw.numbers(256) == (70000,)
    assert raw.numbers(258) == (16, 14, 12)
    assert raw.numbers(700) == (0.5,)
    assert raw.numbers(701) == (1e300, -2.0)
    assert exif.numbers(33434)[0] == pytest.approx(1 / 3)
    assert exif.numbers(33434)[1] != exif.numbers(33434)[1]  # n/0 is not a number
    assert exif.numbers(37380) == (-0.25,)
    assert exif.number(1, 5.0) == 5.0
    offset, size = (int(raw.numbers(tag)[0]) for tag in (273, 279))
    assert data[offset : offset + size] == b"pixels"


def test_the_exif_block_of_another_format_is_found(make):
    inner = make.tiff("<", {"main": {272: (2, "Model")}}, b"")
    for wrapped in (b"FUJIFILM" + bytes(90) + b"Exif\0\0" + inner, b"\0\0\0\x18ftypcrx " + b"CMT1" + inner):
        assert read_directories(wrapped)[0].text(272) == "Model"


@pytest.mark.parametrize(
    "data", [b"", b"II", b"II*\0", b"PNG and so on", b"II*\0\xff\xff\xff\xff", b"MM\0*" + bytes(4)]
)
def test_what_is_no_tiff_has_no_directories(data):
    assert read_directories(data) == []


def test_directories_that_point_at_themselves_end():
    entry = struct.pack("<HHII", 330, 4, 1, 8)
    (directory,) = read_directories(b"II*\0" + struct.pack("<IH", 8, 1) + entry + struct.pack("<I", 8))
    assert 330 in directory


@pytest.mark.parametrize(
    "field", [(270, 4, 1 << 31, 0), (270, 99, 1, 0), (270, 2, 100, 8), (270, 1, 1 << 22, 8)]
)
def test_a_value_that_the_file_does_not_hold_is_refused_when_asked_for(field):
    data = b"II*\0" + struct.pack("<IH", 8, 1) + struct.pack("<HHII", *field) + bytes(4)
    (directory,) = read_directories(data)
    with pytest.raises(ImageError, match="TIFF tag 270"):
        directory.numbers(270)
    assert directory.text(270) == ""
    with pytest.raises(ImageError, match="tag 271 is missing"):
        directory.value(271)


@given(st.sampled_from([b"II*\0", b"MM\0*", b"IIU\0", b"Exif\0\0II*\0"]), st.binary(max_size=200))
def test_garbage_is_walked_without_an_error_of_ours(head, tail):
    for directory in read_directories(head + tail):
        for tag in directory.fields:
            directory.text(tag)
            with contextlib.suppress(ImageError):
                directory.numbers(tag)
