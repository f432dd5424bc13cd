import numpy as np
import pytest

from calib.lens.bundle import observations_of
from calib.lens.intrinsics import calibrate_intrinsics
from calib.lens.models import choose_model, free_of, with_only
from calib.lens.terms import LENS_MODELS


@pytest.mark.parametrize(
    ("terms", "least"),
    [
        ([0.0, 0, 0, 0, 0], "none"),
        ([-0.2, 0, 0, 0, 0], "k1"),
        ([-0.2, 0.15, 0, 0, 0], "k1k2"),
        ([-0.2, 0.15, 0.003, -0.002, 0], "k1k2p1p2"),
        ([-0.2, 0.3, 0.003, -0.002, -0.9], "k1k2p1p2k3"),
    ],
)
def test_no_term_that_the_lens_has_is_left_out(make_views, board, lens, terms, least):
    truth = np.concatenate([lens[:4], terms])
    views, _ = make_views(np.random.default_rng(1), 16, noise_px=0.05, lens=truth)
    result = calibrate_intrinsics(views, board)
    names = list(LENS_MODELS)
    assert names.index(result.model) >= names.index(least)
    chosen = next(t for t in result.trials if (t.model, t.bent) == (result.model, result.bend_m is not None))
    assert chosen.held_out_px == min(trial.held_out_px for trial in result.trials)
    # The noise of two coordinates, and a few hundredths for what poses and lens take from it.
    assert chosen.held_out_px == pytest.approx(0.05, rel=0.1)
    # Terms without need are at most within their uncertainty of zero.
    assert (np.abs(result.lens - truth)[result.sigma > 0] < 4.5 * result.sigma[result.sigma > 0]).all()


def test_a_bent_board_is_not_taken_for_distortion(make_views, board, lens):
    views, _ = make_views(np.random.default_rng(2), 16, noise_px=0.05, bend_m=0.002)
    result = calibrate_intrinsics(views, board)
    assert result.bend_m == pytest.approx([0.002, 0.0], abs=2e-4)
    free = result.sigma > 0
    assert (np.abs(result.lens - lens)[free] < 4.5 * result.sigma[free]).all()


def test_a_smaller_model_starts_without_the_others_terms(make_views, board):
    views, _ = make_views(np.random.default_rng(3), 8)
    result = calibrate_intrinsics(views, board, "k1k2p1p2k3")
    small = with_only(result.solution, free_of("k1", False))
    assert small.shared[5:].tolist() == [0.0] * 6
    assert small.shared[4] == result.solution.shared[4]
    best, trials = choose_model(observations_of(views, board), result.solution, ["k1", "k1k2"])
    assert {trial.model for trial in trials} == {"k1", "k1k2"}
    assert best in trials
