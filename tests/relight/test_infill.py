"""Values of unknown points come from known ones near by, and known points keep theirs."""

import numpy as np
import pytest
import torch

from relight.infill import infill

KNOWN = 0.25


def line(count):
    return torch.stack([torch.arange(count) * 1.0, torch.zeros(count), torch.zeros(count)], dim=1)


def test_well_known_points_keep_their_values():
    random = torch.Generator().manual_seed(0)
    values = torch.rand(50, 3, generator=random)
    information = torch.where(torch.arange(50) % 2 == 0, 2 * KNOWN, 0.0)
    filled = infill(line(50), values, information, known=KNOWN, nearest=1.0)
    np.testing.assert_array_equal(filled[::2], values[::2])


def test_an_unknown_point_is_the_mean_of_its_neighbours_by_inverse_square_distance():
    points = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [-3.0, 0, 0]])
    values = torch.tensor([[9.0], [2.0], [6.0]])
    filled = infill(points, values, torch.tensor([0.0, 1.0, 1.0]), known=KNOWN, nearest=0.0)
    assert filled[0, 0].item() == pytest.approx((2.0 / 1 + 6.0 / 9) / (1 + 1 / 9), rel=1e-6)  # float32


def test_a_half_known_point_is_blended():
    points, values = line(2), torch.tensor([[0.0], [1.0]])
    filled = infill(points, values, torch.tensor([KNOWN, 10.0]), known=KNOWN, nearest=1.0)
    # Information equal to `known` counts as much as the neighbours.
    assert filled[0, 0].item() == pytest.approx(0.5, rel=1e-6)


def test_a_constant_stays_the_constant():
    information = torch.rand(200, generator=torch.Generator().manual_seed(0))
    filled = infill(line(200), torch.full((200, 3), 0.37), information, known=KNOWN, nearest=1.0)
    np.testing.assert_allclose(filled, 0.37, rtol=1e-5)  # float32 sums of 24


def test_unknown_values_never_leak_into_others():
    values = torch.full((40, 1), torch.nan)
    values[::4] = 1.0
    information = torch.where(values[:, 0].isnan(), 0.0, 1.0)
    filled = infill(line(40), values.nan_to_num(1e30), information, known=KNOWN, nearest=1.0)
    np.testing.assert_allclose(filled, 1.0, rtol=1e-5)


@pytest.mark.parametrize("information", [0.0, 5.0])
def test_where_nothing_or_everything_is_known_values_stay(information):
    values = torch.rand(10, 3, generator=torch.Generator().manual_seed(0))
    filled = infill(line(10), values, torch.full((10,), information), known=KNOWN, nearest=1.0)
    np.testing.assert_array_equal(filled, values)


def test_points_at_one_place_and_no_points_are_finite():
    values = torch.rand(5, 2, generator=torch.Generator().manual_seed(0))
    information = torch.tensor([0.0, 1.0, 0.0, 1.0, 0.0])
    assert infill(torch.zeros(5, 3), values, information, known=KNOWN, nearest=1e-3).isfinite().all()
    empty = infill(torch.zeros(0, 3), torch.zeros(0, 2), torch.zeros(0), known=KNOWN, nearest=1.0)
    assert empty.shape == (0, 2)
