"""What the network sees of a view, and what it can and cannot change of it."""

from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from analytic_scene import looking_at

from relight.alignment import Similarity
from relight.maps import splat_maps
from relight.neural.refined.layers import (
    CHANGES,
    FEATURES,
    STACKED,
    Layers,
    changed,
    features,
    layers_of,
    stacked,
    strided,
    unstacked,
)

CAMERA = looking_at(np.array([0.1, 0.05, 0.45]), np.zeros(3), size=56, flash=1)
LEAST, MOST = 1e-3, 0.999
LIMIT = 0.7


@pytest.fixture(scope="module")
def layers(solved):
    return layers_of(splat_maps(solved, CAMERA))


def even(size, mask=1.0, dtype=torch.float32):
    """Layers of an even patch."""
    three = torch.full((size, size, 3), 0.5, dtype=dtype)
    one = torch.full((size, size), mask, dtype=dtype)
    return Layers(three, three, three, one, one, 0.1 * one, one, three, torch.ones_like(three))


def random_changes(height, width, seed=0, dtype=torch.float32):
    return torch.randn(CHANGES, height, width, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def test_without_changes_all_stays_as_it_is_and_the_mask_within_what_a_logit_can_hold(layers):
    after = changed(layers, torch.zeros(CHANGES, 56, 56))
    for field in fields(Layers):
        if field.name != "mask":
            np.testing.assert_array_equal(getattr(after, field.name), getattr(layers, field.name))
    off = layers.mask == 0
    assert not after.mask[off].any()
    # To the logit and back loses a few of float32's digits, and full coverage the clamp's thousandth.
    np.testing.assert_allclose(after.mask[~off], layers.mask[~off].clamp(LEAST, MOST), atol=1e-6)


def test_albedo_normals_points_confidence_and_gloss_cannot_be_changed(layers):
    after = changed(layers, 100.0 * random_changes(56, 56))
    for name in ("albedo", "normals_world", "points_world", "confidence", "gloss", "flash_bounce"):
        assert getattr(after, name) is getattr(layers, name)


def test_however_large_the_changes_each_stays_within_its_bound(layers):
    for size in (1.0, 1e3, 1e30):
        after = changed(layers, size * random_changes(56, 56))
        on = layers.mask > 0
        for name, limit in (("room_radiance", LIMIT), ("flash_gain", LIMIT)):
            before, now = getattr(layers, name)[on], getattr(after, name)[on]
            assert bool((now <= np.exp(limit) * before * 1.00001).all())
            assert bool((now >= np.exp(-limit) * before * 0.99999).all())
        assert bool(((after.mask >= 0) & (after.mask <= 1)).all())
        assert not after.mask[~on].any()


def test_gradients_are_those_of_finite_differences():
    size = 6
    random = torch.Generator().manual_seed(4)
    mask = torch.rand(size, size, generator=random, dtype=torch.float64) * 0.9 + 0.05
    mask[0] = 0.0
    layers = replace(even(size, dtype=torch.float64), mask=mask)
    changes = random_changes(size, size, dtype=torch.float64).requires_grad_()

    def of(values):
        after = changed(layers, values)
        return after.room_radiance, after.flash_gain, after.mask

    torch.autograd.gradcheck(of, (changes,))


def test_gradients_are_finite_where_the_mask_is_empty_or_full_and_changes_are_huge():
    for mask in (0.0, 1.0, 1e-3):
        for size in (0.0, 1e4):
            changes = (size * random_changes(8, 8)).requires_grad_()
            after = changed(even(8, mask), changes)
            (after.flash_gain.sum() + after.room_radiance.sum() + after.mask.sum()).backward()
            assert bool(changes.grad.isfinite().all())


def test_a_view_is_kept_as_a_stack_and_comes_back(solved, layers):
    stack = stacked(splat_maps(solved, CAMERA))
    assert stack.shape == (STACKED, 56, 56)
    again = unstacked(stack, CAMERA)
    on = layers.mask > 0
    for field in fields(Layers):
        # Normals are made unit and points are unprojected once more, in float32.
        before, after = getattr(layers, field.name)[on], getattr(again, field.name)[on]
        np.testing.assert_allclose(after, before, atol=1e-6, err_msg=field.name)


def test_features_are_finite_and_0_off_the_subject(layers):
    seen = features(layers, CAMERA, torch.eye(3))
    assert seen.shape == (FEATURES, 56, 56)
    assert bool(seen.isfinite().all())
    assert not seen[:, layers.mask == 0].any()
    assert float(seen.abs().max()) <= 4.0  # of the gloss; all else is of the order of one
    broken = replace(layers, normals_world=torch.zeros(56, 56, 3), albedo=-layers.albedo)
    assert bool(features(broken, CAMERA, torch.eye(3)).isfinite().all())


def test_in_a_turned_world_the_network_sees_the_same(layers):
    """Layers as they would be there: the same pixels, every vector turned and every point moved."""
    turn, _ = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    similarity = Similarity(2.5, turn, np.array([0.3, -0.4, 0.2]))
    turned = torch.from_numpy(turn).float()
    there = replace(
        layers,
        normals_world=layers.normals_world @ turned.T,
        points_world=2.5 * layers.points_world @ turned.T + torch.tensor([0.3, -0.4, 0.2]),
    )
    here = features(layers, CAMERA, torch.eye(3))
    after = features(there, similarity.camera(CAMERA), turned.T)
    # Unit vectors from points half a metre away, in float32.
    np.testing.assert_allclose(after, here, atol=1e-5)
    # Without the way back it would see another room.
    assert float((features(there, similarity.camera(CAMERA), torch.eye(3)) - here).abs().max()) > 0.1


def test_ids_of_coarser_scales_are_those_at_the_squares_middles():
    ids = torch.arange(16 * 24).view(16, 24)
    levels = strided(ids, 4)
    assert [tuple(level.shape) for level in levels] == [(16, 24), (8, 12), (4, 6), (2, 3)]
    for t, level in enumerate(levels):
        side = 1 << t
        for i, row in enumerate(level.tolist()):
            for j, found in enumerate(row):
                assert found == ids[side * i + side // 2, side * j + side // 2]
