from dataclasses import replace

import numpy as np
import pytest
from ball_scene import RADIUS, camera_at, make_session

from relight.errors import GeometryError
from relight.head_region import find_head_region

AZIMUTHS = [float(x) for x in np.linspace(-40, 40, 11)]


@pytest.fixture(scope="module")
def lit_and_unlit(tmp_path_factory):
    return make_session(tmp_path_factory.mktemp("region") / "s", AZIMUTHS)


def holds_the_ball(region):
    return np.linalg.norm(region.centre_world) + RADIUS <= region.radius


def test_what_the_flash_lights_is_inside_the_sphere_and_most_of_the_room_is_not(lit_and_unlit):
    session, cameras = lit_and_unlit
    region = find_head_region(session, cameras)
    assert region.source == "flash"
    assert holds_the_ball(region)
    # A hull from a part of a circle is deeper than the ball, by 1 / sin of half the arc at most.
    assert region.radius < 2.2 * RADIUS


def test_masks_take_the_place_of_the_flash(tmp_path):
    session, cameras = make_session(tmp_path / "s", AZIMUTHS[::2], flash_every=0, masks=True)
    region = find_head_region(session, cameras)
    assert region.source == "masks"
    assert holds_the_ball(region)


def test_without_flash_and_masks_it_is_what_the_picture_shows(tmp_path):
    session, cameras = make_session(tmp_path / "s", AZIMUTHS[::3], flash_every=0)
    region = find_head_region(session, cameras, np.zeros((0, 3)))
    assert region.source == "field of view"
    assert holds_the_ball(region)
    assert np.allclose(region.centre_world, 0.0, atol=1e-9)


def test_the_unit_of_the_poses_does_not_matter(lit_and_unlit):
    session, cameras = lit_and_unlit
    one = find_head_region(session, cameras)
    larger = {}
    for index, camera in cameras.items():
        pose = camera.cam_from_world.copy()
        pose[:3, 3] *= 40.0
        larger[index] = replace(camera, cam_from_world=pose)
    other = find_head_region(session, larger)
    assert np.allclose(other.centre_world, 40.0 * one.centre_world, atol=1e-9)
    assert other.radius == pytest.approx(40.0 * one.radius)


def test_a_few_cameras_that_look_elsewhere_do_not_move_it(lit_and_unlit):
    session, cameras = lit_and_unlit
    turned = dict(cameras)
    angle = np.radians(30.0)
    turn = np.eye(4)
    turn[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    turned[3] = replace(cameras[3], cam_from_world=turn @ cameras[3].cam_from_world)
    assert holds_the_ball(find_head_region(session, turned))


def test_parallel_axes_need_sparse_points(lit_and_unlit):
    session, cameras = lit_and_unlit
    beside = {}
    for index in cameras:
        camera = camera_at(0.0, f"{index:04d}")
        pose = camera.cam_from_world.copy()
        pose[0, 3] += 0.001 * index
        beside[index] = replace(camera, cam_from_world=pose)
    with pytest.raises(GeometryError, match="move the camera"):
        find_head_region(session, beside)
    points = np.random.default_rng(0).normal(scale=0.02, size=(200, 3))
    region = find_head_region(session, beside, points)
    assert np.linalg.norm(region.centre_world) < 0.05  # spread of the points


def test_one_camera_is_refused(lit_and_unlit):
    session, cameras = lit_and_unlit
    with pytest.raises(GeometryError, match="Only 1 usable"):
        find_head_region(session, {0: cameras[0]})


def test_cameras_that_look_away_are_refused(lit_and_unlit):
    session, cameras = lit_and_unlit
    away = {}
    for index, camera in cameras.items():
        turn = np.diag([-1.0, 1.0, -1.0, 1.0])
        away[index] = replace(camera, cam_from_world=turn @ camera.cam_from_world)
    with pytest.raises(GeometryError, match="poses are wrong"):
        find_head_region(session, away)
