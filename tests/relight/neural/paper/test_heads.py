"""The eight channels become maps with the paper's non-linearities, finite wherever the network goes."""

import numpy as np
import pytest
import torch

from relight.neural.paper.heads import neural_maps, unit


def test_channels_become_albedo_normals_shading_and_mask():
    channels = np.random.default_rng(0).normal(size=(8, 5, 6))
    maps = neural_maps(torch.from_numpy(channels)[None])
    sigmoid = 1.0 / (1.0 + np.exp(-channels))
    # The maps are float32.
    np.testing.assert_allclose(maps.albedo, sigmoid[:3], atol=1e-6)
    np.testing.assert_allclose(maps.shading, sigmoid[6:7], atol=1e-6)
    np.testing.assert_allclose(maps.mask, sigmoid[7:8], atol=1e-6)
    length = np.linalg.norm(channels[3:6], axis=0)
    # Divided by sqrt(length^2 + 1e-6): at a length of 0.1 that is 5e-5 less than unit.
    np.testing.assert_allclose(maps.normals_world, channels[3:6] / length, atol=1e-4)


@pytest.mark.parametrize("size", [0.0, 1e-30, 1e-6, 1e-3, 1.0, 1e6, 1e18])
def test_the_normals_gradient_is_finite_at_and_about_zero(size):
    vectors = torch.full((3, 2, 2), size, requires_grad=True)
    normals = unit(vectors)
    normals.sum().backward()
    assert bool(normals.isfinite().all())
    assert bool((vectors.grad.abs() <= 1000.0).all())
    if size == 0.0:
        assert not normals.any()


@pytest.mark.parametrize("value", [-1e4, 0.0, 1e4])
def test_maps_are_finite_where_the_network_saturates(value):
    channels = torch.full((1, 8, 2, 2), value, requires_grad=True)
    maps = neural_maps(channels)
    sum(each.sum() for each in vars(maps).values()).backward()
    assert bool(channels.grad.isfinite().all())


def test_gradcheck_also_at_the_zero_normal():
    vectors = torch.randn(3, 2, 2, dtype=torch.float64)
    vectors[:, 0, 0] = 0.0
    # Finite differences step by a ten-thousandth of the length at which the normal begins to be unit.
    assert torch.autograd.gradcheck(unit, vectors.requires_grad_(True), eps=1e-7, atol=1e-3)
