import numpy as np
import pytest
from scipy.spatial import cKDTree

from capture.sim import Rig
from capture.sim.cloud import sample_surface, stereo_cloud
from capture.sim.rasterize import rays_world
from capture.sim.truth import AMBIENT, DIRECTIONS, GroundTruth, ground_truth, relit


@pytest.fixture(scope="module")
def camera_and_truth(small_rig: Rig) -> tuple:
    camera = small_rig.camera(0.8, "x").scaled(2.0)
    return camera, ground_truth(small_rig, camera)


def interior(truth: GroundTruth) -> np.ndarray:
    """Fully covered pixels whose neighbours lie on the same surface."""
    z = np.where(truth.mask == 1, truth.depth, 0.0)
    full = np.ones_like(z, dtype=bool)
    for axis in (0, 1):
        for shift in (-1, 1):
            full &= np.abs(np.roll(z, shift, axis) - z) < 0.006
    return full & (z > 0)


def test_normals_agree_with_the_slope_of_the_depth(camera_and_truth: tuple) -> None:
    camera, truth = camera_and_truth
    points = camera.centre_world + truth.depth[..., None] * rays_world(camera)
    across = np.roll(points, -1, 1) - np.roll(points, 1, 1)
    down = np.roll(points, -1, 0) - np.roll(points, 1, 0)
    slope = np.cross(down, across)
    slope /= np.linalg.norm(slope, axis=-1, keepdims=True) + 1e-12
    cosine = np.einsum("hwc,hwc->hw", slope, truth.normals_world)[interior(truth)]
    # Facets of 5 mm against their smoothed normals, and ribbons of hair: a few degrees in the middle.
    assert np.degrees(np.arccos(np.clip(np.median(cosine), -1, 1))) < 8
    assert (cosine > 0).mean() > 0.95


def test_depth_lies_on_the_surface(small_rig: Rig, camera_and_truth: tuple) -> None:
    camera, truth = camera_and_truth
    points = (camera.centre_world + truth.depth[..., None] * rays_world(camera))[interior(truth)]
    surface = sample_surface(small_rig.bust, 60_000, np.random.default_rng(0))
    distance, _ = cKDTree(surface.points).query(points)
    # 60,000 points on about 0.4 m^2 are 2.6 mm apart: the nearest is 1.3 mm away at the median, when all is
    # well.
    assert np.median(distance) < 0.002


def test_truth_is_empty_off_the_head_and_plausible_on_it(camera_and_truth: tuple) -> None:
    _, truth = camera_and_truth
    off, on = truth.mask == 0, truth.mask == 1
    assert on.mean() > 0.2
    assert off.mean() > 0.1
    assert not truth.albedo[off].any()
    assert not truth.depth[off].any()
    assert truth.albedo[on].min() > 0
    assert truth.albedo[on].max() < 0.9
    assert np.allclose(np.linalg.norm(truth.normals_world[on], axis=-1), 1, atol=1e-5)
    assert 0.4 < np.median(truth.depth[on]) < 0.65


def test_directional_lights_follow_their_formula_and_all_lights_stay_on_the_head(
    small_rig: Rig, camera_and_truth: tuple
) -> None:
    camera, truth = camera_and_truth
    pictures = relit(small_rig, camera, truth)
    assert list(pictures) == ["dir1", "dir2", "dir3", "env1", "env2", "point"]
    for name, to_light in DIRECTIONS.items():
        cosine = np.maximum(0, truth.normals_world @ np.array(to_light))
        assert np.allclose(
            pictures[name], truth.albedo * (AMBIENT + (1 - AMBIENT) * cosine)[..., None], atol=1e-5
        )
    for picture in pictures.values():
        assert np.isfinite(picture).all()
        assert picture.min() >= 0
        assert not picture[truth.mask == 0].any()
        assert 0.01 < picture[truth.mask == 1].mean() < 1


def test_the_point_light_leaves_cast_shadows(small_rig: Rig, camera_and_truth: tuple) -> None:
    camera, truth = camera_and_truth
    position = np.array([-0.55, 0.45, 0.55])
    points = camera.centre_world + truth.depth[..., None] * rays_world(camera)
    to_light = position - points
    to_light /= np.linalg.norm(to_light, axis=-1, keepdims=True)
    towards = (np.einsum("hwc,hwc->hw", truth.normals_world, to_light) > 0.4) & interior(truth)
    dark = relit(small_rig, camera, truth)["point"].max(-1) < 1e-3
    # A lamp from the upper right of the picture: nose and chin shade parts that face it.
    assert 0.005 < dark[towards].mean() < 0.5


def test_the_stereo_cloud_has_noise_and_outliers_as_stereo_has(small_rig: Rig) -> None:
    cameras = [small_rig.camera(t, "x").scaled(3.0) for t in (0.2, 0.85, 1.5)]
    cloud = stereo_cloud(small_rig.bust, cameras, 20_000, np.random.default_rng(1))
    assert cloud.normals is None
    assert cloud.colors is None
    assert 18_000 < len(cloud.points) < 20_000  # the holes
    exact = sample_surface(small_rig.bust, 400_000, np.random.default_rng(2))
    tree = cKDTree(exact.points)
    distance, nearest = tree.query(cloud.points)
    assert exact.normals is not None
    height = np.abs(np.einsum("pc,pc->p", cloud.points - exact.points[nearest], exact.normals[nearest]))
    # Ray noise of 0.5 mm at a slant and bumps of up to 0.4 mm: a median height of 0.2 to 0.6 mm.
    assert 0.0002 < np.median(height) < 0.0006
    assert 0.004 < (distance > 0.005).mean() < 0.02
