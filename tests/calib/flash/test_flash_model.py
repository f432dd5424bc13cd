"""The near light: its definition in plain numbers, and its derivatives against differences."""

import numpy as np
import pytest

from calib.flash.model import LIGHT_SIZE, Light, log_light, log_light_with_slopes


@pytest.fixture
def light():
    return Light(np.array([0.03, -0.02, 0.01, 0.1, -0.15, 1.7, 0.4, -0.2]))


@pytest.fixture
def surface():
    rng = np.random.default_rng(0)
    points = np.array([0.0, 0.0, 0.5]) + rng.uniform(-0.15, 0.15, (20, 3))
    normals = np.array([0.0, 0.0, -1.0]) + rng.uniform(-0.4, 0.4, (20, 3))
    return points, normals / np.linalg.norm(normals, axis=1, keepdims=True), rng.uniform(-0.5, 0.5, 20)


def test_white_that_faces_the_flash_at_one_metre_has_the_strength():
    vector = np.array([0.2, -0.1, 0.05, 0.3, 0.1, 2.0, np.log(0.16), 0.0])
    light = Light(vector)
    for distance_m in (1.0, 0.5):
        found = log_light(light, vector[:3] + distance_m * light.axis, -light.axis, np.zeros(()))
        assert np.exp(found) == pytest.approx(0.16 / distance_m**2, rel=1e-12)


def test_sixty_degrees_off_the_axis_the_light_is_half_to_the_power_of_the_falloff():
    direction = np.array([np.sin(np.pi / 3), 0.0, 0.5])
    light = Light(np.array([0, 0, 0, 0, 0, 3.0, 0, 0]))
    assert np.exp(log_light(light, direction, -direction, np.zeros(()))) == pytest.approx(1 / 8, rel=1e-12)


def test_slopes_are_those_of_differences(light, surface):
    points, normals, time = surface
    _, by_light, by_point, by_normal = log_light_with_slopes(light, *surface)
    step = 1e-6  # central differences of a smooth function in double precision: good to 1e-8 or so
    for column in range(LIGHT_SIZE):
        change = step * np.eye(LIGHT_SIZE)[column]
        ahead, behind = Light(light.vector + change), Light(light.vector - change)
        difference = (log_light(ahead, *surface) - log_light(behind, *surface)) / (2 * step)
        np.testing.assert_allclose(by_light[:, column], difference, atol=1e-7)
    for axis in range(3):
        change = step * np.eye(3)[axis]
        moved = log_light(light, points + change, normals, time)
        moved -= log_light(light, points - change, normals, time)
        np.testing.assert_allclose(by_point[:, axis], moved / (2 * step), atol=1e-6)
        turned = log_light(light, points, normals + change, time)
        turned -= log_light(light, points, normals - change, time)
        np.testing.assert_allclose(by_normal[:, axis], turned / (2 * step), atol=1e-7)


def test_the_axis_is_a_unit_vector_with_the_slopes_of_differences(light):
    assert np.linalg.norm(light.axis) == pytest.approx(1.0, abs=1e-15)
    for column in range(2):
        change = 1e-6 * np.eye(LIGHT_SIZE)[3 + column]
        difference = Light(light.vector + change).axis - Light(light.vector - change).axis
        np.testing.assert_allclose(light.axis_slopes[:, column], difference / 2e-6, atol=1e-8)


def test_behind_the_flash_and_on_the_far_side_it_is_dark_but_finite(light):
    behind = np.array([[0.0, 0.0, -0.5], [0.0, 0.0, 0.5]])
    away = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
    value, *slopes = log_light_with_slopes(light, behind, away, np.zeros(2))
    assert (value < -5).all()
    assert all(np.isfinite(array).all() for array in slopes)
