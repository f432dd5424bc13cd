"""What is known of a lens, in COLMAP's words and in ours."""

import struct

import cv2
import numpy as np
import pycolmap
import pytest

from calib.calibration import Intrinsics
from capture.calibration_file import Quantity
from relight.sfm.exif import focal_length_px
from relight.sfm.lenses import (
    GUESSED_FOCAL,
    colmap_camera,
    edge_shift_px,
    impossible_lens,
    lens_of,
    starting_lens,
)


def intrinsics(distortion=None):
    given = None if distortion is None else Quantity.of(distortion, "1", "test")
    return Intrinsics(640, 480, Quantity.of([600.0, 610.0, 322.0, 238.0], "px", "board"), given)


@pytest.mark.parametrize("distortion", [None, [0.05, -0.02, 0.001, -0.002], [0.1, -0.05, 0.001, 0, 0.02]])
def test_a_calibrated_lens_projects_in_colmap_as_in_opencv(distortion):
    lens = starting_lens(1280, 960, intrinsics(distortion), None)
    assert lens.known
    camera = colmap_camera(lens, (320, 240), False, 1)
    points = np.random.default_rng(0).uniform([-0.3, -0.2, 0.8], [0.3, 0.2, 1.2], (20, 3))
    bent = np.zeros(5) if distortion is None else np.array(distortion, float)
    full = cv2.projectPoints(points, np.zeros(3), np.zeros(3), lens.K, bent)[0].reshape(-1, 2)
    assert np.asarray(camera.img_from_cam(points)) == pytest.approx(full / 4, abs=1e-6)
    K, back = lens_of(camera, 1280, 960)
    assert pytest.approx(lens.K) == K
    assert np.allclose(back, 0 if distortion is None else np.pad(bent, (0, 3))[: len(back)])


def test_a_calibration_of_another_shape_is_not_used():
    lens = starting_lens(480, 640, intrinsics(), None)
    assert not lens.known
    assert lens.K[0, 0] == GUESSED_FOCAL * 640


def test_the_file_itself_may_tell_the_focal_length():
    assert starting_lens(640, 480, None, 700.0).K[0, 0] == 700.0
    assert starting_lens(640, 480, None, 7.0).K[0, 0] == GUESSED_FOCAL * 640  # no lens for heads


def test_impossible_lenses_are_named():
    camera = pycolmap.Camera(
        model="SIMPLE_RADIAL", width=400, height=300, params=[440.0, 200.0, 150.0, 0.0], camera_id=1
    )
    assert impossible_lens(camera) is None
    assert edge_shift_px(camera) == 0
    camera.params = [60.0, 200.0, 150.0, 0.0]
    assert "focal length" in str(impossible_lens(camera))
    camera.params = [440.0, 200.0, 150.0, 3.0]
    assert "distortion" in str(impossible_lens(camera))


def jpeg_with(order, entries):
    """A JPEG's beginning whose Exif directory has (tag, kind, number or fraction)."""
    exif, extra = b"", b""
    base = 8 + 2 + 12 + 4
    data_at = base + 2 + 12 * len(entries) + 4
    for tag, kind, value in entries:
        exif += struct.pack(order + "HHI", tag, kind, 1)
        if kind == 5:
            exif += struct.pack(order + "I", data_at + len(extra))
            extra += struct.pack(order + "II", *value)
        else:
            exif += struct.pack(
                order + ("HH" if kind == 3 else "I"), *((value, 0) if kind == 3 else (value,))
            )
    tiff = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(order + "I", 8)
    tiff += struct.pack(order + "H", 1) + struct.pack(order + "HHII", 0x8769, 4, 1, base) + bytes(4)
    tiff += struct.pack(order + "H", len(entries)) + exif + bytes(4) + extra
    block = b"Exif\0\0" + tiff
    return b"\xff\xd8\xff\xe1" + struct.pack(">H", len(block) + 2) + block + b"\xff\xda"


@pytest.mark.parametrize("order", ["<", ">"])
def test_exif_focal_lengths_are_read(order):
    # 43.27 mm of film diagonal are the picture's 500 px.
    assert focal_length_px(jpeg_with(order, [(0xA405, 3, 26)]), 400, 300) == pytest.approx(
        26 * 500 / 43.267, rel=1e-4
    )
    plane = [(0x920A, 5, (50, 10)), (0xA20E, 5, (2000, 1)), (0xA210, 3, 3)]
    assert focal_length_px(jpeg_with(order, plane), 400, 300) == pytest.approx(5.0 * 200)


@pytest.mark.parametrize("cut", [0, 1, 2, 3, 10, 20, 30, 45, 60])
def test_damaged_exif_says_nothing(cut):
    whole = jpeg_with("<", [(0xA405, 3, 26)])
    assert focal_length_px(whole[:cut], 400, 300) in (None, pytest.approx(26 * 500 / 43.267, rel=1e-4))
    assert focal_length_px(whole[:20] + b"\xff" * 40, 400, 300) is None
