"""What a fit reads of a session: linear, undistorted, and honest about what cannot be trusted."""

import numpy as np
import pytest
import torch
from analytic_scene import FLASH_OFFSET_CAM_M, Head, arc, cloud_of, photograph, write_session

from capture.cameras import Camera
from capture.errors import RelightError
from capture.images import write_exr, write_png
from capture.ply import PointCloud, write_ply
from capture.session import FrameRecord, Session
from relight.errors import PlanError
from relight.photometric import solve
from relight.scene import CLIPPED_RADIANCE, load_scene

HEAD = Head()
SIZE = 64
POSE = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.5], [0, 0, 0, 1]])


@pytest.fixture(scope="module")
def frames():
    return [photograph(HEAD, camera) for camera in arc(12, size=SIZE)]


@pytest.fixture(scope="module")
def cloud():
    return PointCloud(*cloud_of(HEAD, 4000, 0.0004), None)


@pytest.fixture(scope="module")
def session(frames, cloud, tmp_path_factory):
    return write_session(tmp_path_factory.mktemp("scene") / "session", frames, cloud)


def one_frame_session(path, camera, picture, suffix=".exr", flash=0):
    """A session of one linear picture."""
    source = {"kind": "test"}
    with Session.create(
        path, source=source, width=camera.width, height=camera.height, transfer="linear"
    ) as session:
        if suffix == ".exr":
            write_exr(path / "picture.exr", picture.astype(np.float32), half=False)
            picture = (path / "picture.exr").read_bytes()
        file = session.write_frame(0, picture, suffix)
        session.append_frame(
            FrameRecord(index=0, file=file, width=camera.width, height=camera.height, flash=flash)
        )
        session.save_scene_cameras({0: camera})
        write_ply(session.points_path, PointCloud(np.zeros((5, 3), np.float32), None, None))
    return session


def straight_camera(width=40, height=30, distortion=()):
    K = np.array([[30.0, 0, width / 2], [0, 30.0, height / 2], [0, 0, 1]])
    return Camera("a", width, height, K, POSE, np.asarray(distortion, dtype=np.float64))


def read(session):
    scene = load_scene(session, frames=[0])
    return scene.observe(scene.views[0])


def test_a_scene_is_what_the_session_holds(session, frames, cloud):
    scene = load_scene(session, frames=[3, 4])
    assert [view.index for view in scene.views] == [3, 4]
    assert [view.flash for view in scene.views] == [frames[3].camera.flash, frames[4].camera.flash]
    for view in scene.views:
        assert view.camera.flash == view.flash
        # Written as text with all digits of the quaternion.
        np.testing.assert_allclose(
            view.camera.cam_from_world, frames[view.index].camera.cam_from_world, atol=1e-12
        )
        np.testing.assert_array_equal(view.camera.K, frames[view.index].camera.K)
    np.testing.assert_array_equal(scene.points, cloud.points)
    np.testing.assert_array_equal(scene.normals_world, cloud.normals)
    np.testing.assert_array_equal(scene.flash_offset_cam_m, FLASH_OFFSET_CAM_M)


def test_frames_are_linear_to_an_8_bit_step(session, frames):
    scene = load_scene(session, frames=range(12))
    for view in scene.views:
        observation = scene.observe(view)
        assert observation.radiance.shape == (SIZE, SIZE, 3)
        # Half a code of 255, times the slope of the curve: at most 2.4 at white, and 1 / 12.92 in the blacks.
        np.testing.assert_allclose(observation.radiance, frames[view.index].radiance, atol=0.5 / 255 * 2.4)
        np.testing.assert_array_equal(observation.mask, frames[view.index].hit)
        np.testing.assert_array_equal(observation.valid, 1.0)


def test_clipped_integer_pixels_are_not_valid(tmp_path):
    picture = np.full((30, 40, 3), 1000, np.uint16)
    picture[0, 0, 1] = 65535  # one channel is enough
    picture[0, 1] = round(65535 * CLIPPED_RADIANCE) + 1
    picture[0, 2] = round(65535 * CLIPPED_RADIANCE) - 1
    observation = read(one_frame_session(tmp_path / "s", straight_camera(), picture, ".png"))
    expected = np.ones((30, 40))
    expected[0, :2] = 0
    np.testing.assert_array_equal(observation.valid, expected)
    assert observation.mask is None


def test_float_pixels_above_white_are_valid_and_not_finite_ones_are_not(tmp_path):
    picture = np.full((30, 40, 3), 0.2)
    picture[0, 0] = 7.5
    picture[0, 1, 2] = np.nan
    picture[0, 2, 0] = np.inf
    observation = read(one_frame_session(tmp_path / "s", straight_camera(), picture))
    assert observation.radiance.isfinite().all()
    assert observation.radiance[0, 0, 0] == 7.5
    np.testing.assert_array_equal(observation.valid[0, :4], [1, 0, 0, 1])


