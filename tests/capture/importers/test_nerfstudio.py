import contextlib
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from capture.errors import SourceError
from capture.importers import ImportOptions, import_source
from capture.ply import PointCloud, read_ply, write_ply

# OpenCV camera axes in OpenGL's: y up and z backwards
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def transforms(cameras, file_from_original=None):
    """A transforms.json of the cameras, its world moved by a transform."""
    file_from_original = np.eye(4) if file_from_original is None else file_from_original
    frames = []
    for camera in cameras:
        world_from_gl = file_from_original @ np.linalg.inv(camera.cam_from_world) @ FLIP
        world_from_gl[:3, :3] /= np.cbrt(np.linalg.det(world_from_gl[:3, :3]))
        frames.append(
            {"file_path": f"./images/{camera.name}.jpg", "transform_matrix": world_from_gl.tolist()}
        )
    return {
        "camera_model": "OPENCV",
        **{"w": 16, "h": 12, "fl_x": 20.0, "fl_y": 21.0, "cx": 8.25, "cy": 6.0},
        **{"k1": 0.1, "k2": 0.02, "p1": 0.003, "p2": 0.004},
        "frames": frames,
    }


def run(source, out, **options):
    return import_source([source], out, ImportOptions(**options))


@pytest.mark.parametrize("by_file", [True, False])
def test_poses_are_turned_to_opencv_axes(save, cameras, tmp_path, by_file):
    source = save(transforms(cameras), "transforms.json")
    session = run(source / "transforms.json" if by_file else source, tmp_path / "S")
    assert (session.status, session.info["source"]["kind"]) == ("complete", "nerfstudio")
    for i, camera in session.load_scene_cameras().items():
        assert (
            np.abs(camera.cam_from_world - cameras[i].cam_from_world).max() < 1e-14
        )  # an inverse and a product
        assert np.array_equal(camera.K, cameras[i].K)
        assert camera.distortion.tolist() == [0.1, 0.02, 0.003, 0.004]
    assert [r.source for r in session.frames] == [f"images/{i:04d}.jpg" for i in range(4)]
    assert all(r.reasons == ("untagged",) for r in session.frames)
    assert not session.points_path.exists()


def test_the_applied_transform_is_undone_for_poses_and_cloud(save, cameras, pictures, tmp_path):
    applied = np.eye(4)
    applied[:3, :3] = Rotation.from_euler("xyz", [90, 20, 0], degrees=True).as_matrix()
    applied[:3, 3] = [1.0, 2.0, 3.0]
    scale = 0.25
    similarity = np.diag([scale, scale, scale, 1.0]) @ applied
    points = np.random.default_rng(1).normal(size=(5, 3))
    normals = np.eye(3)[[0, 1, 2, 0, 1]].astype(np.float32)
    moved = points @ similarity[:3, :3].T + similarity[:3, 3]
    write_ply(pictures / "sparse.ply", PointCloud(moved, normals @ applied[:3, :3].T.astype(np.float32)))
    content = transforms(cameras, similarity)
    content |= {
        "applied_transform": applied[:3].tolist(),
        "applied_scale": scale,
        "ply_file_path": "sparse.ply",
    }
    session = run(save(content, "transforms.json"), tmp_path / "S")
    for i, camera in session.load_scene_cameras().items():
        assert (
            np.abs(camera.cam_from_world - cameras[i].cam_from_world).max() < 1e-13
        )  # rounding, divided by 0.25
    cloud = read_ply(session.points_path)
    assert np.abs(cloud.points - points).max() < 1e-13
    assert np.abs(cloud.normals - normals).max() < 1e-6  # float32


def test_frames_may_have_their_own_intrinsics_flash_and_mask(save, cameras, tmp_path):
    content = transforms(cameras)
    content["frames"][1] |= {"fl_x": 30.0, "k1": 0.5, "flash": 1, "mask_path": "masks/0001.png"}
    content["frames"][2] |= {"flash": 0}
    content |= {"train_filenames": ["./images/0000.jpg"], "val_filenames": ["images/0003.jpg"]}
    session = run(save(content, "transforms.json"), tmp_path / "S")
    found = session.load_scene_cameras()
    assert (found[1].K[0, 0], found[1].distortion[0], found[0].K[0, 0]) == (30.0, 0.5, 20.0)
    assert [r.flash for r in session.frames] == [None, 1, 0, None]
    assert [r.split for r in session.frames] == ["train", None, None, "val"]
    assert [session.load_mask(r) is not None for r in session.frames] == [False, True, False, False]


