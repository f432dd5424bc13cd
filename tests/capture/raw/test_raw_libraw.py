"""LibRaw's demosaicing of our samples: what is measured stays, nothing is cut; how far a sample reaches."""

import numpy as np
import pytest

from capture.errors import ImageError
from capture.raw.libraw import binned, demosaic, is_bayer, touched_by

CELLS = {
    "RGGB": [[0, 1], [1, 2]],
    "BGGR": [[2, 1], [1, 0]],
    "GRBG": [[1, 0], [2, 1]],
    "GBRG": [[1, 2], [0, 1]],
}
HEIGHT, WIDTH = 40, 44


def cell_of(name):
    return np.array(CELLS[name], np.uint8)


@pytest.fixture
def file_of(make, tmp_path):
    """Writes a DNG whose samples do not matter."""

    def write(pattern, shape=(HEIGHT, WIDTH), **tags):
        path = tmp_path / f"{pattern}.dng"
        path.write_bytes(make.dng(np.full(shape, 5000), pattern=pattern, **tags))
        return path

    return write


@pytest.mark.parametrize("name", CELLS)
def test_measured_samples_stay_over_any_range(make, file_of, name):
    noise = np.random.default_rng(0).normal(0.5, 2.0, (HEIGHT, WIDTH)).astype(np.float32)
    picture, missing = demosaic(file_of(name, black=64.0, white=4095), noise, cell_of(name))
    step = (1.1 * noise.max() - 2 * noise.min()) / 65534
    # half a step of rounding, and float32
    assert np.abs(make.mosaic_of(picture, name) - noise).max() < 0.51 * step
    assert not missing.any()


@pytest.mark.parametrize("name", CELLS)
def test_flat_colours_are_exact_in_every_pixel(make, file_of, name):
    colour = np.float32([0.3, 0.6, 0.2])
    mosaic = make.mosaic_of(np.broadcast_to(colour, (HEIGHT, WIDTH, 3)), name)
    picture, _ = demosaic(file_of(name), mosaic, cell_of(name))
    # A step is 1e-5; interpolation adds and subtracts a few rounded samples.
    assert np.abs(picture - colour).max() < 3e-5


@pytest.mark.parametrize("name", CELLS)
def test_a_sample_reaches_no_pixel_that_it_is_not_said_to_touch(file_of, name):
    path, cell = file_of(name), cell_of(name)
    mosaic = np.random.default_rng(1).uniform(0.2, 0.8, (HEIGHT, WIDTH)).astype(np.float32)
    mosaic[0, 0] = 1.0  # fixes the range, so that both are rounded alike
    before, _ = demosaic(path, mosaic, cell)
    moved = np.zeros((HEIGHT, WIDTH), bool)
    for row in (18, 19):
        for column in (20, 21):
            for value in (0.0, 1.0):
                changed = mosaic.copy()
                changed[row, column] = value
                after, _ = demosaic(path, changed, cell)
                here = np.zeros_like(moved)
                here[row, column] = True
                moved = (after != before).any(axis=2)
                assert (touched_by(here, cell) | ~moved).all()
    assert moved.sum() > 5


def test_one_pixel_a_cell_is_the_mean_of_its_samples(make):
    picture = np.random.default_rng(2).uniform(size=(9, 12, 3)).astype(np.float32)
    small = binned(make.mosaic_of(picture, "GRBG"), cell_of("GRBG"))
    assert small.shape == (4, 6, 3)
    assert small[1, 2, 0] == picture[2, 5, 0]
    assert small[1, 2, 1] == pytest.approx((picture[2, 4, 1] + picture[3, 5, 1]) / 2)


def test_the_four_bayer_cells_are_known_from_others():
    assert all(is_bayer(cell_of(name)) for name in CELLS)
    assert not is_bayer(np.array([[0, 1], [2, 1]], np.uint8))
    assert not is_bayer(np.zeros((6, 6), np.uint8))


def test_samples_of_another_size_are_refused(file_of):
    for shape, corner in (((8, 8), (0, 0)), ((HEIGHT, WIDTH), (1, 0))):
        with pytest.raises(ImageError, match="light-sensitive area"):
            demosaic(file_of("RGGB"), np.zeros(shape, np.float32), cell_of("RGGB"), corner)
