"""Delta is a perceptual term plus 2500 times the L1 of pictures averaged over 4 x 4 pixels."""

import numpy as np
import torch

from relight.neural.losses.mismatch import BETA, POOL_PX, Mismatch, pooled_l1

RANDOM = np.random.default_rng(0)


def plain_l1(first, second, size):
    """Block after block."""
    deviations = []
    for row in range(0, first.shape[2] - size + 1, size):
        for column in range(0, first.shape[3] - size + 1, size):
            block = np.s_[:, :, row : row + size, column : column + size]
            deviations.append(np.abs(first[block].mean(axis=(2, 3)) - second[block].mean(axis=(2, 3))))
    return np.mean(deviations)


def test_the_l1_is_that_of_the_averages():
    first, second = RANDOM.random((2, 1, 3, 16, 14))
    found = pooled_l1(torch.from_numpy(first), torch.from_numpy(second))
    np.testing.assert_allclose(found, plain_l1(first, second, POOL_PX), rtol=1e-12)


def test_noise_within_a_block_costs_nothing():
    checker = torch.tensor([[0.0, 1.0], [1.0, 0.0]]).repeat(4, 4).expand(1, 3, 8, 8)
    assert float(pooled_l1(checker, torch.full_like(checker, 0.5))) == 0.0


def test_delta_has_the_papers_beta():
    first, second = torch.rand(2, 1, 3, 16, 16, generator=torch.Generator().manual_seed(0)).double()
    mismatch = Mismatch(lambda a, b: 3.0 * (a - b).abs().sum())
    expected = 3.0 * (first - second).abs().sum() + 2500.0 * pooled_l1(first, second)
    np.testing.assert_allclose(mismatch(first, second), expected, rtol=1e-12)
    assert (BETA, POOL_PX) == (2500.0, 4)


def test_equal_pictures_have_a_finite_gradient():
    picture = torch.full((1, 3, 8, 8), 0.5, requires_grad=True)
    pooled_l1(picture, picture.detach()).backward()
    assert not picture.grad.any()


def test_gradcheck():
    first, second = (torch.from_numpy(RANDOM.random((1, 3, 8, 8))).requires_grad_(True) for _ in range(2))
    assert torch.autograd.gradcheck(pooled_l1, (first, second))