def test_the_form_of_blender_sets_is_read(save, cameras, pictures, tmp_path):
    for i in range(4):
        (pictures / f"images/{i:04d}.jpg").rename(pictures / f"images/{i:04d}.png")
    content = {"camera_angle_x": 2 * np.arctan(0.4), "frames": transforms(cameras)["frames"]}
    for frame in content["frames"]:
        frame["file_path"] = frame["file_path"].removesuffix(".jpg")
    camera = run(save(content, "transforms.json"), tmp_path / "S").load_scene_cameras()[0]
    assert camera.K[[0, 1, 0, 1], [0, 1, 2, 2]] == pytest.approx([20, 20, 8, 6], rel=1e-14)  # 16 / 2 / 0.4
    assert camera.distortion.size == 0


def test_a_flash_list_goes_by_the_order_of_the_file(save, cameras, tmp_path):
    (tmp_path / "lit.json").write_text("[3]")
    session = run(
        save(transforms(cameras), "transforms.json"), tmp_path / "S", flash_list=tmp_path / "lit.json"
    )
    assert [r.flash for r in session.frames] == [0, 0, 0, 1]


def with_frame(**changes):
    def change(content):
        content["frames"][1] |= changes

    return change


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda c: c.update(camera_model="OPENCV_FISHEYE"), "OPENCV_FISHEYE is not supported; undistort"),
        (lambda c: c.update(k4=0.1), "k4"),
        (lambda c: c.pop("fl_x"), "camera_angle_x"),
        (lambda c: c.update(fl_x=None, camera_angle_x=4.0), "between 0 and pi"),
        (lambda c: c.update(fl_x=-20), "focal"),
        (lambda c: c.update(w=17), "Frame 0 .* 17 x 12"),
        (lambda c: c.update(frames=[*c["frames"][:1], {}]), 'frame 1: "file_path"'),
        (lambda c: c.update(ply_file_path="none.ply"), r"none\.ply"),
        (
            lambda c: c.update(applied_transform=[[1, 0, 0, 0], [0, 2, 0, 0], [0, 0, 1, 0]]),
            "applied_transform",
        ),
        (lambda c: c.update(applied_scale=0), "applied_scale"),
        (lambda c: c.update(val_filenames=[3]), "val_filenames"),
        (with_frame(transform_matrix=[[1, 2], [3, 4]]), "frame 1"),
        (with_frame(transform_matrix=np.diag([1.0, 1, -1, 1]).tolist()), "frame 1: .*reflection"),
        (with_frame(transform_matrix=np.diag([2.0, 2, 2, 1]).tolist()), "frame 1: .*orthonormal"),
        (with_frame(transform_matrix=np.ones((4, 4)).tolist()), "frame 1: .*last row"),
        (with_frame(transform_matrix=[[1, 0, 0, 1e200], [0, 1, 0, 0], [0, 0, 1, 0]]), "frame 1: .*range"),
        (with_frame(file_path="images/none.jpg"), "Frame 1"),
        (with_frame(flash="on"), "flash"),
    ],
)
def test_a_malformed_set_is_one_sentence(save, cameras, tmp_path, change, words):
    content = transforms(cameras)
    change(content)
    with pytest.raises(SourceError, match=words):
        run(save(content, "transforms.json"), tmp_path / "S")


@given(data=st.data())
def test_damage_is_read_or_refused(cameras, damage, scratch, data):
    (scratch / "images").mkdir(exist_ok=True)
    text = json.dumps(
        transforms(cameras[:1]) | {"applied_transform": np.eye(4).tolist(), "applied_scale": 1}
    ).encode()
    (scratch / "transforms.json").write_bytes(data.draw(damage(text)))
    with contextlib.suppress(SourceError):  # the picture is missing, so that nothing is ever imported
        run(scratch / "transforms.json", scratch / "never")
        pytest.fail("a set without its pictures was imported")
