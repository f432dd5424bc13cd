"""What is unknown on one side comes from the other, at this side's level; nothing else changes."""

import numpy as np
import torch

from relight.face.mirror import fill_from_mirror
from relight.face.plane import Plane
from relight.infill import infill

KNOWN = 0.25
PLANE = Plane((1.0, 0.0, 0.0), 0.0)


def ball(count=8000):
    """Points and normals of a ball, and a symmetric pattern on it that is finer than a hole."""
    i = np.arange(count) + 0.5
    z, phi = 1 - 2 * i / count, i * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - z * z)
    normals = np.stack([ring * np.cos(phi), ring * np.sin(phi), z], axis=1)
    pattern = 0.4 + 0.2 * np.sin(40 * np.abs(normals[:, :1])) * np.sin(30 * normals[:, 1:2])
    points, normals, pattern = (torch.from_numpy(v).float() for v in (0.1 * normals, normals, pattern))
    return points, normals, pattern.repeat(1, 3)


def hole(points):
    """[P] bool: a hole 4 cm wide on the positive side."""
    return (points - torch.tensor([0.08, 0.0, 0.06])).norm(dim=1) < 0.04


def filled(points, normals, values, information):
    return fill_from_mirror(points, normals, values, information, PLANE, known=KNOWN, reach=0.004)


def test_a_hole_takes_the_pattern_of_the_other_side_which_neighbours_do_not_know():
    points, normals, pattern = ball()
    gone = hole(points)
    information = torch.where(gone, 0.0, 3.0)
    known = torch.where(gone[:, None], 0.0, pattern)
    result = filled(points, normals, known, information)
    assert bool(result.filled[gone].float().mean() > 0.99)
    mirrored = infill(points, result.values, result.information, known=KNOWN, nearest=0.004)
    neighbours = infill(points, known, information, known=KNOWN, nearest=0.004)
    error = (mirrored - pattern)[gone].square().mean().sqrt()
    assert error < 0.6 * (neighbours - pattern)[gone].square().mean().sqrt()


def test_what_is_known_keeps_its_value():
    points, normals, pattern = ball()
    information = torch.where(hole(points), 0.0, 3.0)
    result = filled(points, normals, pattern, information)
    torch.testing.assert_close(result.values[information > 0], pattern[information > 0])
    torch.testing.assert_close(result.information[information > 0], information[information > 0])


def test_the_other_sides_colour_is_brought_to_this_sides_level():
    points, normals, _ = ball()
    gone = hole(points)
    side = torch.where(points[:, :1] > 0, 0.3, 0.45).repeat(1, 3)
    result = filled(points, normals, torch.where(gone[:, None], 0.0, side), torch.where(gone, 0.0, 3.0))
    # One level a side: the ratio is known but for the floor that keeps black from dividing.
    torch.testing.assert_close(
        result.values[gone & result.filled], side[gone & result.filled], rtol=0.02, atol=0
    )


def test_a_hole_on_both_sides_stays_as_it_is():
    points, normals, pattern = ball()
    gone = hole(points) | hole(points * torch.tensor([-1.0, 1.0, 1.0]))
    result = filled(points, normals, pattern, torch.where(gone, 0.0, 3.0))
    inner = (points.abs() - torch.tensor([0.08, 0.0, 0.06])).norm(dim=1) < 0.03
    assert not result.filled[inner].any()


def test_a_sheet_behind_is_no_mirror_image():
    points, normals, pattern = ball()
    gone = hole(points)
    information = torch.where(gone, 0.0, 3.0)
    other = points[:, 0] < 0
    normals = torch.where(other[:, None], -normals, normals)  # the other side turned inside out
    assert not filled(points, normals, pattern, information).filled.any()


def test_nothing_known_and_everything_known_change_nothing():
    points, normals, pattern = ball(500)
    for information in (torch.zeros(500), torch.full((500,), 5.0)):
        result = filled(points, normals, pattern, information)
        assert torch.equal(result.values, pattern)
        assert not result.filled.any()
    empty = filled(torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0))
    assert empty.values.shape == (0, 3)


def test_values_a_little_below_black_stay_finite():
    points, normals, _ = ball()
    gone = hole(points)
    dark = torch.where(points[:, 1:2] > 0, -0.01, 0.02).repeat(1, 3)
    result = filled(points, normals, torch.where(gone[:, None], 0.0, dark), torch.where(gone, 0.0, 3.0))
    assert bool(result.values.isfinite().all())
