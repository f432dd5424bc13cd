import contextlib

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calib.calibration import Calibration, Intrinsics, Quantity, load_calibration, save_calibration
from calib.errors import LensFileError
from calib.lens.files import FORMATS, read_lens, write_lens
from capture.errors import CalibrationError

PINHOLE = [560.25, 561.5, 322.75, 238.125]


def lens(distortion=(-0.22, 0.08, 0.001, -0.0015), size=(640, 480)):
    return Intrinsics(
        *size,
        Quantity.of(PINHOLE, "px", "test", [0.1] * 4),
        None if distortion is None else Quantity.of(distortion, "1", "test"),
    )


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("distortion", [None, (-0.22, 0.08, 0.001, -0.0015)])
def test_every_format_gives_back_what_it_was_given(tmp_path, form, distortion):
    path = tmp_path / f"lens{FORMATS[form]}"
    write_lens(lens(distortion), path)
    found = read_lens(path)
    assert (found.width, found.height) == (640, 480)
    assert np.array_equal(found.pinhole.value, PINHOLE)  # half pixels are exact in binary
    terms = np.zeros(0) if found.distortion is None else found.distortion.value
    assert np.array_equal(np.trim_zeros(terms, "b"), distortion or [])


@pytest.mark.parametrize(("form", "count"), [("opencv", 5), ("opencv", 8), ("mrcal", 8), ("colmap", 8)])
def test_longer_distortions_are_kept_where_there_is_room(tmp_path, form, count):
    terms = np.arange(1, count + 1) / 100
    write_lens(lens(terms), tmp_path / f"lens{FORMATS[form]}")
    assert np.array_equal(read_lens(tmp_path / f"lens{FORMATS[form]}").distortion.value, terms)


def test_opencv_reads_what_is_written_for_it(tmp_path):
    write_lens(lens(), tmp_path / "lens.yml")
    file = cv2.FileStorage(str(tmp_path / "lens.yml"), cv2.FILE_STORAGE_READ)
    K = file.getNode("camera_matrix").mat()
    # OpenCV's middle of the first pixel is 0, ours 0.5.
    assert K.tolist() == [[560.25, 0, 322.25], [0, 561.5, 237.625], [0, 0, 1]]
    assert file.getNode("distortion_coefficients").mat().ravel().tolist() == [-0.22, 0.08, 0.001, -0.0015]
    assert file.getNode("image_width").real() == 640


def test_what_opencv_writes_is_read(tmp_path):
    file = cv2.FileStorage(str(tmp_path / "camera.yaml"), cv2.FILE_STORAGE_WRITE)
    K = np.array([[560.123456789, 0, 322.25], [0, 561.5, 237.625], [0, 0, 1]])
    file.write("image_width", 640)
    file.write("image_height", 480)
    file.write("camera_matrix", K)
    file.write("distortion_coefficients", np.array([[-0.2], [0.08], [0.0], [0.0], [0.01]]))
    file.write("avg_reprojection_error", 0.12)
    file.release()
    found = read_lens(tmp_path / "camera.yaml")
    assert found.pinhole.value.tolist() == [560.123456789, 561.5, 322.75, 238.125]
    assert found.distortion.value.tolist() == [-0.2, 0.08, 0, 0, 0.01]


ROS = """image_width: 640
image_height: 480
camera_name: front
camera_matrix:
  rows: 3
  cols: 3
  data: [560.25, 0, 322.25, 0, 561.5, 237.625, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.22, 0.08, 0.001, -0.0015, 0]
"""
KALIBR = """cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.22, 0.08, 0.001, -0.0015]
  distortion_model: radtan
  intrinsics: [560.25, 561.5, 322.25, 237.625]
  resolution: [640, 480]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.1]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: [0.1, 0.0, 0.0, 0.0]
  distortion_model: equidistant
  intrinsics: [460.0, 461.0, 300.0, 200.0]
  resolution: [640, 480]
"""
MRCAL = """{
    'lensmodel':  'LENSMODEL_OPENCV4',
    # intrinsics are fx,fy,cx,cy,distortion0,distortion1,....
    'intrinsics': [ 560.25, 561.5, 322.25, 237.625, -0.22, 0.08, 0.001, -0.0015, ],
    'valid_intrinsics_region': [ [ 0., 0. ], [ 1., 2. ], ],
    # extrinsics are rt_fromref
    'extrinsics': [ 0., 0., 0., 0., 0., 0., ],
    'imagersize': [ 640, 480,],
    'icam_intrinsics': 0,
    'optimization_inputs': b'P<J~q',
}
"""
COLMAP = "# Camera list\n1 OPENCV 640 480 560.25 561.5 322.75 238.125 -0.22 0.08 0.001 -0.0015\n"


@pytest.mark.parametrize(
    ("name", "text", "camera"),
    [
        ("ost.yaml", ROS, None),
        ("camchain.yaml", KALIBR, "cam0"),
        ("left.cameramodel", MRCAL, None),
        ("cameras.txt", COLMAP, None),
    ],
)
def test_files_as_other_tools_write_them_are_read(tmp_path, name, text, camera):
    (tmp_path / name).write_text(text)
    found = read_lens(tmp_path / name, camera)
    assert found.pinhole.value.tolist() == PINHOLE
    assert found.distortion.value.tolist() == [-0.22, 0.08, 0.001, -0.0015]
    assert name in found.pinhole.source
    assert found.pinhole.sigma is None


