import cv2
import numpy as np
import pytest

from calib.lens.projection import fold_radius, free_entries, project, project_with_slopes, rays_of

LENS = np.array([560.0, 562.0, 322.3, 238.1, -0.22, 0.08, 0.001, -0.0015, 0.01])


def points():
    rng = np.random.default_rng(0)
    return rng.uniform([-0.4, -0.4, 0.6], [0.4, 0.4, 1.4], (50, 3))


def test_points_project_as_in_opencv():
    fx, fy, cx, cy = LENS[:4]
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    theirs, _ = cv2.projectPoints(points(), np.zeros(3), np.zeros(3), K, LENS[4:])
    assert np.allclose(project(LENS, points()), theirs[:, 0], atol=1e-9)


def test_slopes_are_those_of_small_steps():
    _, by_lens, by_point = project_with_slopes(LENS, points())
    step = 1e-6
    for number, nudge in enumerate(np.eye(9) * step):
        slope = (project(LENS + nudge, points()) - project(LENS - nudge, points())) / (2 * step)
        assert np.allclose(by_lens[..., number], slope, atol=1e-6)  # rounding of 1e-16 * 1e3 / 1e-6
    for number, nudge in enumerate(np.eye(3) * step):
        slope = (project(LENS, points() + nudge) - project(LENS, points() - nudge)) / (2 * step)
        assert np.allclose(by_point[..., number], slope, atol=1e-5)


def test_rays_go_back_to_their_points():
    assert np.allclose(rays_of(LENS, project(LENS, points())), points() / points()[:, 2:], atol=1e-9)


def test_a_pixel_beyond_the_fold_has_no_ray():
    lens = np.array([500.0, 500.0, 320.0, 240.0, -0.5, 0, 0, 0, 0])
    fold = fold_radius(lens)
    assert fold == pytest.approx(np.sqrt(1 / 1.5))
    edge = project(lens, np.array([fold, 0.0, 1.0]))
    assert np.isfinite(rays_of(lens, edge[None] - [2.0, 0.0])).all()
    assert np.isnan(rays_of(lens, edge[None] + [2.0, 0.0])).all()
    assert fold_radius(np.array([500.0, 500, 320, 240, 0, 0, 0, 0, 0])) == np.inf


def test_points_at_and_behind_the_camera_are_finite():
    for z in (0.0, -1.0):
        pixels, by_lens, by_point = project_with_slopes(
            LENS * [1, 1, 1, 1, 0, 0, 0, 0, 0], np.array([0, 0, z])
        )
        assert np.isfinite(pixels).all()
        assert np.isfinite(by_lens).all()
        assert np.isfinite(by_point).all()


def test_terms_have_their_places():
    assert free_entries(["k1", "k3"]) == [0, 1, 2, 3, 4, 8]
