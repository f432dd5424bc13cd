import contextlib

import numpy as np  # before pycolmap: its library hides zlib otherwise
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from capture.cameras import Camera
from capture.colmap_model import (
    quaternion_from_rotation,
    read_colmap_model,
    rotation_from_quaternion,
    write_colmap_model,
)
from capture.errors import SourceError

PARAMETERS = {
    "SIMPLE_PINHOLE": [500.0, 31.5, 24.25],
    "PINHOLE": [500.0, 510.0, 31.5, 24.25],
    "SIMPLE_RADIAL": [500.0, 31.5, 24.25, 0.1],
    "RADIAL": [500.0, 31.5, 24.25, 0.1, -0.02],
    "OPENCV": [500.0, 510.0, 31.5, 24.25, 0.1, -0.02, 0.003, 0.004],
    "FULL_OPENCV": [500.0, 510.0, 31.5, 24.25, 0.1, -0.02, 0.003, 0.004, 0.05, 0.006, 0.007, 0.008],
}


def reference_model(model="OPENCV", images=3):
    """A model made by pycolmap: cameras, posed images with 2D points, coloured 3D points with tracks."""
    rng = np.random.default_rng(5)
    model_ = pycolmap.Reconstruction()
    model_.add_camera_with_trivial_rig(
        pycolmap.Camera(model=model, width=64, height=48, params=PARAMETERS[model], camera_id=7)
    )
    for image_id in range(1, images + 1):
        image = pycolmap.Image(name=f"left/{image_id:04d}.jpg", camera_id=7, image_id=image_id)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in rng.uniform(0, 48, (4, 2))])
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(Rotation.random(rng=rng).as_quat()), rng.normal(size=3))
        model_.add_image_with_trivial_frame(image, pose)
    for point in range(images):
        track = pycolmap.Track()
        track.add_element(1 + point, point)
        model_.add_point3D(rng.normal(size=3), track, rng.integers(0, 256, 3).astype(np.uint8))
    return model_


def write_reference(folder, model, form):
    folder.mkdir(parents=True, exist_ok=True)
    (model.write_binary if form == "binary" else model.write_text)(str(folder))


@pytest.mark.parametrize("form", ["binary", "text"])
@pytest.mark.parametrize("model", PARAMETERS)
def test_reading_agrees_with_pycolmap(tmp_path, model, form):
    reference = reference_model(model)
    write_reference(tmp_path, reference, form)
    found = read_colmap_model(tmp_path)
    assert sorted(found.cameras) == sorted(image.name for image in reference.images.values())
    for image in reference.images.values():
        camera = found.cameras[image.name]
        # text has 17 digits; the quaternion is normalised again: rounding
        assert np.abs(camera.cam_from_world[:3] - image.cam_from_world().matrix()).max() < 1e-14
        assert np.array_equal(camera.K, reference.cameras[7].calibration_matrix())
        assert (camera.width, camera.height, camera.name) == (64, 48, image.name[5:9])
    # the same pixel for a point off the axis shows that the distortion has its order
    x, y = 0.3, -0.2
    expected = reference.cameras[7].img_from_cam(np.array([x, y, 1.0]))
    assert project(found.cameras["left/0001.jpg"], x, y) == pytest.approx(
        expected, abs=1e-9
    )  # rounding at 500 px
    points = {tuple(p.xyz): p.color / 255 for p in reference.points3D.values()}
    for xyz, color in zip(found.points.points, found.points.colors, strict=True):
        assert color == pytest.approx(points[tuple(xyz)], abs=1e-6)  # float32


def project(camera, x, y):
    """OpenCV's distortion model, written out."""
    k1, k2, p1, p2, k3, k4, k5, k6 = np.pad(camera.distortion, (0, 8 - len(camera.distortion)))
    r2 = x * x + y * y
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    dx, dy = 2 * p1 * x * y + p2 * (r2 + 2 * x * x), p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return (camera.K @ [x * radial + dx, y * radial + dy, 1.0])[:2]


