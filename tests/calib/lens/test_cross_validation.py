import numpy as np

from calib.lens.bundle import observations_of
from calib.lens.cross_validation import compare_halves, covered
from calib.lens.intrinsics import calibrate_intrinsics
from calib.lens.models import free_of
from calib.lens.uncertainty import pixel_grid

FREE = free_of("k1k2p1p2", False)


def test_halves_of_sound_pictures_agree(make_views, fit, size):
    grid, _ = pixel_grid(size, 16)
    chances = []
    for seed in range(12):
        views, poses = make_views(np.random.default_rng(seed), 16)
        observations, found, _ = fit(views, poses, FREE)
        checks = compare_halves(observations, found, FREE, grid)
        assert [check.split for check in checks] == ["every other picture", "first and second half"]
        chances += [check.chance for check in checks]
        assert all(check.rms_px < 4 * check.expected_px for check in checks)
    # Evenly spread chances: 24 of them have a mean of 0.5 +- 0.06, and few are small.
    assert 0.3 < np.mean(chances) < 0.7
    assert sum(chance < 0.01 for chance in chances) <= 1


def test_a_zoom_between_the_halves_is_seen(make_views, board, lens):
    rng = np.random.default_rng(3)
    first, _ = make_views(rng, 12, noise_px=0.05)
    zoomed = lens * [1.02, 1.02, 1, 1, 1, 1, 1, 1, 1]
    second, _ = make_views(rng, 12, noise_px=0.05, lens=zoomed)
    result = calibrate_intrinsics([*first, *second], board)
    half = next(check for check in result.halves if check.split == "first and second half")
    assert not half.agrees
    assert any("the lens moved" in sentence for sentence in result.warnings)
    # Two percent of 420 px: the truths of both halves lie within the widened uncertainty.
    assert abs(result.lens[0] - 424.2) < 4 * result.sigma[0]


def test_only_what_the_board_covered_is_compared(make_views, board, size):
    views, _ = make_views(np.random.default_rng(4), 8)
    observations = observations_of(views, board)
    corners = observations.pixels[observations.seen]
    assert covered(observations, corners).mean() > 0.99
    assert not covered(observations, np.array([[-5.0, -5.0], [size[0] + 5.0, 10.0]])).any()
