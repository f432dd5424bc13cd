"""Light within a subject against closed forms: a hollow ball, two walls, a ball alone."""

import numpy as np
import pytest
import torch
from analytic_scene import portrait_of, sphere_portrait

from relight.interreflection import Interreflection, even_directions, spiral


def hollow_ball(count=6000, albedo=0.5):
    """A ball seen from inside: every point sees all others."""
    ball = sphere_portrait(count, 0.1)
    return portrait_of(ball.points.numpy(), -ball.normals_world.numpy(), ball.spacing, albedo=albedo)


def corner(spacing=0.002, side_m=0.1):
    """A floor that faces up (+z) and a wall at x = 0 that faces +x; floor first."""
    steps = np.arange(spacing / 2, side_m, spacing)
    a, b = (axis.ravel() for axis in np.meshgrid(steps, steps))
    floor = np.stack([a, b, np.zeros_like(a)], axis=1)
    wall = np.stack([np.zeros_like(a), b, a], axis=1)
    normals = np.repeat([[0.0, 0, 1], [1.0, 0, 0]], len(a), axis=0)
    return portrait_of(np.concatenate([floor, wall]), normals, spacing, albedo=0.5), len(a)


def wall_seen_from_floor(point, side_m=0.1, steps=200):
    """Form factor from a floor point to the wall: cos cos / (pi r^2) dA summed over small pieces."""
    at = (np.arange(steps) + 0.5) * side_m / steps
    y, z = (axis.ravel() for axis in np.meshgrid(at, at))
    towards = np.stack([np.zeros_like(y), y, z], axis=1) - point
    square = (towards**2).sum(axis=1)
    return float((towards[:, 2] * -towards[:, 0] / (np.pi * square**2)).sum() * (side_m / steps) ** 2)


def test_a_hollow_ball_lights_itself_as_the_geometric_series_says():
    found = Interreflection(hollow_ball())
    indirect = found.indirect(torch.ones(len(found.ids), 3))
    # Everything sent arrives: 0.5 + 0.25 + 0.125 after three bounces. Rays of a bundle that pass between
    # points or graze are lost, some hundredths.
    assert indirect.mean() == pytest.approx(0.875, rel=0.06)
    assert indirect.std() < 0.05


def test_what_a_corner_s_floor_receives_is_its_form_factor_of_the_wall():
    portrait, floor = corner()
    found = Interreflection(portrait)
    on_floor = found.ids < floor
    direct = (~on_floor).float()[:, None].expand(-1, 3)  # the wall alone is lit
    found.albedo = torch.where(on_floor[:, None], 0.0, 0.5).expand(-1, 3)  # and the floor sends nothing back
    indirect = found.indirect(direct)[:, 0].numpy()
    places = found.points_world.numpy()
    for x in (0.01, 0.03, 0.06):
        beside = on_floor.numpy() & (np.abs(places[:, 0] - x) < 0.002) & (np.abs(places[:, 1] - 0.05) < 0.02)
        # 128 directions hit a wall that fills a tenth of the sky to about a tenth of it.
        expected = 0.5 * wall_seen_from_floor(np.array([x, 0.05, 0.0]))
        assert indirect[beside].mean() == pytest.approx(expected, rel=0.12)
    np.testing.assert_array_equal(indirect[~on_floor.numpy()], 0.0)


def test_a_convex_body_sends_itself_nothing():
    found = Interreflection(sphere_portrait(5000))
    assert found.indirect(torch.ones(len(found.ids), 3)).max() < 0.01


def test_several_lights_at_once_are_as_one_after_the_other():
    portrait, _ = corner()
    found = Interreflection(portrait)
    torch.manual_seed(1)
    lights = torch.rand(len(found.ids), 4, 3)
    together = found.indirect(lights)
    for k in range(4):
        torch.testing.assert_close(together[:, k], found.indirect(lights[:, k].contiguous()))


def test_a_factor_on_the_albedo_makes_the_bounce_as_much_weaker():
    portrait, floor = corner()
    whole, half = Interreflection(portrait), Interreflection(portrait, 0.5)
    torch.testing.assert_close(half.albedo, 0.5 * whole.albedo)
    # Between two walls once is nearly all.
    wall = (whole.ids >= floor).float()[:, None].expand(-1, 3)
    on_floor = whole.ids < floor
    ratio = half.indirect(wall)[on_floor].mean() / whole.indirect(wall)[on_floor].mean()
    assert ratio == pytest.approx(0.5, abs=0.02)


def test_a_surfel_stands_for_points_of_one_place_and_one_side():
    # Two sheets back to back, closer than a surfel is wide.
    side = np.arange(0, 0.06, 0.001)
    x, y = (axis.ravel() for axis in np.meshgrid(side, side))
    sheet = np.stack([x, y, np.zeros_like(x)], axis=1)
    normals = np.repeat([[0.0, 0, 1], [0.0, 0, -1]], len(x), axis=0)
    albedo = np.repeat([0.2, 0.8], len(x))[:, None]
    portrait = portrait_of(np.concatenate([sheet, sheet - [0, 0, 5e-4]]), normals, 0.001, albedo=albedo)
    found = Interreflection(portrait, surfels=400)
    assert 200 < len(found.ids) < 1500
    upper = found.normals_world[:, 2] > 0
    np.testing.assert_allclose(found.albedo[upper], 0.2, atol=1e-6)
    np.testing.assert_allclose(found.albedo[~upper], 0.8, atol=1e-6)
    # And points take from surfels of their own side.
    values = found.of_points(upper.float()[:, None], torch.arange(2 * len(x)))
    np.testing.assert_allclose(values[: len(x)], 1.0, atol=1e-6)
    np.testing.assert_allclose(values[len(x) :], 0.0, atol=1e-6)


@pytest.mark.parametrize("count", [1, 2, 50])
def test_few_points_are_no_special_case(count):
    portrait = sphere_portrait(2000).subset(torch.arange(count))
    found = Interreflection(portrait)
    indirect = found.indirect(torch.ones(len(found.ids), 3))
    assert indirect.isfinite().all()
    assert found.of_points(indirect, torch.arange(count)).isfinite().all()


def test_spirals_are_even():
    disc, ball = spiral(200).numpy(), even_directions(200).numpy()
    # The mean square of the radius of a disc is a half, that of each coordinate on a ball a third.
    assert (disc**2).sum(axis=1).mean() == pytest.approx(0.5, abs=1e-3)
    np.testing.assert_allclose(disc.mean(axis=0), 0.0, atol=0.01)
    np.testing.assert_allclose((ball**2).mean(axis=0), 1 / 3, atol=0.005)
    np.testing.assert_allclose(ball.mean(axis=0), 0.0, atol=0.01)
