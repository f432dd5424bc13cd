"""VideoControl descriptors of real cameras, and broken ones."""

import pytest
from fake_usb import EXTENSIONS, video_control
from hypothesis import given
from hypothesis import strategies as st

from capture.devices.uvc.descriptors import Entity, parse_video_control
from capture.errors import CameraError

#: What a Logitech C270 sends after its VideoControl interface descriptor, a line for each descriptor.
C270 = bytes.fromhex(
    "0d 24 01 00 01 a0 00 00 6c dc 02 01 01"
    "12 24 02 01 01 02 00 00 00 00 00 00 00 00 03 0e 00 00"
    "0b 24 05 02 01 00 40 02 5b 17 00"
    "1b 24 06 03 e4 8e 67 69 0f 41 db 40 a8 50 74 20 d7 d8 24 0e 08 01 02 02 3f 03 00"
    "1b 24 06 04 15 02 e4 49 34 f4 fe 47 b1 58 0e 88 50 23 e5 1b 03 01 02 02 09 01 00"
    "1c 24 06 06 a9 4c 5d 1f 11 de 87 44 84 0d 50 93 3c 8e c8 d1 12 01 04 03 ff ff 03 00"
    "1b 24 06 07 21 2d e5 ff 30 80 2c 4e 82 d9 f5 87 d0 05 40 bd 02 01 04 02 00 03 00"
    "09 24 03 05 01 01 00 04 00"
)


def test_a_c270_has_its_units_where_it_says() -> None:
    control = parse_video_control(0, C270)
    assert control.uvc_version == "1.00"
    camera, processing = control.units[Entity.CAMERA_TERMINAL], control.units[Entity.PROCESSING_UNIT]
    assert (camera.number, camera.controls) == (1, 0x00000E)  # AE mode, AE priority, exposure: no focus
    assert (processing.number, processing.controls) == (2, 0x175B)
    assert [number for number, _ in control.extensions] == [3, 4, 6, 7]


def test_extension_units_are_named_by_their_guid() -> None:
    control = parse_video_control(1, video_control())
    assert control.interface == 1
    assert [guid for _, guid in control.extensions] == list(EXTENSIONS)


@pytest.mark.parametrize("version", [0x0100, 0x0110, 0x0150])
def test_processing_units_of_all_revisions_are_read(version: int) -> None:
    control = parse_video_control(0, video_control(processing_controls=0x175B, version=version))
    assert control.uvc_version == f"1.{version & 0xFF:02x}"
    assert control.units[Entity.PROCESSING_UNIT].controls == 0x175B


def test_only_a_camera_is_a_camera_terminal() -> None:
    composite = video_control().replace(b"\x12\x24\x02\x01\x01\x02", b"\x12\x24\x02\x01\x01\x04")
    assert Entity.CAMERA_TERMINAL not in parse_video_control(0, composite).units


def read_or_refused(data: bytes) -> bool:
    """Whether it is read, or refused as it must be."""
    try:
        parse_video_control(0, data)
    except CameraError as error:
        return "malformed" in str(error)
    return True


@given(st.binary(max_size=80))
def test_garbage_is_read_or_refused_in_one_sentence(garbage: bytes) -> None:
    assert read_or_refused(garbage)


@given(st.integers(0, len(video_control())))
def test_descriptors_cut_anywhere_are_read_or_refused(length: int) -> None:
    assert read_or_refused(video_control()[:length])
