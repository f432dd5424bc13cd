"""A patch is what its camera would take of the frame, and its centre lies on the subject."""

import numpy as np
import pytest
import torch
from analytic_scene import looking_at

from relight.neural.crops import Crop, random_crop
from relight.raster import project

CAMERA = looking_at(np.array([0.1, 0.05, 0.5]), np.zeros(3), size=64)


def test_a_point_is_in_the_patch_where_it_was_in_the_frame():
    points = torch.from_numpy(np.random.default_rng(0).uniform(-0.1, 0.1, size=(50, 3)).astype(np.float32))
    whole, _ = project(points, CAMERA)
    crop = Crop(left=-5, top=12, side=30, size=48)
    patch, depth = project(points, crop.camera(CAMERA))
    # float32 pixels.
    np.testing.assert_allclose(patch, (whole - torch.tensor([-5.0, 12.0])) * 48 / 30, atol=2e-4)
    np.testing.assert_array_equal(depth, project(points, CAMERA)[1])


def test_a_patch_of_its_own_size_is_cut_out_and_0_beyond_the_frame():
    image = torch.arange(2 * 6 * 8).float().view(2, 6, 8) + 1
    patch = Crop(left=5, top=-2, side=4, size=4).of(image)
    expected = np.zeros((2, 4, 4))
    expected[:, 2:, :3] = image[:, :2, 5:]
    np.testing.assert_array_equal(patch, expected)
    assert not Crop(left=90, top=90, side=4, size=4).of(image).any()


def test_a_patch_that_shrinks_averages_and_one_that_grows_interpolates():
    ramp = torch.arange(16.0).view(1, 1, 16).expand(1, 16, 16)
    small = Crop(left=0, top=0, side=16, size=4).of(ramp)
    # A ramp stays a ramp: its values at the centres of the new pixels, away from the edge.
    np.testing.assert_allclose(small[0, 1, 1:3], [5.5, 9.5], atol=1e-5)
    flat = Crop(left=4, top=4, side=4, size=16).of(torch.full((1, 16, 16), 0.25))
    np.testing.assert_allclose(flat, 0.25, atol=1e-7)
    large = Crop(left=4, top=4, side=4, size=16).of(ramp)
    np.testing.assert_allclose(large[0, 8, 2:-2], 4 + (np.arange(2, 14) + 0.5) / 4 - 0.5, atol=1e-5)
    # What alternates faster than the new pixels becomes its mean, not one of its values.
    stripes = torch.tensor([0.0, 1.0]).repeat(16)[None, None].expand(1, 32, 32)
    np.testing.assert_allclose(Crop(0, 0, 32, 4).of(stripes)[0, :, 1:-1], 0.5, atol=0.02)


def test_centres_lie_on_the_subject_and_zooms_are_spread_evenly_in_their_logarithm():
    subject = torch.zeros(40, 60, dtype=torch.bool)
    subject[5:9, 30:50] = True
    chance = torch.Generator().manual_seed(0)
    crops = [random_crop(subject, 16, (0.5, 2.0), chance) for _ in range(2000)]
    rows = [crop.top + crop.side // 2 for crop in crops]
    columns = [crop.left + crop.side // 2 for crop in crops]
    assert (min(rows), max(rows), min(columns), max(columns)) == (5, 8, 30, 49)
    zooms = np.log([16 / crop.side for crop in crops])
    assert np.log(0.5) <= zooms.min() <= zooms.max() <= np.log(2.0)
    # Standard error of the mean of 2000 even draws from a width of 1.39: 0.009.
    assert abs(zooms.mean()) < 0.03
    assert abs(zooms.std() - np.log(4) / np.sqrt(12)) < 0.02


@pytest.mark.parametrize("subject", [torch.zeros(3, 5, dtype=torch.bool), torch.ones(3, 5, dtype=torch.bool)])
def test_without_a_subject_the_whole_picture_counts(subject):
    crop = random_crop(subject, 16, (1.0, 1.0), torch.Generator().manual_seed(3))
    assert crop.side == 16
    assert 0 <= crop.top + 8 < 3
    assert 0 <= crop.left + 8 < 5