def some_cameras(count=4, distortion=()):
    rng = np.random.default_rng(6)
    K = np.array([[500.123456789012, 0, 31.5], [0, 510, 24.25], [0, 0, 1]])
    cameras = {}
    for i in range(count):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)
        cameras[f"frames/{i:06d}.png"] = Camera(
            f"{i:06d}", 64, 48, K, pose, np.array(distortion, dtype=float)
        )
    return cameras


@pytest.mark.parametrize(
    "distortion", [(), (0.1,), (0.1, 0.2, 0.3, 0.4), (0.1, 0, 0, 0, 0.5), tuple(np.arange(1, 9) / 100)]
)
def test_written_models_come_back_to_the_last_digit(tmp_path, distortion):
    cameras = some_cameras(distortion=distortion)
    write_colmap_model(tmp_path / "new", cameras)
    found = read_colmap_model(tmp_path / "new")
    assert found.points is None
    assert list(found.cameras) == list(cameras)
    for name, camera in cameras.items():
        again = found.cameras[name]
        relative = again.cam_from_world[:3, :3] @ camera.cam_from_world[:3, :3].T
        assert Rotation.from_matrix(relative).magnitude() < 1e-12
        assert np.array_equal(again.cam_from_world[:3, 3], camera.cam_from_world[:3, 3])
        assert np.array_equal(again.K, camera.K)
        assert np.array_equal(np.trim_zeros(again.distortion, "b"), camera.distortion)


def test_pycolmap_reads_what_is_written(tmp_path):
    cameras = some_cameras(distortion=(0.1, 0.2, 0.3, 0.4))
    write_colmap_model(tmp_path, cameras)
    reference = pycolmap.Reconstruction(str(tmp_path))
    assert len(reference.cameras) == 1  # equal intrinsics are one camera
    for image in reference.images.values():
        expected = cameras[image.name].cam_from_world[:3]
        assert np.abs(image.cam_from_world().matrix() - expected).max() < 1e-14  # rounding


def test_binary_counts_where_both_forms_are(tmp_path):
    write_reference(tmp_path, reference_model(images=2), "text")
    write_reference(tmp_path, reference_model(images=3), "binary")
    assert len(read_colmap_model(tmp_path).cameras) == 3


@given(axis=st.tuples(*[st.floats(-1, 1)] * 3), angle=st.floats(-7, 7))
def test_quaternions_of_any_rotation_are_accurate(axis, angle):
    norm = np.linalg.norm(axis)
    rotation = Rotation.from_rotvec(np.array(axis) / norm * angle if norm > 1e-9 else np.zeros(3)).as_matrix()
    quaternion = quaternion_from_rotation(rotation)
    assert quaternion[0] >= 0
    assert (
        np.abs(rotation_from_quaternion(quaternion) - rotation).max() < 1e-14
    )  # a few roundings of numbers up to 4


@pytest.mark.parametrize("angle", [0.0, np.pi, np.pi - 1e-9, 1e-12])
@pytest.mark.parametrize("axis", np.eye(3))
def test_quaternions_are_accurate_where_components_vanish(axis, angle):
    rotation = Rotation.from_rotvec(axis * angle).as_matrix()
    assert np.abs(rotation_from_quaternion(quaternion_from_rotation(rotation)) - rotation).max() < 1e-15


