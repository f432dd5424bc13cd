"""The fast rasteriser against the plain one, its independence of order and threads, and its gradient."""

import numpy as np
import pytest
import torch
from analytic_scene import looking_at
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from capture.cameras import Camera
from relight.raster import (
    NEAR_M,
    gather_descriptors,
    project,
    rasterize_ids,
    rasterize_ids_reference,
)

DEVICES = [
    "cpu",
    pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA card")),
]


def straight_camera(width, height, focal_px=32.0):
    """At the origin, looking along +z; with a power of two as focal length float32 makes no rounding."""
    K = np.array([[focal_px, 0, width / 2], [0, focal_px, height / 2], [0, 0, 1]])
    return Camera("straight", width, height, K, np.eye(4))


def random_points(count, seed=0):
    return (np.random.default_rng(seed).normal(size=(count, 3)) * 0.05).astype(np.float32)


def as_arrays(pyramid):
    return [level.cpu().numpy() for level in pyramid.ids]


# Clouds in which everything can go wrong: halves and quarters, so that depths are often equal, pixels are hit
# exactly on their borders and both computations are free of rounding; planes at and behind the camera; NaN.
awkward = st.sampled_from(
    [0.0, 0.25, 0.5, 1.0, 2.0, -1.0, -0.5, NEAR_M / 2, np.inf, -np.inf, np.nan, 2.0**100]
)
clouds = hnp.arrays(np.float32, st.tuples(st.integers(0, 30), st.just(3)), elements=awkward)


@given(points=clouds, width=st.integers(1, 19), height=st.integers(1, 19), levels=st.integers(1, 6))
@pytest.mark.parametrize("device", DEVICES)
def test_fast_equals_plain_on_awkward_clouds(device, points, width, height, levels):
    camera = straight_camera(width, height)
    fast = rasterize_ids(torch.from_numpy(points).to(device), camera, levels)
    for ids, expected in zip(as_arrays(fast), rasterize_ids_reference(points, camera, levels), strict=True):
        np.testing.assert_array_equal(ids, expected)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(("width", "height"), [(64, 64), (37, 53), (1, 1)])
def test_fast_equals_plain_from_any_pose(device, width, height):
    points = random_points(1500)
    camera = looking_at(np.array([0.2, 0.1, 0.4]), np.zeros(3), focal_px=1.75 * width)
    K = camera.K.copy()
    K[:2, 2] = width / 2, height / 2
    camera = Camera("any", width, height, K, camera.cam_from_world)
    # float32 moves a projection by about 1e-5 pixels and a depth by 1e-7: points that close to a border or to
    # another's depth may rightly go either way, so there are none in this cloud.
    uv_px, z = (a.numpy() for a in project(torch.from_numpy(points).double(), camera))
    clear = (np.abs(uv_px - np.rint(uv_px)) > 1e-3).all(axis=1)
    order = np.argsort(z)
    clear[order[1:][np.diff(z[order]) < 1e-6]] = False
    points = points[clear]
    assert len(points) > 1000
    fast = rasterize_ids(torch.from_numpy(points).to(device), camera, 4)
    for ids, expected in zip(as_arrays(fast), rasterize_ids_reference(points, camera, 4), strict=True):
        np.testing.assert_array_equal(ids, expected)
    assert (fast.ids[0] >= 0).any()


def test_order_of_points_changes_only_their_names():
    points = torch.from_numpy(random_points(3000))
    camera = looking_at(np.array([0.0, 0.0, 0.5]), np.zeros(3), size=48)
    order = torch.from_numpy(np.random.default_rng(1).permutation(len(points)))
    straight, shuffled = rasterize_ids(points, camera, 3), rasterize_ids(points[order], camera, 3)
    for a, b in zip(straight.ids, shuffled.ids, strict=True):
        np.testing.assert_array_equal(a, torch.where(b >= 0, order[b], -1))
    for a, b in zip(straight.depth_m, shuffled.depth_m, strict=True):
        np.testing.assert_array_equal(a, b)


def test_number_of_threads_changes_nothing():
    points = torch.from_numpy(random_points(40_000))
    points = torch.cat([points, points])  # every depth twice: the lower id has to win in every thread
    camera = looking_at(np.array([0.0, 0.0, 0.5]), np.zeros(3), size=32)
    threads = torch.get_num_threads()
    try:
        results = []
        for count in (1, 4):
            torch.set_num_threads(count)
            results.append(rasterize_ids(points, camera, 3))
    finally:
        torch.set_num_threads(threads)
    for a, b in zip(results[0].ids, results[1].ids, strict=True):
        np.testing.assert_array_equal(a, b)
    assert int(results[0].ids[0].max()) < 40_000


