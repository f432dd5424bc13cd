"""Total variation is the mean L1 of neighbouring differences."""

import numpy as np
import pytest
import torch

from relight.neural.losses.total_variation import total_variation


def test_it_is_the_plain_mean_of_differences():
    image = np.random.default_rng(0).random((1, 5, 7))
    rows = [abs(image[0, r + 1, c] - image[0, r, c]) for r in range(4) for c in range(7)]
    columns = [abs(image[0, r, c + 1] - image[0, r, c]) for r in range(5) for c in range(6)]
    found = total_variation(torch.from_numpy(image))
    np.testing.assert_allclose(found, np.mean(rows) + np.mean(columns), rtol=1e-12)


@pytest.mark.parametrize("shape", [(1, 6, 6), (1, 1, 1), (1, 1, 6), (3, 6, 1)])
def test_a_constant_image_has_none_and_a_finite_gradient(shape):
    image = torch.full(shape, 0.3, requires_grad=True)
    variation = total_variation(image)
    assert float(variation.detach()) == 0.0
    if variation.requires_grad:
        variation.backward()
        assert not image.grad.any()


def test_a_step_counts_as_much_as_a_ramp_of_its_height():
    step, ramp = torch.zeros(1, 1, 11), torch.linspace(0, 1, 11).view(1, 1, 11)
    step[..., 5:] = 1.0
    np.testing.assert_allclose(total_variation(step), total_variation(ramp), rtol=1e-6)


def test_gradcheck():
    image = torch.rand(1, 4, 5, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(total_variation, image)