@pytest.mark.parametrize(
    "model", ["OPENCV_FISHEYE", "FOV", "THIN_PRISM_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "NEW_MODEL"]
)
def test_a_model_that_is_no_pinhole_is_refused_with_the_way_out(tmp_path, model):
    write_colmap_model(tmp_path, some_cameras())
    text = (tmp_path / "cameras.txt").read_text().replace("PINHOLE", model)
    (tmp_path / "cameras.txt").write_text(text)
    with pytest.raises(SourceError, match=f"{model} is not supported; undistort"):
        read_colmap_model(tmp_path)


def test_a_binary_fisheye_is_refused_by_name(tmp_path):
    write_reference(tmp_path, reference_model("OPENCV"), "binary")
    data = bytearray((tmp_path / "cameras.bin").read_bytes())
    data[12] = 5
    (tmp_path / "cameras.bin").write_bytes(data)
    with pytest.raises(SourceError, match="OPENCV_FISHEYE"):
        read_colmap_model(tmp_path)


@pytest.mark.parametrize(
    ("file", "old", "new", "words"),
    [
        ("images.txt", "frames/000001", "frames/000000", "appears twice"),
        ("images.txt", " 1 frames/000000", " 9 frames/000000", "camera 9, which does not exist"),
        ("images.txt", "\n1 ", "\n1 0 0 0 0 0 0 0 1 zero.png\n\n1 ", "not a finite rotation"),
        ("images.txt", "\n1 ", "\n1 nan 0 0 0 0 0 0 1 nan.png\n\n1 ", "not a finite rotation"),
        ("images.txt", "\n1 ", "\n1 x 0 0 0 0 0 0 1 x.png\n\n1 ", "line 2: .*'x'"),
        ("images.txt", "\n1 ", "\n1 2 3\n\n1 ", "line 2: an image has"),
        ("images.txt", "frames/000001", "frames/\0", "contains a NUL"),
        ("cameras.txt", "64 48", "64 0", "image size 64 x 0"),
        ("cameras.txt", "64 48", "64 big", "line 2"),
        ("cameras.txt", "500.1", "-500.1", "focal"),
        ("cameras.txt", " 24.25", "", "4 parameters, not 3"),
        ("cameras.txt", " 24.25", " nan", "not a finite"),
        ("points3D.txt", "ERROR", "ERROR\n1 2 3\n#", "line 2: a point has"),
        ("points3D.txt", "TRACK[]", "\n1 inf 3 4 5 6 7 8 9\n#", "not finite"),
    ],
)
def test_a_malformed_text_model_names_the_line(tmp_path, file, old, new, words):
    write_colmap_model(tmp_path, some_cameras())
    text = (tmp_path / file).read_text()
    assert old in text
    (tmp_path / file).write_text(text.replace(old, new, 1))
    with pytest.raises(SourceError, match=words):
        read_colmap_model(tmp_path)


def test_a_folder_without_a_model_is_refused(tmp_path):
    with pytest.raises(SourceError, match="no COLMAP model"):
        read_colmap_model(tmp_path)
    write_colmap_model(tmp_path, {})
    with pytest.raises(SourceError, match="no image"):
        read_colmap_model(tmp_path)


def test_what_colmap_cannot_say_is_not_written(tmp_path):
    (camera,) = some_cameras(1).values()
    skewed = Camera("a", 64, 48, camera.K + np.eye(3)[[1, 2, 0]] * [0, 1, 0] * 3, camera.cam_from_world)
    tilted = Camera("a", 64, 48, camera.K, camera.cam_from_world, np.ones(12))
    for bad in ({"a.png": skewed}, {"a.png": tilted}, {"a\n.png": camera}):
        with pytest.raises(ValueError, match=r"a"):
            write_colmap_model(tmp_path, bad)


def test_a_count_beyond_the_file_is_refused_at_once(tmp_path):
    for file in ("cameras.bin", "images.bin", "points3D.bin"):
        write_reference(tmp_path, reference_model(), "binary")
        data = (tmp_path / file).read_bytes()
        (tmp_path / file).write_bytes(b"\xff" * 7 + b"\x7f" + data[8:])
        with pytest.raises(SourceError, match=f"{file} is damaged or cut short"):
            read_colmap_model(tmp_path)


@pytest.mark.parametrize("form", ["binary", "text"])
@pytest.mark.parametrize("file", ["cameras", "images", "points3D"])
@settings(max_examples=60)
@given(data=st.data())
def test_damage_is_read_or_refused(damage, scratch, form, file, data):
    folder = scratch / f"{form}_{file}"
    if not folder.is_dir():
        write_reference(folder, reference_model(), form)
        (folder / "original").write_bytes(
            (folder / f"{file}{'.bin' if form == 'binary' else '.txt'}").read_bytes()
        )
    path = folder / f"{file}{'.bin' if form == 'binary' else '.txt'}"
    path.write_bytes(data.draw(damage((folder / "original").read_bytes())))
    with contextlib.suppress(SourceError):
        found = read_colmap_model(folder)
        assert all(np.isfinite(camera.cam_from_world).all() for camera in found.cameras.values())
