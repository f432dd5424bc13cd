"""Shadows of a ball on a floor against rays cut with the ball, and bodies that must not shade themselves."""

import numpy as np
import pytest
import torch
from analytic_scene import Head, cloud_of, looking_at, portrait_of, sphere_portrait

from relight.maps import render_maps
from relight.shadows import ShadowCaster

SPACING_M = 0.002
BALL, RADIUS_M = np.array([0.0, 0.0, 0.08]), 0.04
DIRECTIONS = [[0.0, 0.0, 1.0], [0.6, 0.0, 0.8], [-0.5, 0.6, 0.62], [0.0, -0.8, 0.6]]


@pytest.fixture(scope="module")
def ball_over_floor():
    """A floor of 0.3 m at z = 0 that faces up, and a ball over it."""
    side = np.arange(-0.15, 0.15, SPACING_M)
    x, y = (axis.ravel() for axis in np.meshgrid(side, side))
    floor = np.stack([x, y, np.zeros_like(x)], axis=1)
    sphere = sphere_portrait(int(4 * np.pi * (RADIUS_M / SPACING_M) ** 2), RADIUS_M)
    up = np.tile([0.0, 0, 1], (len(floor), 1))
    points = np.concatenate([floor, sphere.points.numpy() + BALL])
    return portrait_of(points, np.concatenate([up, sphere.normals_world.numpy()]), SPACING_M)


def clearance_m(points, to_light):
    """By how much [P] the rays to the light [P, 3] clear the ball; below 0 = in its shadow."""
    to_light = to_light / np.linalg.norm(to_light, axis=-1, keepdims=True)
    along = ((BALL - points) * to_light).sum(axis=-1).clip(0)
    return np.linalg.norm(points + along[:, None] * to_light - BALL, axis=1) - RADIUS_M


def cosine_to(points, normals, position):
    towards = position - points
    return (torch.nn.functional.normalize(towards, dim=1) * normals).sum(dim=1)


def check_floor(portrait, depth_map, to_light):
    floor = portrait.points[:, 2] == 0
    points, normals = portrait.points[floor], portrait.normals_world[floor]
    visible = depth_map.visible(points, normals).numpy()
    clear = clearance_m(points.numpy().astype(np.float64), to_light[floor.numpy()])
    # A cell is 1.5 spacings wide, empty ones take their neighbours', and the answer is interpolated between
    # four: the border may be off by two and a half cells.
    border = 4 * SPACING_M
    assert (clear < -border).sum() > 100
    np.testing.assert_array_equal(visible[clear > border], 1.0)
    np.testing.assert_array_equal(visible[clear < -border], 0.0)
    # And it is not off to one side: area of the shadow, against that of the rays.
    assert (1 - visible).sum() == pytest.approx((clear < 0).sum(), rel=0.15)
    assert ((visible > 0) & (visible < 1)).any()  # soft over a cell


@pytest.mark.parametrize("to_light", DIRECTIONS)
def test_shadow_of_a_distant_light_is_the_ball_s(ball_over_floor, to_light):
    to_light = torch.nn.functional.normalize(torch.tensor(to_light), dim=0)
    depth_map = ShadowCaster(ball_over_floor).directional(to_light)
    rays = to_light.double().numpy() * np.ones((len(ball_over_floor.points), 1))
    check_floor(ball_over_floor, depth_map, rays)


@pytest.mark.parametrize("to_light", DIRECTIONS)
def test_shadow_of_a_point_light_is_the_ball_s(ball_over_floor, to_light):
    position = 0.3 * torch.nn.functional.normalize(torch.tensor(to_light), dim=0)
    depth_map = ShadowCaster(ball_over_floor).point(position)
    check_floor(
        ball_over_floor, depth_map, position.double().numpy() - ball_over_floor.points.double().numpy()
    )


def test_a_light_between_ball_and_floor_sees_all_of_the_floor(ball_over_floor):
    visible = (
        ShadowCaster(ball_over_floor)
        .point(torch.tensor([0.0, 0.0, 0.02]))
        .visible(ball_over_floor.points, ball_over_floor.normals_world)
    )
    floor = ball_over_floor.points[:, 2] == 0
    # Far out the light grazes the floor at 0.02 / 0.15 = 8 degrees.
    assert (visible[floor] > 0.5).float().mean() > 0.99


@pytest.mark.parametrize("count", [2000, 20_000])
@pytest.mark.parametrize("to_light", [*DIRECTIONS, [1.0, 0.0, 0.0], [-0.3, 0.9, -0.4]])
def test_a_convex_body_does_not_shade_itself(count, to_light):
    portrait = sphere_portrait(count)
    to_light = torch.nn.functional.normalize(torch.tensor(to_light), dim=0)
    caster = ShadowCaster(portrait)
    lit = portrait.normals_world @ to_light > 0
    visible = caster.directional(to_light).visible(portrait.points, portrait.normals_world)
    assert (visible[lit] < 0.5).float().mean() < 0.01
    for distance in (0.15, 0.3, 3.0):
        position = distance * to_light
        lit = cosine_to(portrait.points, portrait.normals_world, position) > 0
        visible = caster.point(position).visible(portrait.points, portrait.normals_world)
        assert (visible[lit] < 0.5).float().mean() < 0.01


