"""Clouds of a known surface with known noise: what comes out lies on it, faces outwards and is even."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from analytic_scene import Head, arc, cloud_of, looking_at
from scipy.spatial import cKDTree

from relight.cloud import CloudConfig, clean, orient, prepare_cloud, smooth, spacing_and_noise
from relight.errors import PlanError

HEAD = Head()
CAMERAS = arc(12, size=64)  # pixels of 4.5 mm on the subject: few points, quick tests
COUNT = 6000  # 4.5 mm apart
NOISE_M = 0.0005


def angles_deg(surface, sign=1.0):
    """Angle of each normal to the analytic one at its point."""
    truth = HEAD.normals(surface.points.astype(np.float64))
    return np.degrees(np.arccos(np.clip(sign * (truth * surface.normals_world).sum(axis=1), -1, 1)))


def distances_m(points):
    """Signed distance from the analytic surface, to first order."""
    points = points.astype(np.float64)
    return HEAD.implicit(points) * np.linalg.norm(points, axis=1)


def plane(side=50, step=0.004):
    grid = step * (np.mgrid[0:side, 0:side].reshape(2, -1).T - side / 2)
    return np.concatenate([grid, np.zeros((len(grid), 1))], axis=1).astype(np.float32)


@pytest.fixture(scope="module")
def given():
    return cloud_of(HEAD, COUNT, NOISE_M)


@pytest.fixture(scope="module")
def prepared(given):
    return prepare_cloud(given[0], None, CAMERAS)


def test_noise_and_spacing_of_a_cloud_are_found(given):
    spacing, noise = spacing_and_noise(given[0])
    # The area of an ellipsoid by Knud Thomsen's formula (within 1.1 %), and the bumps add under 2 %.
    a, b, c = 0.085**1.6, 0.115**1.6, 0.1**1.6
    area = 4 * np.pi * ((a * b + a * c + b * c) / 3) ** (1 / 1.6)
    assert spacing == pytest.approx(np.sqrt(area / COUNT), rel=0.05)
    # Sixteen neighbours 4.5 mm apart reach 10 mm, where a head of 0.1 m departs from its plane by 0.1 mm rms:
    # that adds in squares to the noise. The estimate itself is the median of thousands.
    assert noise == pytest.approx(np.hypot(NOISE_M, 0.0001), rel=0.1)


def test_points_come_out_nearer_to_the_surface_than_they_went_in(given, prepared):
    out = distances_m(prepared.points)
    # Some 25 points share a smoothing disc, which a quadratic of 6 coefficients fits: noise falls to about
    # 0.5 / sqrt(25 / 6) = 0.25 mm. Resampling on tangent planes adds an outward bias of width^2 / 2R, with a
    # width of 1.4 spacings: 0.2 mm.
    assert np.std(distances_m(given[0])) == pytest.approx(NOISE_M, rel=0.05)
    assert np.std(out) < 0.25e-3
    assert abs(np.mean(out)) < 0.2e-3


def test_normals_err_by_what_the_noise_predicts(prepared):
    # A plane of standard deviation width w in each direction through n points has slope errors of
    # noise / (w sqrt(n)) in each of two directions. The disc's radius is smoothing * spacing *
    # (noise / spacing)^(1/3) = 16 mm, so w = 8 mm, with n = 34: 0.6 degrees in one, 0.85 degrees rms in both.
    # Curvature adds to it, thinning takes noise away first.
    angles = angles_deg(prepared)
    assert 0.3 < np.sqrt(np.mean(angles**2)) < 1.5
    assert angles.max() < 8


def test_normals_point_outwards_even_where_no_camera_looks(prepared):
    # The arc leaves the back, the crown and the chin unseen: a tenth of the surface.
    assert (angles_deg(prepared) < 90).all()


def test_result_is_even_and_as_fine_as_the_pixels(prepared):
    # Nearest view: 0.4 m to the surface at f = 112 px.
    assert prepared.spacing == pytest.approx(0.9 * 0.45 / 112, rel=0.15)
    nearest = cKDTree(prepared.points).query(prepared.points, k=[2])[0][:, 0]
    # One point a cube: neighbours may be close across a cube's face, but are rarely, and no gap is wider than
    # two cubes' diagonals.
    assert np.median(nearest) == pytest.approx(0.7 * prepared.spacing, rel=0.3)
    assert nearest.max() < 2 * np.sqrt(3) * prepared.spacing
    # No holes: every place of the surface has a point about it.
    gaps = cKDTree(prepared.points).query(HEAD.surface(5000))[0]
    assert gaps.max() < np.sqrt(3) * prepared.spacing


def test_max_points_widens_the_spacing(given):
    surface = prepare_cloud(given[0], None, CAMERAS, CloudConfig(max_points=3000))
    # About: a lattice of cubes that a curved surface cuts has up to 1.5 times as many as area / spacing^2.
    assert 2000 < len(surface.points) < 5000
    assert (angles_deg(surface) < 90).all()


def test_outliers_go(given):
    outliers = np.random.default_rng(0).uniform(
        -0.3, 0.3, (120, 3)
    )  # 5 cm apart, the surface's points 4.5 mm
    outliers = outliers[np.abs(distances_m(outliers)) > 0.03].astype(np.float32)
    kept = clean(np.concatenate([given[0], outliers]), 3.0)
    assert (kept < COUNT).all()
    assert len(kept) > 0.99 * COUNT


def test_copies_of_points_change_nothing(given):
    once = prepare_cloud(given[0], None, CAMERAS)
    twice = prepare_cloud(np.concatenate([given[0], given[0][:2000], given[0][:1000]]), None, CAMERAS)
    np.testing.assert_array_equal(once.points, twice.points)


def test_points_that_are_not_finite_change_nothing(given, prepared):
    bad = np.full((30, 3), np.nan, np.float32)
    bad[10:20, 1] = np.inf
    surface = prepare_cloud(np.concatenate([given[0], bad]), None, CAMERAS)
    np.testing.assert_array_equal(surface.points, prepared.points)


def test_unit_of_length_does_not_matter(given, prepared):
    def in_millimetres(camera):
        pose = camera.cam_from_world.copy()
        pose[:3, 3] *= 1000
        return replace(camera, cam_from_world=pose)

    surface = prepare_cloud(1000 * given[0], None, [in_millimetres(camera) for camera in CAMERAS])
    assert surface.spacing == pytest.approx(1000 * prepared.spacing, rel=1e-4)
    assert surface.noise == pytest.approx(1000 * prepared.noise, rel=1e-3)
    # Rounding may move a point across a cube's face, so a few points differ; most are the same to float32.
    assert len(surface.points) == pytest.approx(len(prepared.points), rel=0.01)
    gaps = cKDTree(surface.points).query(1000 * prepared.points)[0]
    assert np.median(gaps) < 1e-3 * surface.spacing
    assert np.quantile(gaps, 0.95) < 0.5 * surface.spacing


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_given_normals_orient_the_surface_even_inside_out(given, sign):
    surface = prepare_cloud(given[0], (sign * given[1]).astype(np.float32), CAMERAS)
    assert (angles_deg(surface) < 90).all()


def test_some_flipped_normals_are_outvoted(given):
    signs = np.where(np.random.default_rng(0).random(COUNT) < 0.15, -1, 1)[:, None]
    surface = prepare_cloud(given[0], (signs * given[1]).astype(np.float32), CAMERAS)
    # Of 16 points, half are flipped with a chance of binom(16, 8) 0.15^8 = 0.3 %.
    assert (angles_deg(surface) > 90).mean() < 0.005


def test_missing_normals_are_estimated(given):
    normals = given[1].copy()
    normals[::3] = np.nan
    normals[1::3] = 0
    assert (angles_deg(prepare_cloud(given[0], normals, CAMERAS)) < 90).all()


def test_a_plane_stays_the_plane():
    camera = looking_at(np.array([0.0, 0.05, 0.6]), np.zeros(3), size=64)
    surface = prepare_cloud(plane(), None, [camera])
    # float32 of coordinates up to 0.1 m: 1e-8 m.
    assert np.abs(surface.points[:, 2]).max() < 1e-6
    np.testing.assert_allclose(surface.normals_world, np.tile([0, 0, 1], (len(surface.points), 1)), atol=1e-4)
    assert surface.noise < 1e-6


def test_smoothing_moves_no_point_further_than_half_the_disc(given):
    moved, normals = smooth(given[0], 0.012)
    assert np.linalg.norm(moved - given[0], axis=1).max() <= 0.006 * 1.001
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-5)


def test_normals_turn_to_the_only_camera():
    points = plane(20)
    normals = np.tile(np.float32([0, 0, 1]), (len(points), 1))
    normals[::2] *= -1
    below = looking_at(np.array([0.0, 0.02, -0.6]), np.zeros(3), size=64)
    np.testing.assert_array_equal(orient(points, normals, [below])[:, 2], -1.0)


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((0, 3)),
        np.zeros((1, 3)),
        np.zeros((500, 3)),  # one point, many times
        np.full((500, 3), np.nan),
        np.random.default_rng(0).normal(size=(20, 3)),
    ],
    ids=["none", "one", "copies of one", "not finite", "few"],
)
def test_too_few_points_are_refused_in_one_sentence(points):
    with pytest.raises(PlanError, match=r"^Only \d+ of \d+ points .*a fit needs a dense cloud\.$"):
        prepare_cloud(points.astype(np.float32), None, CAMERAS)


def test_a_cloud_behind_all_cameras_is_refused():
    away = looking_at(np.array([0.0, 0.0, 0.5]), np.array([0.0, 0.0, 1.0]), size=64)
    with pytest.raises(PlanError, match="No camera has the cloud before it"):
        prepare_cloud(plane(), None, [away])


def test_a_line_of_points_gives_finite_normals():
    line = np.zeros((500, 3), np.float32)
    line[:, 0] = np.linspace(-0.1, 0.1, 500)
    surface = prepare_cloud(line, None, [looking_at(np.array([0.0, 0.0, 0.5]), np.zeros(3), size=64)])
    assert np.isfinite(surface.points).all()
    assert torch.linalg.vector_norm(torch.from_numpy(surface.normals_world), dim=1).sub(1).abs().max() < 1e-3
