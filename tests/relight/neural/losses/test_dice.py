"""The mask's loss is minus the logarithm of the F1 score, and finite for empty masks."""

import numpy as np
import pytest
import torch

from relight.neural.losses.dice import dice, mask_loss

RANDOM = np.random.default_rng(0)


def test_of_sharp_masks_it_is_the_f1_score():
    mask, truth = RANDOM.random((2, 40, 50)) > 0.4
    hits = (mask & truth).sum()
    f1 = 2 * hits / (2 * hits + (mask & ~truth).sum() + (~mask & truth).sum())
    found = dice(torch.from_numpy(mask).double(), torch.from_numpy(truth).double())
    # A tenth of a pixel against a thousand.
    np.testing.assert_allclose(found, f1, atol=1e-4)


def test_of_soft_masks_it_is_the_plain_sum():
    mask, truth = RANDOM.random((2, 9, 11))
    expected = (2 * sum(m * t for m, t in zip(mask.ravel(), truth.ravel(), strict=True)) + 0.1) / (
        mask.sum() + truth.sum() + 0.1
    )
    found = mask_loss(torch.from_numpy(mask), torch.from_numpy(truth))
    np.testing.assert_allclose(found, -np.log(expected), rtol=1e-12)


def test_equal_masks_cost_nothing_though_they_are_empty():
    for mask in (torch.zeros(5, 5), torch.ones(5, 5)):
        assert float(mask_loss(mask, mask)) == 0.0


@pytest.mark.parametrize(("mask", "truth"), [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1e-30, 1.0)])
def test_loss_and_gradient_are_finite_at_the_ends(mask, truth):
    masks = torch.full((64, 64), mask, requires_grad=True)
    loss = mask_loss(masks, torch.full((64, 64), truth))
    loss.backward()
    assert bool(loss.isfinite())
    assert bool(masks.grad.isfinite().all())
    # Where there should be something and is nothing, more mask is asked for; where it is too much, less.
    if truth != mask:
        assert bool((masks.grad * (mask - truth) > 0).all())


def test_gradcheck():
    mask, truth = (torch.from_numpy(RANDOM.random((4, 5))).requires_grad_(True) for _ in range(2))
    assert torch.autograd.gradcheck(mask_loss, (mask, truth))
