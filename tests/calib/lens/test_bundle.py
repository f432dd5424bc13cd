import cv2
import numpy as np
import pytest

from calib.lens.bundle import SHARED_SIZE, minimise, observations_of, start_at
from calib.lens.models import free_of


def start(observations, focal=500.0):
    shared = np.zeros(SHARED_SIZE)
    shared[:4] = [focal, focal, observations.size[0] / 2, observations.size[1] / 2]
    return start_at(observations, shared)


def test_without_noise_the_truth_is_found(make_views, board, lens):
    views, poses = make_views(np.random.default_rng(0), 8, noise_px=0.0)
    observations = observations_of(views, board)
    found = minimise(observations, start(observations), free_of("k1k2p1p2", False))
    assert np.allclose(found.lens, lens, rtol=1e-6, atol=1e-6)
    for (rotation, translation), mine, place in zip(
        poses, found.rotations, found.translations_m, strict=True
    ):
        assert np.allclose(mine, rotation, atol=1e-6)
        assert np.allclose(place, translation, atol=1e-6)


def test_the_minimum_is_that_of_opencv(make_views, board):
    views, _ = make_views(np.random.default_rng(1), 12, noise_px=0.2)
    observations = observations_of(views, board)
    found = minimise(observations, start(observations), free_of("k1k2p1p2k3", False))
    rms, K, distortion, *_ = cv2.calibrateCamera(
        [board.corners_m[view.ids].astype(np.float32) for view in views],
        [view.corners_px.astype(np.float32) for view in views],
        observations.size,
        None,
        None,
        flags=0,
        criteria=(3, 100, 1e-12),
    )
    theirs = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *distortion.ravel()[:5]]
    # float32 corners are rounded by 2e-5 px, and k2 and k3 are hardly told apart.
    assert np.allclose(found.lens[:4], theirs[:4], atol=2e-2)
    assert np.sqrt(found.cost / observations.seen.sum()) == pytest.approx(rms, abs=1e-5)


def test_a_bent_board_is_straightened(make_views, board, lens):
    views, _ = make_views(np.random.default_rng(2), 10, noise_px=0.0, bend_m=0.002)
    observations = observations_of(views, board)
    found = minimise(observations, start(observations), free_of("k1k2p1p2", True))
    assert np.allclose(found.shared[-2:], [0.002, 0.0], atol=1e-7)
    assert np.allclose(found.lens, lens, rtol=1e-6, atol=1e-6)


def test_with_nothing_free_only_poses_move(make_views, board, lens):
    views, _ = make_views(np.random.default_rng(3), 3, noise_px=0.1)
    observations = observations_of(views, board)
    begun = start(observations, 420.0)
    found = minimise(observations, begun, [])
    assert np.array_equal(found.shared, begun.shared)
    assert found.cost < begun.cost
