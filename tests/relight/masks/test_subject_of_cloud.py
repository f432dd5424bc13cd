"""The subject's piece of a cloud, and its silhouette."""

import numpy as np
import pytest
import torch

from relight.errors import GeometryError
from relight.masks.silhouette import filled, signed_distance_px, silhouette
from relight.masks.subject import find_subject, looked_at


def sphere(count, radius, seed=0):
    d = np.random.default_rng(seed).normal(size=(count, 3))
    return (radius * d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32)


def test_strays_and_walls_are_not_the_subject(scene):
    rng = np.random.default_rng(1)
    head = sphere(6000, 0.1)
    strays = rng.uniform(-0.4, 0.4, (600, 3))
    # As many points as the head has, as stereo of a textured room gives.
    wall = np.stack([rng.uniform(-0.5, 0.5, 6000), rng.uniform(-0.5, 0.5, 6000), np.full(6000, -1.0)], 1)
    points = np.concatenate([head, strays, wall]).astype(np.float32)
    found = find_subject(points, [scene.camera_at(a) for a in (-20, 0, 20)])
    assert found.chosen[:6000].mean() > 0.98
    assert found.chosen[6000:6600].mean() < 0.05
    assert not found.chosen[6600:].any()
    assert found.distance == pytest.approx(0.55, rel=0.05)


def test_a_piece_that_lies_on_the_subject_is_its_own(scene):
    head = sphere(6000, 0.1)
    bun = sphere(300, 0.02, 1) + np.float32([0.0, 0.135, 0.0])  # 15 mm off the head
    found = find_subject(np.concatenate([head, bun]), [scene.camera_at(a) for a in (-20, 0, 20)])
    assert found.chosen[6000:].mean() > 0.9


@pytest.mark.parametrize("count", [0, 1, 150])
def test_too_few_points_are_refused(scene, count):
    with pytest.raises(GeometryError, match=f"has {count} points"):
        find_subject(sphere(count, 0.1), [scene.camera_at(0)])


def test_points_that_are_not_finite_are_left_out(scene):
    points = sphere(1000, 0.1)
    points[::2, 0] = np.nan
    found = find_subject(points, [scene.camera_at(a) for a in (-20, 20)])
    assert not found.chosen[::2].any()


def test_one_camera_looks_at_the_nearer_points(scene):
    camera = scene.camera_at(0)
    far = sphere(500, 0.1) + np.float32([0.0, 0.0, -2.0])
    point, distance = looked_at([camera], np.concatenate([sphere(2000, 0.1), far]))
    assert distance == pytest.approx(0.5, abs=0.06)  # the near side of the sphere
    assert np.linalg.norm(point) < 0.12


def test_the_silhouette_of_a_sphere_is_its_disc(scene):
    camera = scene.camera_at(0, size=256)
    for count, noise in ((40_000, 0.0), (8_000, 0.0), (40_000, 0.001)):
        points = sphere(count, 0.1)
        points += np.random.default_rng(2).normal(0, noise, points.shape).astype(np.float32)
        points += np.float32([0.0, -0.01, 0.0])  # where the cameras look
        spacing = (4 * np.pi * 0.1**2 / count) ** 0.5
        seen = silhouette(torch.from_numpy(points), camera, spacing, noise)
        distance = np.linalg.norm(camera.centre_world - [0.0, -0.01, 0.0])
        radius = camera.K[0, 0] * 0.1 / np.sqrt(distance**2 - 0.1**2)
        # Half a pixel of noise carries the outermost points a pixel and a half beyond the outline.
        assert np.sqrt(seen.inside.sum() / np.pi) == pytest.approx(radius, abs=1.25)
        middle = seen.depth[128, 128]
        assert middle == pytest.approx(distance - 0.1, abs=0.004)


def test_depth_goes_on_beyond_the_outline(scene):
    camera = scene.camera_at(0)
    seen = silhouette(torch.from_numpy(sphere(8000, 0.05)), camera, 0.002, 0.0)
    assert np.isfinite(seen.depth).all()
    assert (np.abs(seen.depth - 0.55) < 0.06).all()


def test_nothing_in_the_picture_is_an_empty_silhouette(scene):
    behind = torch.from_numpy(sphere(500, 0.05) + np.float32([0.0, 0.0, 5.0]))
    seen = silhouette(behind, scene.camera_at(0), 0.01, 0.0)
    assert not seen.inside.any()
    assert (seen.distance_px < 0).all()


def test_distances_are_signed_and_reach_half_a_pixel_at_the_outline():
    inside = np.zeros((20, 20), bool)
    inside[5:15, 5:15] = True
    distance = signed_distance_px(inside)
    assert distance[5, 10] == pytest.approx(0.5)
    assert distance[4, 10] == pytest.approx(-0.5)
    assert (signed_distance_px(np.ones((4, 4), bool)) > 0).all()
    assert (signed_distance_px(np.zeros((4, 4), bool)) < 0).all()


def test_small_enclosed_holes_are_filled_and_bays_are_not():
    mask = np.zeros((40, 40), bool)
    mask[5:35, 5:35] = True
    mask[20:22, 20:22] = False
    mask[5:12, 18:20] = False
    closed = filled(mask, 0.02)
    assert closed[20:22, 20:22].all()
    assert not closed[5:12, 18:20].any()
    assert not filled(mask, 1e-4)[20:22, 20:22].any()
