"""The claimed uncertainty is right: it holds as often as it says it does."""

import numpy as np
import pytest
from scipy.stats import chi2

from calib.board.detection import BoardView
from calib.errors import IntrinsicsError
from calib.lens.models import free_of
from calib.lens.projection import project, rays_of
from calib.lens.uncertainty import pixel_grid, projection_sigma

FREE = free_of("k1k2p1p2", False)
NOISE_PX = 0.15
TRIALS = 200
# Of 200 trials at 95 %, 3.1 % are two standard deviations; three are taken, for several places at once.
LOW, HIGH = 0.95 - 0.046, 0.95 + 0.046
PLACES = np.array([[240.0, 180.0], [40.0, 40.0], [430.0, 60.0], [240.0, 330.0]])


def test_the_95_percent_regions_hold_the_truth_in_95_percent_of_200_trials(make_views, fit, lens):
    rng = np.random.default_rng(4)
    rays = rays_of(lens, PLACES)
    points = rays / np.linalg.norm(rays, axis=1)[:, None] * 0.3
    held, placed, noises, spread = 0, np.zeros(len(PLACES)), [], []
    for _ in range(TRIALS):
        views, poses = make_views(rng, 14, NOISE_PX)
        _, found, uncertainty = fit(views, poses, FREE)
        off = (found.lens - lens)[FREE]
        covariance = uncertainty.covariance[np.ix_(FREE, FREE)]
        distance = off @ np.linalg.solve(covariance, off)
        held += distance < chi2.ppf(0.95, len(FREE))
        spread.append(distance)
        noises.append(uncertainty.noise_px)
        # The points as the boards carry them along, projected by the lens that was found.
        carried = np.mean(
            [
                (points - translation) @ rotation @ mine.T + place
                for (rotation, translation), mine, place in zip(
                    poses, found.rotations, found.translations_m, strict=True
                )
            ],
            axis=0,
        )
        miss = project(found.lens, carried) - PLACES
        _, predicted = projection_sigma(found.lens, uncertainty, PLACES, 0.3)
        squared = np.einsum("ni,nij,nj->n", miss, np.linalg.inv(predicted), miss)
        placed += squared < chi2.ppf(0.95, 2)
    assert LOW < held / TRIALS < HIGH
    assert (placed / TRIALS > LOW).all()
    assert (placed / TRIALS < HIGH).all()
    # The noise is known from some 500 residuals a trial; the mean over the trials to 0.3 %.
    assert np.mean(noises) == pytest.approx(NOISE_PX, rel=0.01)
    # Mean of a chi-square with 8 degrees of freedom: 8 +- 4 / sqrt(200), and a little for the outer cases.
    assert np.mean(spread) == pytest.approx(8, abs=1.2)


def test_errors_that_hang_together_widen_the_uncertainty(make_views, fit, lens):
    """Each picture is sheared by a thousandth, as a moving board is by a rolling shutter."""
    rng = np.random.default_rng(5)
    inside, total, naive = 0, 0, 0
    for _ in range(30):
        views, poses = make_views(rng, 16, 0.05)
        sheared = []
        for view in views:
            middle = view.corners_px.mean(0)
            moved = view.corners_px + (view.corners_px - middle) @ rng.normal(0, 1e-3, (2, 2))
            sheared.append(BoardView(view.name, view.size, view.ids, moved, 2.0, "both"))
        _, found, uncertainty = fit(sheared, poses, FREE)
        off = np.abs((found.lens - lens)[FREE])
        sigma = np.sqrt(np.diag(uncertainty.covariance))[FREE]
        inside += int((off < 1.96 * sigma).sum())
        naive += int((off < 1.96 * sigma / np.sqrt(uncertainty.correlation_factor)).sum())
        total += len(FREE)
        assert uncertainty.correlation_factor > 1.5
    assert inside / total > 0.9
    assert naive / total < 0.85  # what independent corners would have claimed


def test_uncertainty_is_least_where_the_boards_were(make_views, fit, size):
    views, poses = make_views(np.random.default_rng(6), 14, NOISE_PX)
    _, found, uncertainty = fit(views, poses, FREE)
    grid, (columns, rows) = pixel_grid(size, 16)
    sigma, _ = projection_sigma(found.lens, uncertainty, grid, 0.3)
    chart = sigma.reshape(rows, columns)
    assert chart[rows // 2, columns // 2] < chart[[0, 0, -1, -1], [0, -1, 0, -1]].min()
    far, _ = projection_sigma(found.lens, uncertainty, grid, 30.0)
    assert np.median(sigma) < np.median(far)


def test_more_pictures_know_more(make_views, fit):
    sigmas = []
    for count in (12, 48):
        views, poses = make_views(np.random.default_rng(7), count, NOISE_PX)
        _, _, uncertainty = fit(views, poses, FREE)
        sigmas.append(np.sqrt(uncertainty.covariance[0, 0]))
    # Four times the pictures halve it; of twelve, chance makes some sets worse than others.
    assert 1.4 < sigmas[0] / sigmas[1] < 4.0


def test_a_place_without_a_ray_has_no_uncertainty(make_views, fit):
    views, poses = make_views(np.random.default_rng(8), 8, NOISE_PX)
    _, found, uncertainty = fit(views, poses, FREE)
    folded = found.lens.copy()
    folded[4:] = [-0.9, 0, 0, 0, 0]
    sigma, _ = projection_sigma(folded, uncertainty, np.array([[240.0, 180.0], [2000.0, 180.0]]), 0.3)
    assert np.isfinite(sigma).tolist() == [True, False]


def test_head_on_pictures_leave_the_focal_length_open(make_views, fit):
    def facing(rng):
        return np.eye(3), np.array([rng.uniform(-0.02, 0.02), 0.0, rng.uniform(0.25, 0.4)])

    views, poses = make_views(np.random.default_rng(9), 6, NOISE_PX, pose=facing)
    try:
        _, found, uncertainty = fit(views, poses, FREE)
    except IntrinsicsError:
        return
    assert np.sqrt(uncertainty.covariance[0, 0]) > 0.05 * found.lens[0]


def test_fewer_corners_than_unknowns_are_refused(make_views, fit):
    views, poses = make_views(np.random.default_rng(10), 1, NOISE_PX)
    few = BoardView("few", views[0].size, views[0].ids[:6], views[0].corners_px[:6], 2.0, "both")
    with pytest.raises(IntrinsicsError, match=r"open|too few"):
        fit([few], poses, FREE)
