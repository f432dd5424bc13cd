"""Holes are filled on the surface that surrounds them; rims that are the subject's own stay open."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from relight.holes import fill_holes

COUNT = 5000
SPACING = np.sqrt(4 * np.pi / COUNT)  # on a unit sphere
WIDEST = 60 * SPACING


def sphere():
    """Points of a unit sphere, which are its normals."""
    i = np.arange(COUNT) + 0.5
    z, phi = 1 - 2 * i / COUNT, i * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - z * z)
    return np.stack([ring * np.cos(phi), ring * np.sin(phi), z], axis=1).astype(np.float32)


def with_hole(radius, at=(0.6, 0.0, 0.8)):
    points = sphere()
    outside = np.linalg.norm(points - np.float32(at), axis=1) > radius
    return points[outside], points[~outside]


@pytest.mark.parametrize("radius", [0.15, 0.3])  # 3 and 6 spacings
def test_a_hole_in_a_sphere_is_filled_on_the_sphere(radius):
    points, missing = with_hole(radius)
    added, normals = fill_holes(points, points, SPACING, WIDEST)
    # A quadratic fitted out to 1.5 radii departs from the sphere by its fourth order, (1.5 r)^4 / 8.
    tolerance = (1.5 * (radius + SPACING)) ** 4 / 8 + 1e-3
    distance = np.linalg.norm(added, axis=1)
    np.testing.assert_allclose(distance, 1.0, atol=tolerance)
    # The normals' error is the slope of that departure, 4 / radius times as much.
    assert ((normals * added).sum(axis=1) / distance).min() > np.cos(4 * tolerance / radius)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-5)
    # At the same spacing as the rest: as many as were there, and none further off than a cell's diagonal.
    assert len(added) == pytest.approx(len(missing), rel=0.2)
    assert cKDTree(np.concatenate([points, added])).query(missing)[0].max() < np.sqrt(2) * SPACING
    assert cKDTree(points).query(added)[0].min() > 0.6 * SPACING


def test_two_holes_are_filled_apart():
    points, _ = with_hole(0.2)
    points = points[np.linalg.norm(points - np.float32([-1, 0, 0]), axis=1) > 0.2]
    added, _ = fill_holes(points, points, SPACING, WIDEST)
    assert (added[:, 0] > 0.4).any()
    assert (added[:, 0] < -0.9).any()
    assert not ((added[:, 0] > -0.9) & (added[:, 0] < 0.4)).any()


def test_filling_does_not_depend_on_the_unit():
    points, _ = with_hole(0.3)
    added, normals = fill_holes(points, points, SPACING, WIDEST)
    larger, same = fill_holes(1000 * points, points, 1000 * SPACING, 1000 * WIDEST)
    # Numbers around 1000 in float32: 1e-4.
    np.testing.assert_allclose(larger, 1000 * added, atol=0.01)
    np.testing.assert_allclose(same, normals, atol=1e-4)


def test_the_open_rim_of_a_hemisphere_stays_open():
    points = sphere()
    points = points[points[:, 2] > 0]
    # Not even when it is not too wide: its normals turn all around, which no patch does.
    for widest in (WIDEST, np.inf):
        assert len(fill_holes(points, points, SPACING, widest)[0]) == 0


def test_a_hole_wider_than_allowed_stays_open():
    points, _ = with_hole(0.3)
    assert len(fill_holes(points, points, SPACING, 0.4)[0]) == 0


def test_a_closed_surface_gets_no_points():
    assert len(fill_holes(sphere(), sphere(), SPACING, WIDEST)[0]) == 0


@pytest.mark.parametrize("count", [0, 1, 16])
def test_too_few_points_have_no_holes(count):
    points, normals = fill_holes(sphere()[:count], sphere()[:count], SPACING, WIDEST)
    assert points.shape == normals.shape == (0, 3)


def test_a_line_and_equal_points_have_no_holes():
    line = np.zeros((60, 3), np.float32)
    line[:, 0] = np.arange(60) * SPACING
    up = np.tile(np.float32([0, 0, 1]), (60, 1))
    for points in (line, np.zeros_like(line)):
        assert len(fill_holes(points, up, SPACING, np.inf)[0]) == 0
