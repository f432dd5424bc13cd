"""Eq. 6 pixel after pixel, with the distance and direction of the flash as the paper has them."""

import numpy as np
import torch
from analytic_scene import looking_at

from relight.neural.paper.heads import NeuralMaps
from relight.neural.paper.lighting import flash_distance, flash_image, room_image, towards_camera

RANDOM = np.random.default_rng(0)
EYE = np.array([0.2, 0.1, 0.6])
CAMERA = looking_at(EYE, np.zeros(3), size=8)


def some_maps():
    normals = RANDOM.normal(size=(3, 4, 5))
    normals /= np.linalg.norm(normals, axis=0)
    parts = [RANDOM.random((3, 4, 5)), normals, RANDOM.random((1, 4, 5)), RANDOM.random((1, 4, 5))]
    return NeuralMaps(*(torch.from_numpy(part) for part in parts))


def test_the_image_is_eq_6_pixel_after_pixel():
    maps, c_room, c_flash = some_maps(), np.array([0.4, 0.5, 0.6]), np.array([0.1, 0.2, 0.3])
    distance = 0.45
    # -omega_o: the camera looks at the origin, so the light comes back along the line to its centre.
    towards = EYE / np.linalg.norm(EYE)
    expected = np.empty((3, 4, 5))
    for row in range(4):
        for column in range(5):
            at = np.s_[:, row, column]
            cosine = np.dot(maps.normals_world.numpy()[at], towards)
            room = maps.albedo.numpy()[at] * c_room * maps.shading.numpy()[0, row, column]
            expected[at] = room + maps.albedo.numpy()[at] * c_flash / distance**2 * cosine
    found = room_image(maps, torch.from_numpy(c_room)) + flash_image(
        maps, torch.from_numpy(c_flash), distance, towards_camera(CAMERA)
    )
    # The direction is a float32 constant.
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_the_distance_is_that_of_the_closest_point():
    points = RANDOM.uniform(-0.1, 0.1, size=(500, 3)).astype(np.float32)
    expected = min(np.linalg.norm(point - EYE) for point in points)
    np.testing.assert_allclose(flash_distance(torch.from_numpy(points), CAMERA), expected, rtol=1e-6)


def test_a_camera_on_a_point_has_a_distance_above_0():
    assert flash_distance(torch.from_numpy(EYE.astype(np.float32))[None], CAMERA) == 1e-3


def test_gradcheck():
    parts = [torch.rand(c, 2, 2, dtype=torch.float64, requires_grad=True) for c in (3, 3, 1)]
    colours = [torch.rand(3, dtype=torch.float64, requires_grad=True) for _ in range(2)]

    def image(albedo, normals, shading, c_room, c_flash):
        maps = NeuralMaps(albedo, normals, shading, shading)
        return room_image(maps, c_room) + flash_image(maps, c_flash, 0.5, towards_camera(CAMERA))

    assert torch.autograd.gradcheck(image, (*parts, *colours))
