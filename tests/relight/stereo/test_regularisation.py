import numpy as np
import torch

from relight.stereo.semiglobal import regularised
from relight.stereo.thin_plate import smoothed


def test_flat_costs_take_the_labels_of_those_that_know():
    cost = torch.full((9, 30, 8), 0.5)
    cost[:, :8, 3] = cost[:, -8:, 3] = 0.0
    labels = regularised(cost, 0.1, torch.full((9, 30), 0.5)).argmin(dim=2)
    assert (labels == 3).all()


def test_a_single_wrong_pixel_is_outvoted_and_an_edge_stays():
    cost = torch.ones(15, 20, 6)
    cost[:, :10, 1] = cost[:, 10:, 4] = 0.0
    cost[7, 4] = 1.0
    cost[7, 4, 5] = 0.6
    for diagonals in (False, True):
        labels = regularised(cost, 0.1, torch.full((15, 20), 0.4), diagonals).argmin(dim=2)
        assert (labels[:, :10] == 1).all()
        assert (labels[:, 10:] == 4).all()


def test_every_direction_counts_the_same():
    cost = torch.rand(7, 7, 5, generator=torch.Generator().manual_seed(2))
    penalty = torch.full((7, 7), 0.3)
    for diagonals in (False, True):
        total = regularised(cost, 0.1, penalty, diagonals)
        for flipped in (cost.flip(0), cost.flip(1), cost.transpose(0, 1)):
            other = regularised(flipped.contiguous(), 0.1, penalty, diagonals)
            same = other.flatten().sort().values
            assert torch.allclose(same, total.flatten().sort().values, atol=1e-5)  # order of float32 sums


def test_a_plane_costs_nothing_whatever_its_slant():
    rows, columns = torch.meshgrid(torch.arange(20.0), torch.arange(24.0), indexing="ij")
    plane = 3.0 + 0.7 * rows - 0.4 * columns
    found = smoothed(plane, torch.ones_like(plane), 100.0, 0.5)
    assert torch.allclose(found, plane, atol=1e-3)  # float32 of values up to 20


def test_noise_goes_and_a_gap_is_spanned():
    rows, columns = torch.meshgrid(torch.arange(40.0), torch.arange(40.0), indexing="ij")
    true = 0.01 * (rows - 20) ** 2 * 0.2 + 0.1 * columns
    noise = 0.2 * torch.randn(40, 40, generator=torch.Generator().manual_seed(3))
    weight = torch.ones(40, 40)
    weight[15:22, 15:22] = 0.0
    found = smoothed(true + noise + 3.0 * (weight == 0), weight, 30.0, 2.0, iterations=200)
    error = (found - true)[3:-3, 3:-3]
    assert error.pow(2).mean().sqrt() < 0.06  # noise 0.2 over some 50 effective pixels, and the gap
    assert error.abs().max() < 0.3


def test_a_step_stays_where_it_is():
    step = torch.zeros(20, 20)
    step[:, 10:] = 8.0
    found = smoothed(step, torch.ones(20, 20), 100.0, 0.5)
    assert (found - step).abs().max() < 0.4  # of 8: the first, wider look at creases rounds it a little


def test_nothing_known_stays_finite():
    found = smoothed(torch.rand(12, 12), torch.zeros(12, 12), 10.0, 0.5)
    assert np.isfinite(found.numpy()).all()