# k1 < 0 is a barrel: the corners of the straight picture come from inside the frame. k1 > 0 is a pincushion:
# they lie outside of it.
@pytest.mark.parametrize("k1", [-0.15, 0.15])
def test_frames_are_undistorted_to_the_pinhole(tmp_path, k1):
    distorted = straight_camera(distortion=[k1, 0.02, 0.003, -0.002])
    v, u = np.mgrid[0:30, 0:40] + 0.5
    # The scene is a gradient in pinhole pixels; what the lens makes of it follows by inverting its model.
    x_d, y_d = (u - 20) / 30, (v - 15) / 30
    x, y = x_d.copy(), y_d.copy()
    for _ in range(200):
        r2 = x * x + y * y
        radial = 1 + k1 * r2 + 0.02 * r2 * r2
        x, y = (
            (x_d - 2 * 0.003 * x * y + 0.002 * (r2 + 2 * x * x)) / radial,
            (y_d - 0.003 * (r2 + 2 * y * y) + 2 * 0.002 * x * y) / radial,
        )
    picture = np.stack([0.5 + 0.3 * x, 0.5 + 0.3 * y, np.full_like(x, 0.4)], axis=-1)
    session = one_frame_session(tmp_path / "s", distorted, picture)
    scene = load_scene(session, frames=[0])
    assert not scene.views[0].camera.distortion.any()
    observation = scene.observe(scene.views[0])
    valid = observation.valid.numpy() > 0.999
    assert valid[5:-5, 5:-5].all()
    assert valid.all() == (k1 < 0)
    expected = np.stack([0.5 + 0.3 * x_d, 0.5 + 0.3 * y_d, np.full_like(x_d, 0.4)], axis=-1)
    # Bilinear sampling of a curved gradient, and OpenCV's steps of 1/32 pixel (0.0003 here).
    np.testing.assert_allclose(observation.radiance.numpy()[valid], expected[valid], atol=0.001)


def test_a_single_coefficient_is_a_lens_too(tmp_path):
    picture = np.full((30, 40, 3), 0.4)
    short, long = ([-0.15], [-0.15, 0.0, 0.0, 0.0])
    valid = []
    for name, distortion in (("short", short), ("long", long)):
        session = one_frame_session(tmp_path / name, straight_camera(distortion=distortion), picture)
        scene = load_scene(session, frames=[0])
        valid.append(scene.observe(scene.views[0]).radiance.numpy())
    np.testing.assert_array_equal(valid[0], valid[1])


def test_distortion_can_be_taken_for_none(tmp_path):
    picture = np.random.default_rng(0).uniform(0, 0.9, (30, 40, 3)).astype(np.float32)
    session = one_frame_session(tmp_path / "s", straight_camera(distortion=[1e-5]), picture)
    scene = load_scene(session, frames=[0], undistort=False)
    assert not scene.views[0].camera.distortion.any()
    np.testing.assert_array_equal(scene.observe(scene.views[0]).radiance, picture)


def test_masks_are_undistorted_with_their_frames(tmp_path):
    session = one_frame_session(tmp_path / "s", straight_camera(distortion=[0.15]), np.full((30, 40, 3), 0.2))
    session.masks_dir.mkdir(parents=True)
    write_png(session.mask_path(0), np.full((30, 40), 255, np.uint8))
    observation = read(session)
    np.testing.assert_array_equal(observation.mask, observation.valid)
    assert observation.mask[0, 0] == 0


def test_without_calibration_the_flash_is_at_the_lens(tmp_path):
    session = one_frame_session(tmp_path / "s", straight_camera(), np.full((30, 40, 3), 0.2))
    np.testing.assert_array_equal(load_scene(session, frames=[0]).flash_offset_cam_m, np.zeros(3))
    assert load_scene(session, frames=[0]).normals_world is None


def test_a_frame_without_pose_or_flag_is_named(session, tmp_path):
    with pytest.raises(PlanError, match=r"Frame 99 .* has no pose; leave it out"):
        load_scene(session, frames=[0, 99])
    unknown = one_frame_session(tmp_path / "s", straight_camera(), np.full((30, 40, 3), 0.2), flash=None)
    with pytest.raises(PlanError, match=r"Frame 0 .* has no flash flag; leave it out"):
        load_scene(unknown, frames=[0])


@pytest.mark.parametrize("content", [None, b"", b"ply\n"])
def test_a_missing_or_damaged_cloud_is_one_sentence(tmp_path, content):
    session = one_frame_session(tmp_path / "s", straight_camera(), np.full((30, 40, 3), 0.2))
    if content is None:
        session.points_path.unlink()
    else:
        session.points_path.write_bytes(content)
    with pytest.raises(RelightError, match=r"points\.ply"):
        load_scene(session, frames=[0])


def test_a_picture_of_another_size_is_refused_when_it_is_read(tmp_path):
    session = one_frame_session(tmp_path / "s", straight_camera(), np.full((30, 40, 3), 0.2))
    write_exr(session.path / session.frames[0].file, np.zeros((8, 8, 3), np.float32))
    with pytest.raises(RelightError, match="8 x 8"):
        read(session)


def test_a_session_of_8_bit_frames_is_solved_like_the_truth(session):
    scene = load_scene(session, frames=range(12), device=torch.device("cpu"))
    portrait = solve(scene)
    known = (portrait.confidence > 0.6).numpy()
    points = portrait.points.double().numpy()[known]
    product = portrait.albedo.numpy()[known] * portrait.c_flash / (0.11 * HEAD.albedo(points))
    # Four flashes, 8 bits (0.3 %), pixels of 4 mm on colours with waves of 140 mm, normals from the cloud.
    assert known.mean() > 0.2
    assert abs(np.median(product) - 1) < 0.02
    assert np.median(np.abs(product - np.median(product))) < 0.025
