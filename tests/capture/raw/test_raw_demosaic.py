"""Colours of mosaics: exact where they must be, linear everywhere."""

import numpy as np
import pytest

from capture.raw.demosaic import binned, demosaic_bayer, is_bayer, touched_by

CELLS = {
    "RGGB": [[0, 1], [1, 2]],
    "BGGR": [[2, 1], [1, 0]],
    "GRBG": [[1, 0], [2, 1]],
    "GBRG": [[1, 2], [0, 1]],
}


def cell_of(name):
    return np.array(CELLS[name], np.uint8)


@pytest.mark.parametrize("name", CELLS)
def test_measured_samples_stay_and_flat_colours_are_exact(make, name):
    picture = np.broadcast_to(np.float32([0.3, 0.6, 0.2]), (20, 22, 3))
    mosaic = make.mosaic_of(picture, name)
    np.testing.assert_allclose(demosaic_bayer(mosaic, cell_of(name)), picture, rtol=1e-6)  # float32
    noise = np.random.default_rng(0).normal(size=(20, 22)).astype(np.float32)
    again = make.mosaic_of(demosaic_bayer(noise, cell_of(name)), name)
    assert np.array_equal(again, noise)


@pytest.mark.parametrize("name", CELLS)
def test_grey_detail_up_to_second_order_is_exact_away_from_the_edge(make, name):
    # Malvar's corrections are second differences: on a grey paraboloid they are what the means lack.
    y, x = np.mgrid[0:20, 0:22] / 20
    grey = 0.5 + 0.2 * x - 0.1 * y
    picture = np.repeat(grey[..., None], 3, axis=2).astype(np.float32)
    found = demosaic_bayer(make.mosaic_of(picture, name), cell_of(name))
    np.testing.assert_allclose(found[2:-2, 2:-2], picture[2:-2, 2:-2], rtol=2e-6)


def test_lit_minus_unlit_is_the_flash_alone():
    rng = np.random.default_rng(1)
    room, flash = rng.uniform(size=(2, 30, 30)).astype(np.float32)
    cell = cell_of("RGGB")
    difference = demosaic_bayer(room + flash, cell) - demosaic_bayer(room, cell)
    np.testing.assert_allclose(difference, demosaic_bayer(flash, cell), atol=2e-6)  # float32 sums


@pytest.mark.parametrize("name", CELLS)
def test_the_pixels_that_a_sample_touches_are_the_ones_that_it_changes(name):
    cell = cell_of(name)
    changed = np.zeros((24, 24), bool)
    for row in (10, 11):
        for column in (10, 11):
            sample = np.zeros((24, 24), np.float32)
            sample[row, column] = 1
            touched = touched_by(sample > 0)
            moved = (demosaic_bayer(sample, cell) != 0).any(axis=2)
            assert (touched | ~moved).all()
            changed |= moved
    assert changed.sum() > 13
    assert touched_by(sample > 0, margin=3).sum() == 49


def test_one_pixel_a_cell_is_the_mean_of_its_samples(make):
    picture = np.random.default_rng(2).uniform(size=(9, 12, 3)).astype(np.float32)
    small = binned(make.mosaic_of(picture, "GRBG"), cell_of("GRBG"))
    assert small.shape == (4, 6, 3)
    assert small[1, 2, 0] == picture[2, 5, 0]
    assert small[1, 2, 1] == pytest.approx((picture[2, 4, 1] + picture[3, 5, 1]) / 2)


def test_other_cells_are_refused():
    assert not is_bayer(np.array([[0, 1], [2, 1]], np.uint8))
    assert not is_bayer(np.zeros((6, 6), np.uint8))
    with pytest.raises(ValueError, match="no Bayer cell"):
        demosaic_bayer(np.zeros((8, 8), np.float32), np.array([[0, 0], [1, 2]], np.uint8))
