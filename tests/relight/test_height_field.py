"""Slopes of surfaces that formulas know, and heights that come back from them."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch

from relight.height_field import HeightField, SlopeTerms

SPACING = 0.001


def grid(side=24, jitter=0.15, seed=0):
    """Points [P, 3] of a plane, near the corners of a square grid, and which of them are not at its edge."""
    random = np.random.default_rng(seed)
    y, x = np.mgrid[0:side, 0:side].astype(np.float64)
    points = np.stack([x, y, 0 * x], axis=-1) + np.append(jitter, [jitter, 0]) * random.normal(
        size=(side, side, 3)
    )
    inside = (np.minimum(x, y) >= 2) & (np.maximum(x, y) < side - 2)
    return SPACING * points.reshape(-1, 3).astype(np.float32), inside.ravel()


@dataclass
class Plane:
    """A field over a flat cloud, in whose u, v a world gradient is told."""

    points: np.ndarray
    inside: np.ndarray
    field: HeightField

    @classmethod
    def make(cls, **given):
        points, inside = grid(**given)
        normals = np.broadcast_to(np.array([0, 0, 1], np.float32), points.shape).copy()
        return cls(points, inside, HeightField(torch.from_numpy(points), torch.from_numpy(normals), SPACING))

    def heights(self, formula):
        return torch.from_numpy(formula(*self.points[:, :2].astype(np.float64).T).astype(np.float32))

    def slopes(self, gradient):
        """[2, P] along u and v of a gradient [P, 2] in x and y."""
        world = torch.from_numpy(np.concatenate([gradient, 0 * gradient[:, :1]], axis=1).astype(np.float32))
        return torch.stack([(world * axis).sum(dim=1) for axis in (self.field.u, self.field.v)])


@pytest.fixture(scope="module")
def plane():
    return Plane.make()


def terms_of(slopes, along=(1.0, 1.0), weight=1.0):
    """Terms that ask for slopes [2, P], with a weight along u and one along v."""
    uu, vv = (torch.full_like(slopes[0], weight * share) for share in along)
    return SlopeTerms(uu, torch.zeros_like(uu), vv, torch.stack([uu * slopes[0], vv * slopes[1]]))


def test_the_slopes_of_a_plane_are_those_of_the_plane_at_its_edge_too(plane):
    slopes = plane.field.slopes(plane.heights(lambda x, y: 0.3 * x - 0.2 * y))
    wanted = plane.slopes(np.tile([0.3, -0.2], (len(plane.points), 1)))
    # What keeps lines finite adds 0.05 to sums of squares of 2 and more: 2 %; at corners one of 0.7: 7 %.
    torch.testing.assert_close(slopes, wanted, atol=0.025, rtol=0)
    torch.testing.assert_close(slopes[:, plane.inside], wanted[:, plane.inside], atol=0.009, rtol=0)


def test_the_slopes_of_a_wave_are_those_of_its_formula(plane):
    k = 2 * np.pi / (20 * SPACING)
    heights = plane.heights(lambda x, y: np.sin(k * x + 0.5 * k * y) / k)
    phase = np.cos(k * plane.points[:, 0].astype(np.float64) + 0.5 * k * plane.points[:, 1])
    wanted = plane.slopes(np.stack([phase, 0.5 * phase], axis=1))
    error = (plane.field.slopes(heights) - wanted)[:, plane.inside]
    # The mean slope of a disc whose weights are 1 spacing wide: (k spacing)^2 / 2 = 5 %, and the 2 % above,
    # of a slope of 1.1; jittered neighbours are lopsided, and the curve's part does not quite cancel.
    assert float(error.abs().max()) < 0.15
    assert float(error.square().mean().sqrt()) < 0.05


def test_a_sphere_blown_up_keeps_its_normals_and_a_tilted_one_turns():
    i = np.arange(4000) + 0.5
    z, phi = 1 - 2 * i / 4000, i * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - z * z)
    normals = np.stack([ring * np.cos(phi), ring * np.sin(phi), z], axis=1)
    points = 0.1 * normals
    spacing = 0.1 * np.sqrt(4 * np.pi / 4000)
    field = HeightField(
        torch.from_numpy(points.astype(np.float32)), torch.from_numpy(normals.astype(np.float32)), spacing
    )
    same = field.normals(torch.full((4000,), 0.01))
    torch.testing.assert_close(same, torch.from_numpy(normals.astype(np.float32)), atol=1e-5, rtol=0)
    # Heights e x . a move a sphere by e a to first order: normals n of a sphere stay those of its new place,
    # and here, where the points move along n alone, turn against a's tangential part by e / r of it.
    shift = np.array([0.6, 0.0, 0.8])
    heights = 0.002 * normals @ shift
    tilted = normals - 0.002 / 0.1 * (shift - (normals @ shift)[:, None] * normals)
    tilted /= np.linalg.norm(tilted, axis=1, keepdims=True)
    found = field.normals(torch.from_numpy(heights.astype(np.float32))).numpy()
    # A tilt of 0.02, of which 2 to 3 % are lost (above).
    assert np.abs(found - tilted).max() < 0.001


def test_what_heights_pull_is_the_adjoint_of_their_differences(plane):
    random = torch.Generator().manual_seed(0)
    heights = torch.randn(len(plane.points), generator=random)
    parts = [torch.randn(len(plane.points), generator=random) for _ in range(3)]
    forward = (plane.field._apply(heights).double() * torch.stack(parts).double()).sum()
    backward = (plane.field._adjoint(*parts).double() * heights.double()).sum()
    # Sums of 1,700 products of about 1 / spacing, rounded in float32: 1e-7 * 1000 * sqrt(1700) = 0.004.
    assert abs(float(forward - backward)) < 0.05
    assert abs(float(forward)) > 100


def test_the_preconditioner_is_the_diagonal(plane):
    weights = [torch.full((len(plane.points),), value) for value in (2.0, 0.5, 3.0)]
    diagonal = plane.field._diagonal(*weights)
    for point in (0, 30, 300):
        unit = torch.zeros(len(plane.points))
        unit[point] = 1.0
        parts = [weight * part for weight, part in zip(weights, plane.field._apply(unit), strict=True)]
        assert float(plane.field._adjoint(*parts)[point]) == pytest.approx(float(diagonal[point]), rel=1e-4)


def test_heights_come_back_from_their_slopes(plane):
    k = 2 * np.pi / (12 * SPACING)
    heights = plane.heights(lambda x, y: np.sin(k * x) * np.cos(0.7 * k * y) / k)
    fitted = plane.field.fit(
        terms_of(plane.field.slopes(heights)),
        anchor=1e-3,
        bending=0.0,
        start=torch.zeros_like(heights),
        iterations=400,
    )
    # Slopes do not know the mean; conjugate gradients end at a residual of a thousandth.
    error = (fitted - fitted.mean()) - (heights - heights.mean())
    assert float(error.std() / heights.std()) < 0.02


def test_slopes_along_one_direction_tell_of_those_across_it(plane):
    k = 2 * np.pi / (12 * SPACING)
    heights = plane.heights(lambda x, y: np.sin(k * x) * np.cos(0.7 * k * y) / k)
    slopes = plane.field.slopes(heights)
    along = (1.0, 0.0) if float(plane.field.u[0, 0].abs()) > 0.5 else (0.0, 1.0)
    fitted = plane.field.fit(
        terms_of(slopes, along), anchor=1.0, bending=0.0, start=torch.zeros_like(heights), iterations=400
    )
    across = along.index(0.0)
    known, told = (
        (plane.field.slopes(fitted) - slopes)[row, plane.inside].std() / slopes[row, plane.inside].std()
        for row in (1 - across, across)
    )
    # Each row knows its heights but for a constant, which the anchor makes 0 on the mean, as the wave has it.
    # Rows of jittered points are no straight lines, and one misses the next by hundredths of the height:
    # of slopes across them four fifths are right, where the anchor alone would say 0 and miss by 1.
    assert float(known) < 0.03
    assert float(told) < 0.35


def test_the_fit_is_that_of_a_dense_solve():
    plane = Plane.make(side=7, seed=3)
    count = len(plane.points)
    random = np.random.default_rng(4)
    half = random.normal(size=(count, 2, 2))
    matrix = (half @ half.transpose(0, 2, 1)).astype(np.float32)
    right = random.normal(size=(2, count)).astype(np.float32)
    terms = SlopeTerms(
        *(torch.from_numpy(matrix[:, i, j].copy()) for i, j in ((0, 0), (0, 1), (1, 1))),
        torch.from_numpy(right),
    )
    columns = [plane.field._apply(unit).double().numpy() for unit in torch.eye(count)]
    along_u, along_v, bend = np.stack(columns, axis=-1)
    slopes = np.stack([along_u, along_v], axis=1)  # [P, 2, P]
    anchor, bending = 5e4, 0.3
    dense = np.einsum("pia,pij,pjb->ab", slopes, matrix.astype(np.float64), slopes)
    dense += anchor * np.eye(count) + bending * bend.T @ bend
    wanted = np.linalg.solve(dense, np.einsum("pia,ip->a", slopes, right.astype(np.float64)))
    start = torch.zeros(count)
    fitted = plane.field.fit(terms, anchor=anchor, bending=bending, start=start, iterations=200)
    # The residual is a thousandth; the anchor is a twentieth of the diagonal, so its inverse is at most 40.
    np.testing.assert_allclose(fitted.numpy(), wanted, atol=0.02 * np.abs(wanted).max())
    assert (start == 0).all()


def test_what_nothing_is_known_of_stays_where_it_is(plane):
    nothing = torch.zeros(2, len(plane.points))
    still = plane.field.fit(
        terms_of(nothing, weight=0.0), anchor=1.0, bending=1.0, start=nothing[0], iterations=20
    )
    assert (still == 0).all()


def test_neighbours_across_a_fold_do_not_make_its_slope():
    points, _ = grid(side=12, jitter=0.0)
    behind = points + np.array([0, 0, -0.3 * SPACING], np.float32)
    normals = np.broadcast_to(np.array([0, 0, 1], np.float32), points.shape)
    both = torch.from_numpy(np.concatenate([points, behind]))
    field = HeightField(both, torch.from_numpy(np.concatenate([normals, -normals])), SPACING)
    heights = torch.cat([torch.full((len(points),), 5 * SPACING), torch.zeros(len(points))])
    assert float(field.slopes(heights).abs().max()) < 1e-3


@pytest.mark.parametrize(
    "points",
    [
        [[0.0, 0, 0]],
        [[0.0, 0, 0], [SPACING, 0, 0]],
        [[0.0, 0, 0]] * 5,
        [[SPACING * k, 0, 0] for k in range(15)],
        [[0.0, 0, 0], [1.0, 0, 0], [0, 1.0, 0]],
    ],
    ids=["one", "two", "coincident", "a line", "far apart"],
)
def test_few_or_degenerate_points_have_finite_heights(points):
    points = torch.tensor(points)
    field = HeightField(points, torch.tensor([0.0, 0, 1]).expand(len(points), 3).clone(), SPACING)
    slopes = torch.full((2, len(points)), 0.1)
    fitted = field.fit(terms_of(slopes), anchor=1.0, bending=1.0, start=slopes[0], iterations=30)
    assert fitted.isfinite().all()
    assert field.slopes(fitted).isfinite().all()
    torch.testing.assert_close(
        torch.linalg.vector_norm(field.normals(fitted), dim=1), torch.ones(len(points))
    )