def test_depths_are_those_of_the_ids():
    points = torch.from_numpy(random_points(500))
    camera = looking_at(np.array([0.1, 0.0, 0.5]), np.zeros(3), size=24)
    _, z = project(points, camera)
    pyramid = rasterize_ids(points, camera, 3)
    for ids, depth in zip(pyramid.ids, pyramid.depth_m, strict=True):
        np.testing.assert_array_equal(depth, torch.where(ids >= 0, z[ids], torch.inf))


def test_projection_is_the_pinhole_of_the_conventions():
    camera = straight_camera(8, 6)
    uv_px, z = project(torch.tensor([[0.0, 0.0, 1.0], [0.125, -0.0625, 2.0]]), camera)
    # The optical axis meets the middle of the picture; y points down. All numbers are exact in binary.
    np.testing.assert_array_equal(uv_px, [[4.0, 3.0], [6.0, 2.0]])
    np.testing.assert_array_equal(z, [1.0, 2.0])


def test_sizes_halve_and_round_up():
    pyramid = rasterize_ids(torch.zeros(0, 3), straight_camera(13, 6), 5)
    assert [tuple(ids.shape) for ids in pyramid.ids] == [(6, 13), (3, 7), (2, 4), (1, 2), (1, 1)]
    assert all((ids == -1).all() for ids in pyramid.ids)
    assert all(torch.isinf(depth).all() for depth in pyramid.depth_m)


def test_one_point_is_one_pixel_of_every_level():
    pyramid = rasterize_ids(torch.tensor([[0.3, 0.2, 1.0]]), straight_camera(32, 32), 6)
    assert [int((ids == 0).sum()) for ids in pyramid.ids] == [1] * 6
    assert pyramid.ids[0][int(16 + 6.4), int(16 + 9.6)] == 0


def test_of_two_points_the_nearer_is_seen_and_of_equal_ones_the_first():
    points = torch.tensor([[0.0, 0.0, 2.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
    assert rasterize_ids(points, straight_camera(1, 1)).ids[0].item() == 1


def test_points_up_to_the_near_plane_are_left_out():
    z = torch.tensor([-1.0, 0.0, NEAR_M, NEAR_M * 1.001])
    points = torch.stack([torch.zeros(4), torch.zeros(4), z], dim=1)
    assert rasterize_ids(points, straight_camera(2, 2)).ids[0].max() == 3
    assert rasterize_ids(points[:3], straight_camera(2, 2)).ids[0].max() == -1


def test_a_pyramid_without_levels_is_refused():
    with pytest.raises(ValueError, match="at least one level"):
        rasterize_ids(torch.zeros(1, 3), straight_camera(2, 2), 0)


def test_gradient_of_descriptors_is_right_and_only_that_of_seen_points():
    points = torch.from_numpy(random_points(60))
    ids = rasterize_ids(points, looking_at(np.array([0.0, 0.0, 0.5]), np.zeros(3), size=6), 2).ids
    random = torch.Generator().manual_seed(0)
    descriptors = torch.randn(60, 3, dtype=torch.float64, generator=random, requires_grad=True)
    for level in ids:
        assert torch.autograd.gradcheck(lambda d, level=level: gather_descriptors(d, level), descriptors)
    gather_descriptors(descriptors, ids[0]).sum().backward()
    seen = ids[0][ids[0] >= 0]
    assert 0 < len(seen) < 60
    expected = torch.zeros(60).index_add_(0, seen, torch.ones(len(seen)))
    np.testing.assert_array_equal(descriptors.grad, expected[:, None].expand(60, 3))


def test_descriptors_come_out_as_an_image_with_zeros_where_nothing_is():
    ids = torch.tensor([[1, -1], [0, 1]])
    image = gather_descriptors(torch.tensor([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]), ids)
    np.testing.assert_array_equal(image[0], [[4, 0], [1, 4]])
    np.testing.assert_array_equal(image[2], [[6, 0], [3, 6]])


def test_descriptors_of_an_empty_picture_are_zero_and_pass_a_gradient():
    descriptors = torch.ones(5, 2, requires_grad=True)
    image = gather_descriptors(descriptors, torch.full((3, 4), -1))
    image.sum().backward()
    assert image.shape == (2, 3, 4)
    assert not image.any()
    assert not descriptors.grad.any()
