import json
from dataclasses import replace

import numpy as np
import pytest
from ball_scene import DISTANCE, RADIUS, SIZE, make_session

from relight.errors import GeometryError
from relight.stereo import StereoConfig, dense_cloud

AZIMUTHS = [float(x) for x in np.linspace(-30, 30, 13)]
CONFIG = StereoConfig(references=6, second_pass=False)
FEW = StereoConfig(references=4, second_pass=False)
PIXEL = DISTANCE / (1.3 * SIZE)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return make_session(tmp_path_factory.mktemp("dense") / "s", AZIMUTHS, flash_every=6)


@pytest.fixture(scope="module")
def cloud(scene):
    session, cameras = scene
    return dense_cloud(session, cameras, None, CONFIG)


def distances(cloud):
    return np.abs(np.linalg.norm(cloud.points, axis=1) - RADIUS)


def test_the_surface_is_found_to_a_fraction_of_a_pixel(cloud):
    error = distances(cloud)
    # 0.1 px of parallax at 15 degrees is 0.4 px of depth; the mean of some maps is better.
    assert np.median(error) < 0.1 * PIXEL
    assert np.percentile(error, 95) < 0.5 * PIXEL


def test_it_covers_what_the_cameras_face(cloud):
    longitude = np.degrees(np.arctan2(cloud.points[:, 0], cloud.points[:, 2]))
    latitude = np.degrees(np.arcsin(np.clip(cloud.points[:, 1] / RADIUS, -1, 1)))
    for at in (-35, 0, 35):
        near = (np.abs(longitude - at) < 6) & (np.abs(latitude) < 6)
        patch = (np.radians(12) * RADIUS) ** 2
        assert near.sum() * (0.85 * PIXEL) ** 2 > 0.7 * patch


def test_normals_point_at_the_cameras_and_are_those_of_the_ball(cloud):
    assert np.allclose(np.linalg.norm(cloud.normals_world, axis=1), 1.0, atol=1e-5)
    cosine = (cloud.normals_world * cloud.points).sum(axis=1) / np.linalg.norm(cloud.points, axis=1)
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean() < 3.0


def test_the_report_is_plain_and_the_confidence_a_share(cloud):
    assert json.loads(json.dumps(cloud.report)) == cloud.report
    assert cloud.report["kind"] == "unlit"
    assert cloud.points.dtype == cloud.normals_world.dtype == cloud.confidence.dtype == np.float32
    assert ((cloud.confidence >= 0) & (cloud.confidence <= 1)).all()


def test_a_second_pass_does_not_lose_the_surface_and_progress_ends_at_one(scene):
    session, cameras = scene
    told = []
    config = StereoConfig(references=4)
    cloud = dense_cloud(session, cameras, None, config, progress=lambda stage, part: told.append(part))
    assert np.median(distances(cloud)) < 0.15 * PIXEL  # of fewer maps than above
    assert told[-1] == 1.0
    assert told == sorted(told)


def test_frames_that_are_all_lit_serve_too(tmp_path):
    session, cameras = make_session(tmp_path / "s", AZIMUTHS, flash_every=1)
    cloud = dense_cloud(session, cameras, None, FEW)
    assert cloud.report["kind"] == "lit"
    assert np.median(distances(cloud)) < 0.5 * PIXEL  # the light moves with the camera


def test_wrong_poses_are_refused(scene):
    session, cameras = scene
    rng = np.random.default_rng(0)
    wrong = {}
    for index, camera in cameras.items():
        angle = rng.uniform(-0.15, 0.15)  # up to 20 pixels
        turn = np.eye(4)
        turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        turn[1, 3] = rng.uniform(-0.05, 0.05)
        wrong[index] = replace(camera, cam_from_world=turn @ camera.cam_from_world)
    with pytest.raises(GeometryError, match="agree on only"):
        dense_cloud(session, wrong, None, FEW)


def test_wrong_poses_with_masks_give_the_hull_and_say_so(tmp_path):
    session, cameras = make_session(tmp_path / "s", AZIMUTHS, masks=True, contrast=0.0)
    cloud = dense_cloud(session, cameras, None, FEW)
    assert cloud.report["method"] == "visual hull"
    assert "visual hull" in cloud.warnings[0]
    # Cameras on a sixth of a circle see the ball's outline on two strips; between them the hull is open.
    assert np.percentile(distances(cloud), 10) < PIXEL


def test_no_parallax_is_refused(tmp_path):
    session, cameras = make_session(tmp_path / "s", [0.0, 0.6, 1.2, 1.8], flash_every=0)
    with pytest.raises(GeometryError, match="degrees apart"):
        dense_cloud(session, cameras, None, CONFIG)


def test_darkness_is_refused(tmp_path):
    session, cameras = make_session(
        tmp_path / "s", AZIMUTHS[::2], flash_every=0, exposures=[0.01] * len(AZIMUTHS)
    )
    with pytest.raises(GeometryError, match="too dark"):
        dense_cloud(session, cameras, None, CONFIG)


def test_one_frame_is_refused(scene):
    session, cameras = scene
    with pytest.raises(GeometryError, match="Only 1 usable"):
        dense_cloud(session, {1: cameras[1]}, None, CONFIG)