def test_colmaps_simpler_models_find_their_places(tmp_path):
    (tmp_path / "cameras.txt").write_text(
        "1 SIMPLE_RADIAL 640 480 500 320 240 -0.1\n2 RADIAL 640 480 500 320 240 -0.1 0.02\n"
        "3 PINHOLE 640 480 500 501 320 240\n"
    )
    assert read_lens(tmp_path / "cameras.txt", "1").distortion.value.tolist() == [-0.1, 0, 0, 0]
    assert read_lens(tmp_path / "cameras.txt", "2").distortion.value.tolist() == [-0.1, 0.02, 0, 0]
    assert read_lens(tmp_path / "cameras.txt", "3").distortion is None
    with pytest.raises(LensFileError, match=r"3 cameras \(1, 2, 3\); name one with --camera"):
        read_lens(tmp_path / "cameras.txt")
    with pytest.raises(LensFileError, match="no camera '9'"):
        read_lens(tmp_path / "cameras.txt", "9")


def test_the_rest_of_a_calibration_stays(tmp_path):
    path = tmp_path / "calibration.json"
    save_calibration(Calibration(flash_falloff=Quantity.of(2.0, "1", "wall")), path)
    write_lens(lens(), path)
    found = load_calibration(path)
    assert found.value("flash_falloff") == 2.0
    assert found.intrinsics.pinhole.sigma.tolist() == [0.1] * 4


def test_a_camera_model_is_read_and_not_run(tmp_path):
    path = tmp_path / "evil.cameramodel"
    made = tmp_path / "made"
    path.write_text(f"{{'lensmodel': 'LENSMODEL_PINHOLE', 'intrinsics': open({str(made)!r}, 'w')}}")
    with pytest.raises(LensFileError, match="plain values"):
        read_lens(path)
    assert not made.exists()
    path.write_text("LENSMODEL_" + "(" * 100_000)
    with pytest.raises(LensFileError, match="plain values"):
        read_lens(path)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.yaml", KALIBR.replace("radtan", "equidistant"), "pinhole-equidistant is not supported"),
        ("a.yaml", ROS.replace("plumb_bob", "equidistant"), "'equidistant' is not supported"),
        ("a.yaml", ROS.replace("image_width: 640\n", ""), "image_width"),
        ("a.yaml", ROS.replace("0, 322.25", "2, 322.25"), "skew"),
        ("a.yaml", ROS.replace("cols: 5", "cols: 4"), "announced"),
        ("a.yaml", ROS.replace("560.25", "-560.25"), "positive"),
        ("a.yaml", ROS.replace("560.25", "nan"), "finite"),
        ("a.yaml", ROS.replace("640", "640.5"), "impossible"),
        ("a.yaml", "colour: red\n", "no intrinsics that are known"),
        ("a.yaml", "- 1\n- 2\n", "holds a list"),
        ("a.yaml", "words", "line 1"),
        (
            "a.cameramodel",
            MRCAL.replace("OPENCV4", "SPLINED_STEREOGRAPHIC_order=3"),
            "mrcal-convert-lensmodel",
        ),
        ("a.cameramodel", MRCAL.replace("0.001, ", ""), "has 8 intrinsics, not 7"),
        ("a.cameramodel", MRCAL.replace("'imagersize'", "'size'"), "imagersize"),
        ("a.txt", COLMAP.replace("OPENCV", "FOV"), "FOV is not supported"),
        ("a.txt", COLMAP.replace(" 0.001", ""), "has 8 parameters, not 7"),
        ("a.txt", COLMAP.replace("0.001", "x"), "could not convert"),
        ("a.txt", "1 OPENCV\n", "line 1"),
        ("a.txt", "# nothing\n", "0 cameras"),
        ("a.json", '{"schema": "relight-calibration", "version": 1}', "has no intrinsics"),
        ("a.json", "{}", "schema"),
    ],
)
def test_what_our_lens_cannot_be_is_refused(tmp_path, name, text, words):
    (tmp_path / name).write_text(text)
    camera = "cam0" if "cam0" in text else None
    with pytest.raises(CalibrationError, match=words):
        read_lens(tmp_path / name, camera)


def test_files_that_cannot_be_read_are_named(tmp_path):
    with pytest.raises(LensFileError, match=r"none\.yaml cannot be read"):
        read_lens(tmp_path / "none.yaml")
    (tmp_path / "a.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(LensFileError, match="not UTF-8"):
        read_lens(tmp_path / "a.yaml")


@pytest.mark.parametrize(
    ("form", "terms", "words"),
    [
        ("kalibr", [0.1, 0, 0, 0, 0.2], "radtan holds 4 distortion terms and this lens has 5"),
        ("kodak", [0.1], "the format is not told"),
    ],
)
def test_what_a_format_cannot_hold_is_not_dropped(tmp_path, form, terms, words):
    with pytest.raises(LensFileError, match=words):
        write_lens(lens(terms), tmp_path / "lens.x", form)
    with pytest.raises(LensFileError, match="not told by the name"):
        write_lens(lens(), tmp_path / "lens.x")
    assert not list(tmp_path.iterdir())


@given(data=st.data())
def test_damage_is_read_or_refused(tmp_path_factory, data):
    name, text = data.draw(
        st.sampled_from([("a.yaml", ROS), ("a.yaml", KALIBR), ("a.cameramodel", MRCAL), ("a.txt", COLMAP)])
    )
    at = data.draw(st.integers(0, len(text)))
    scrap = data.draw(st.text("[]{}:-\n ,\"'e9", max_size=4))
    path = tmp_path_factory.getbasetemp() / name
    path.write_text(text[:at] + scrap + text[at + data.draw(st.integers(0, 5)) :])
    with contextlib.suppress(CalibrationError):
        read_lens(path, "cam0")