def test_noise_of_the_surface_does_not_shade_it():
    # Soft bumps that hide nothing from lights above the horizon by 30 degrees, with points a tenth of the
    # spacing off, as they are after smoothing.
    head = Head()
    points, normals = cloud_of(head, 12_000, 0.0003)
    portrait = portrait_of(points, normals, 0.0033)
    for to_light in DIRECTIONS:
        to_light = torch.nn.functional.normalize(torch.tensor(to_light), dim=0)
        lit = portrait.normals_world @ to_light > 0.5
        visible = (
            ShadowCaster(portrait).directional(to_light).visible(portrait.points, portrait.normals_world)
        )
        assert (visible[lit] < 0.5).float().mean() < 0.01


def test_pixels_between_the_points_are_lit_like_the_points():
    portrait = sphere_portrait(20_000)
    maps = render_maps(portrait, looking_at(np.array([0.0, 0.1, 0.5]), np.zeros(3), size=64))
    sight = ShadowCaster(portrait).of_view(maps)
    to_light = torch.nn.functional.normalize(torch.tensor([0.4, 0.3, 0.8]), dim=0)
    lit = (maps.mask > 0.5) & (maps.normals_world @ to_light > 0.1)
    for visible in (sight.directional(to_light), sight.point(0.4 * to_light)):
        assert visible.shape == (64, 64)
        assert (visible[lit] < 0.5).float().mean() < 0.01
        np.testing.assert_array_equal(visible[maps.mask == 0], 1.0)


@pytest.mark.parametrize(
    "position",
    [(0.0, 0.0, 0.0), (0.0, 0.0, 0.08), "a point", (0.0, 0.0, 0.1001), (0.0, 0.0, 1e4)],
    ids=["at the mean of the points", "inside", "at a point", "above the surface", "far away"],
)
def test_a_light_anywhere_gives_finite_shadows(position):
    portrait = sphere_portrait(2000)
    position = portrait.points[7] if position == "a point" else torch.tensor(position)
    visible = ShadowCaster(portrait).point(position).visible(portrait.points, portrait.normals_world)
    assert visible.isfinite().all()
    assert ((visible >= 0) & (visible <= 1)).all()


def test_one_point_is_lit():
    portrait = sphere_portrait(2000).subset(torch.tensor([0]))
    caster = ShadowCaster(portrait)
    for depth_map in (
        caster.directional(portrait.normals_world[0]),
        caster.point(torch.tensor([0.0, 0, 1.0])),
    ):
        np.testing.assert_array_equal(depth_map.visible(portrait.points, portrait.normals_world), [1.0])


def test_depth_maps_are_made_once():
    caster = ShadowCaster(sphere_portrait(500))
    up = torch.tensor([0.0, 0.0, 1.0])
    assert caster.directional(up) is caster.directional(up.clone())
    assert caster.directional(up) is not caster.directional(-up)
    assert caster.point(up) is not caster.directional(up)


def test_a_lone_convex_body_gets_all_of_a_panorama():
    portrait = sphere_portrait(5000)
    directions = sphere_portrait(30).normals_world
    share = ShadowCaster(portrait).environment(
        directions, torch.rand(30, 3, generator=torch.Generator().manual_seed(0))
    )
    # Self-shadowing of a convex body is acne: of the lights on a point's horizon some share may be lost.
    assert share.shape == (5000, 3)
    np.testing.assert_allclose(share, 1.0, atol=0.02)


def test_the_floor_under_the_ball_gets_less_of_a_panorama(ball_over_floor):
    directions = sphere_portrait(200).normals_world
    share = ShadowCaster(ball_over_floor).environment(directions, torch.ones(200, 3))
    floor = ball_over_floor.points[:, 2] == 0
    from_middle = torch.linalg.vector_norm(ball_over_floor.points[:, :2], dim=1)
    # Right below, the ball covers a cone with sin = radius / distance = 0.5, a quarter of the cosine-weighted
    # sky; its shadows are up to a cell of three spacings wider, a third of the sky. 200 lights hit it to 5 %.
    below = share[floor & (from_middle < 0.003)].mean()
    assert 0.65 < below < 0.77
    # A corner of the floor sees the ball as 0.04 / 0.2: a twenty-fifth of the sky, low over the horizon.
    assert share[floor & (from_middle > 0.19)].mean() > 0.95
    assert (share <= 1 + 1e-5).all()


