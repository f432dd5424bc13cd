"""Turning a camera upright is turning its picture."""

import numpy as np
import pytest

from capture.cameras import Camera
from relight.upright import upright_camera, upright_picture

CAMERA = Camera(
    "a",
    width=5,
    height=3,
    K=np.array([[4.0, 0, 2.2], [0, 4.5, 1.3], [0, 0, 1]]),
    cam_from_world=np.array([[1.0, 0, 0, 0.1], [0, 0.8, -0.6, 0.2], [0, 0.6, 0.8, 1.0], [0, 0, 0, 1]]),
)


def project(camera, point):
    x, y, z = (camera.cam_from_world @ [*point, 1])[:3]
    return camera.K[:2] @ [x / z, y / z, 1]


@pytest.mark.parametrize("rotation_deg", [0, 90, 180, 270])
def test_a_point_falls_on_the_pixel_that_shows_it(rotation_deg):
    point = [0.15, -0.1, 0.4]
    u, v = project(CAMERA, point).astype(int)
    picture = np.zeros((CAMERA.height, CAMERA.width))
    picture[v, u] = 1.0
    turned, shown = upright_camera(CAMERA, rotation_deg), upright_picture(picture, rotation_deg)
    assert shown.shape == (turned.height, turned.width)
    u, v = project(turned, point).astype(int)
    assert shown[v, u] == 1.0


@pytest.mark.parametrize("rotation_deg", [0, 90, 180, 270])
def test_the_camera_stays_where_it_is_and_rigid(rotation_deg):
    turned = upright_camera(CAMERA, rotation_deg)
    # Products of four numbers of order one, in float64.
    np.testing.assert_allclose(turned.centre_world, CAMERA.centre_world, atol=1e-14)
    rotation = turned.cam_from_world[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(rotation) > 0


def test_four_quarter_turns_are_none():
    turned = CAMERA
    for _ in range(4):
        turned = upright_camera(turned, 90)
    np.testing.assert_allclose(turned.K, CAMERA.K, atol=1e-14)
    np.testing.assert_allclose(turned.cam_from_world, CAMERA.cam_from_world, atol=1e-14)


def test_clockwise_is_clockwise():
    picture = np.array([[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(upright_picture(picture, 90), [[4, 1], [5, 2], [6, 3]])