def disc_over_floor(height_m=0.05, radius_m=0.03):
    """A floor of 0.2 m that faces up, and a disc above its middle with two sides."""
    side = np.arange(-0.1, 0.1, SPACING_M)
    x, y = (axis.ravel() for axis in np.meshgrid(side, side))
    on = np.hypot(x, y) <= radius_m
    floor = np.stack([x, y, np.zeros_like(x)], axis=1)
    disc = np.stack([x[on], y[on], np.full(on.sum(), height_m)], axis=1)
    above = np.array([0.0, 0.0, 0.0005])
    points = np.concatenate([floor, disc + above, disc - above])
    normals = np.zeros_like(points)
    normals[:, 2] = 1.0
    normals[-len(disc) :, 2] = -1.0
    return portrait_of(points, normals, SPACING_M), len(floor)


def share_by_rays(points, lights, height_m=0.05, radius_m=0.03):
    """Share [P] of the lights [K, 3] that points of the floor see past the disc, one ray after the other."""
    seen = np.zeros(len(points))
    for light in lights:
        along = (height_m - points[:, 2]) / (light[2] - points[:, 2])
        crossing = points + along[:, None] * (light - points)
        seen += np.hypot(crossing[:, 0], crossing[:, 1]) > radius_m
    return seen / len(lights)


def disc_of_light(middle, radius_m, count=2000):
    """Random places [K, 3] on a disc about a place above the origin that faces it."""
    random = np.random.default_rng(0)
    radius, angle = radius_m * np.sqrt(random.random(count)), 2 * np.pi * random.random(count)
    return middle + np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * radius], axis=1)


@pytest.mark.parametrize("kind", ["ball", "far disc"])
def test_soft_shadow_of_a_disc_is_that_of_rays(kind):
    portrait, floor = disc_over_floor()
    points = portrait.points[:floor].double().numpy()
    caster = ShadowCaster(portrait)
    if kind == "ball":  # a penumbra of 2 * 0.04 * 0.05 / 0.15 = 27 mm
        lights = disc_of_light(np.array([0.0, 0.0, 0.2]), 0.04)
        share = caster.sphere(torch.tensor([0.0, 0.0, 0.2]), 0.04)[:floor].numpy()
    else:  # 2 * tan(15 degrees) * 0.05 = 27 mm as well
        lights = disc_of_light(np.array([0.0, 0.0, 1000.0]), 1000.0 * np.tan(np.radians(15)))
        share = caster.cone(torch.tensor([0.0, 0.0, 1.0]), np.radians(30))[:floor].numpy()
    truth = share_by_rays(points, lights)
    assert ((truth > 0.02) & (truth < 0.98)).sum() > 500  # the penumbra holds points enough
    # Small lights hit an area to 1 / 48 or so; the disc's shadow is wider by up to a cell of 3 mm, and
    # so much of a penumbra of 27 mm is a ninth of the light.
    assert np.abs(share - truth).mean() < 0.02
    assert np.abs(share - truth).max() < 0.15
    # No light at all is lost in the open, and none comes into the core.
    np.testing.assert_array_equal(share[np.hypot(*points[:, :2].T) > 0.075], 1.0)
    assert share[np.hypot(*points[:, :2].T) < 0.01].max() == 0.0


def test_a_light_without_a_size_is_the_limit_of_small_ones(ball_over_floor):
    maps = render_maps(ball_over_floor, looking_at(np.array([0.0, 0.2, 0.5]), np.zeros(3), size=48))
    sight = ShadowCaster(ball_over_floor).of_view(maps)
    place = torch.tensor([0.1, 0.0, 0.4])
    on = maps.point_ids >= 0
    for hard, small in (
        (sight.point(place), sight.point(place, 1e-5)),
        (sight.directional(place / place.norm()), sight.directional(place / place.norm(), 1e-4)),
    ):
        # One is told for pixels and between cells, the other for points: they differ at the shadow's edge.
        assert (hard - small)[on].abs().mean() < 0.02


def test_no_lights_and_black_lights_shade_nothing():
    caster = ShadowCaster(sphere_portrait(500))
    np.testing.assert_array_equal(
        caster.environment(torch.zeros(0, 3), torch.zeros(0, 3)), torch.ones(500, 3)
    )
    up = torch.tensor([[0.0, 0.0, 1.0]])
    np.testing.assert_array_equal(caster.environment(up, torch.zeros(1, 3)), torch.ones(500, 3))


def test_pixels_take_the_panorama_s_share_of_their_points(ball_over_floor):
    maps = render_maps(ball_over_floor, looking_at(np.array([0.0, 0.2, 0.5]), np.zeros(3), size=48))
    caster = ShadowCaster(ball_over_floor)
    directions, irradiances = sphere_portrait(20).normals_world, torch.ones(20, 3)
    share = caster.of_view(maps).environment(directions, irradiances)
    on = maps.point_ids >= 0
    np.testing.assert_array_equal(share[on], caster.environment(directions, irradiances)[maps.point_ids[on]])
    np.testing.assert_array_equal(share[~on], 1.0)
