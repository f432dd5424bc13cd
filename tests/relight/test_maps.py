"""Maps of planes and spheres against their formulas, at every ratio of points to pixels."""

from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from analytic_scene import looking_at, portrait_of, sphere_portrait

from relight.maps import _COVERED, Maps, _add_at, pull_push, render_maps

RADIUS_M = 0.1
EYE = np.array([0.1, 0.15, 0.45])


def plane_portrait(half_m=0.1, spacing=0.002):
    """A square across the z axis that faces it, its albedo a gradient in x and y."""
    side = np.arange(-half_m, half_m + 1e-9, spacing)
    x, y = (axis.ravel() for axis in np.meshgrid(side, side))
    points = np.stack([x, y, np.zeros_like(x)], axis=1)
    albedo = np.stack([0.5 + 2 * x, 0.5 + 2 * y, np.full_like(x, 0.3)], axis=1)
    return portrait_of(
        points, np.tile([0.0, 0, 1], (len(x), 1)), spacing, albedo=albedo, shading=0.5 + 2 * x, confidence=0.7
    )


def pixel_rays(camera):
    v, u = np.mgrid[0 : camera.height, 0 : camera.width] + 0.5
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(camera.K).T
    rays = rays @ camera.cam_from_world[:3, :3]
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def sphere_truth(camera):
    """Whether each pixel's centre shows the sphere [H, W], and where [H, W, 3]."""
    rays, eye = pixel_rays(camera), camera.centre_world
    b, c = (rays * eye).sum(axis=-1), eye @ eye - RADIUS_M**2
    hit = b * b > c
    return hit, eye + (-b - np.sqrt(np.maximum(b * b - c, 0)))[..., None] * rays


def shrunk(hit, pixels):
    """The pixels of a mask that are this far from its edge."""
    padded = np.pad(hit, pixels)
    height, width = hit.shape
    inner = np.ones_like(hit)
    for dy in range(2 * pixels + 1):
        for dx in range(2 * pixels + 1):
            inner &= padded[dy : dy + height, dx : dx + width]
    return inner


def assert_zero(maps):
    for field in fields(Maps):
        if (value := getattr(maps, field.name)) is None:
            continue
        assert (value == (-1 if field.name == "point_ids" else 0)).all(), field.name


def assert_finite(maps):
    for field in fields(Maps):
        value = getattr(maps, field.name)
        assert value is None or value.isfinite().all(), field.name


def test_a_plane_that_faces_the_camera_is_drawn_as_it_is():
    camera = looking_at(np.array([0.0, 0.0, 0.5]), np.zeros(3), size=64, focal_px=200)
    maps = render_maps(plane_portrait(), camera)  # a point every 0.8 pixels
    rays, z = pixel_rays(camera), 0.5
    where = camera.centre_world + rays * (z / -rays[..., 2:])
    inner = shrunk(maps.mask.numpy() > 0.99, 2)
    assert inner.sum() > 50**2
    # Within a splat of 0.4 px the few points that a pixel has lie unevenly: a fifth of the spacing of 2 mm.
    np.testing.assert_allclose(maps.albedo[inner][:, :2], 0.5 + 2 * where[inner][:, :2], atol=2 * 0.0004)
    np.testing.assert_allclose(maps.shading[inner], 0.5 + 2 * where[inner][:, 0], atol=2 * 0.0004)
    # What is constant stays so to float32.
    np.testing.assert_allclose(maps.albedo[inner][:, 2], 0.3, atol=1e-6)
    np.testing.assert_allclose(maps.confidence[inner], 0.7, atol=1e-6)
    np.testing.assert_allclose(maps.depth[inner], z, atol=1e-6)
    np.testing.assert_allclose(maps.normals_world[inner], np.tile([0, 0, 1], (inner.sum(), 1)), atol=1e-6)
    np.testing.assert_allclose(maps.points_world[inner], where[inner], atol=1e-6)


# From three points a pixel to a point every nine pixels: a portrait is looked at from afar and from nearby.
@pytest.mark.parametrize(
    ("count", "size"), [(20_000, 32), (20_000, 128), (20_000, 256), (2000, 64), (2000, 256)]
)
def test_a_sphere_has_its_outline_and_no_holes(count, size):
    camera = looking_at(EYE, np.zeros(3), size=size)
    maps = render_maps(sphere_portrait(count, RADIUS_M), camera)
    hit, where = sphere_truth(camera)
    mask = maps.mask.numpy() > 0.5
    assert (mask & hit).sum() / (mask | hit).sum() > 0.97
    # Points know the outline to about half their distance.
    border_px = 1 + int(np.ceil(0.5 * maps_spacing_px(count, camera)))
    assert mask[shrunk(hit, border_px)].all()
    inner = shrunk(hit, 2 * border_px)
    normals, truth = maps.normals_world.numpy()[inner], where[inner] / RADIUS_M
    angles = np.degrees(np.arccos(np.clip((normals * truth).sum(axis=-1), -1, 1)))
    # Blurred over half a spacing, the normals of a sphere stay; unevenness moves them by a fifth of the angle
    # between neighbours.
    between_deg = np.degrees(np.sqrt(4 * np.pi / count))
    assert np.sqrt(np.mean(angles**2)) < 0.4 * between_deg + 0.2
    distance = np.linalg.norm(maps.points_world.numpy()[inner], axis=-1)
    assert np.sqrt(np.mean((distance - RADIUS_M) ** 2)) < 0.2 * RADIUS_M * np.radians(between_deg)


def maps_spacing_px(count, camera):
    return RADIUS_M * np.sqrt(4 * np.pi / count) * camera.K[0, 0] / (np.linalg.norm(EYE) - RADIUS_M)


def test_no_value_is_missing_where_the_mask_is():
    albedo = np.random.default_rng(0).uniform(0.2, 0.8, (5000, 3))
    maps = render_maps(sphere_portrait(5000, albedo=albedo), looking_at(EYE, np.zeros(3), size=96))
    on = maps.mask > 0
    assert (maps.albedo[on] >= 0.2 - 1e-5).all()  # means of what there is: float32
    assert (maps.albedo[on] <= 0.8 + 1e-5).all()
    assert (maps.depth[on] > 0.3).all()
    np.testing.assert_allclose(torch.linalg.vector_norm(maps.normals_world[on], dim=-1), 1.0, atol=1e-5)
    assert maps.mask.max() <= 1
    for name in ("albedo", "normals_world", "room_radiance", "shading", "depth", "points_world", "gloss"):
        assert not getattr(maps, name)[~on].any(), name
    assert (maps.point_ids[on] >= 0).float().mean() > 0.95  # the rest are the soft edge
    assert (maps.point_ids[~on] == -1).all()


def test_point_ids_are_points_of_the_pixel():
    portrait = sphere_portrait(20_000, RADIUS_M)
    camera = looking_at(EYE, np.zeros(3), size=96)
    maps = render_maps(portrait, camera)
    on = (maps.mask > 0.99) & (maps.point_ids >= 0)
    gap = torch.linalg.vector_norm(portrait.points[maps.point_ids[on]] - maps.points_world[on], dim=-1)
    # In the pixel (1.9 mm; its diagonal, and more where the surface is slanted) or one of a coarser level.
    assert gap.median() < 0.002
    assert torch.quantile(gap, 0.99) < 0.015


def test_the_nearer_of_two_sheets_is_drawn():
    near, far = plane_portrait(0.05), plane_portrait(0.1)
    points = torch.cat([near.points + torch.tensor([0.0, 0, 0.1]), far.points])
    colour = torch.cat([torch.full((len(near.points),), 0.9), torch.full((len(far.points),), 0.1)])
    both = portrait_of(
        points, torch.tensor([0.0, 0, 1]).expand(len(points), 3), 0.002, albedo=colour[:, None]
    )
    maps = render_maps(both, looking_at(np.array([0.0, 0.0, 0.5]), np.zeros(3), size=64, focal_px=150))
    u = torch.arange(64) + 0.5 - 32
    reach = torch.maximum(u.abs()[:, None], u.abs()[None])
    # The near square ends at 0.05 * 150 / 0.4 = 18.75 px, the far one at 30; edges mix 1.5 px.
    np.testing.assert_allclose(maps.albedo[reach < 17], 0.9, atol=1e-4)
    np.testing.assert_allclose(maps.albedo[(reach > 21) & (reach < 28)], 0.1, atol=1e-4)


def test_a_subject_cut_by_the_picture_s_edge_does_not_fade_there():
    camera = looking_at(EYE, np.zeros(3), size=32, focal_px=400)
    maps = render_maps(sphere_portrait(20_000), camera)
    np.testing.assert_allclose(maps.mask, 1.0, atol=1e-6)


@pytest.mark.parametrize("eye_z", [-0.5, 0.5])
def test_a_camera_that_looks_away_or_at_the_back_of_a_sheet_sees_nothing(eye_z):
    target = np.zeros(3) if eye_z < 0 else np.array([0.0, 0.0, 1.0])
    maps = render_maps(plane_portrait(), looking_at(np.array([0.0, 0.01, eye_z]), target, size=24))
    assert maps.mask.shape == (24, 24)
    assert_zero(maps)


def test_a_camera_inside_the_subject_gives_finite_maps():
    maps = render_maps(sphere_portrait(2000), looking_at(np.array([0.0, 0.0, 0.02]), np.zeros(3), size=24))
    assert_finite(maps)


def test_one_point_is_a_dot():
    portrait = sphere_portrait(2000).subset(torch.tensor([10]))
    maps = render_maps(portrait, looking_at(np.array([0.0, 0.0, 0.5]), np.zeros(3), size=33))
    assert_finite(maps)
    assert 0 < (maps.mask > 0).sum() < 80


@pytest.mark.parametrize(("width", "height"), [(1, 1), (7, 2), (31, 45)])
def test_pictures_of_any_size_are_drawn(width, height):
    camera = looking_at(EYE, np.zeros(3), size=width)
    K = camera.K.copy()
    K[1, 2] = height / 2
    maps = render_maps(sphere_portrait(2000), replace(camera, height=height, K=K))
    assert maps.albedo.shape == (height, width, 3)
    assert maps.mask[height // 2, width // 2] > 0.5


def test_the_same_view_is_drawn_the_same():
    portrait, camera = sphere_portrait(5000), looking_at(EYE, np.zeros(3), size=48)
    first, second = render_maps(portrait, camera), render_maps(portrait, camera)
    for field in fields(Maps):
        if getattr(first, field.name) is not None:
            np.testing.assert_array_equal(getattr(first, field.name), getattr(second, field.name))


def test_adding_rows_at_places_is_the_sum_one_by_one():
    random = np.random.default_rng(0)
    places, shares = random.integers(0, 20, (50, 9)), random.uniform(0, 1, (50, 9)).astype(np.float32)
    rows = random.normal(size=(50, 4)).astype(np.float32)
    plain = np.zeros((20, 4))
    for point in range(50):
        for place, share in zip(places[point], shares[point], strict=True):
            plain[place] += np.float64(share) * rows[point]
    added = _add_at(*(torch.from_numpy(values) for values in (places.astype(np.int32), shares, rows)), 20)
    np.testing.assert_allclose(added, plain, atol=1e-5)  # some twenty float32 numbers of about 1


def test_a_part_of_the_picture_is_filled_as_the_whole():
    random = torch.Generator().manual_seed(0)
    weight = torch.rand(64, 96, generator=random) * (torch.rand(64, 96, generator=random) < 0.3)
    weight[:, 64:] = 0
    sums = torch.cat([torch.rand(2, 64, 96, generator=random) * weight, weight[None]])
    wanted = torch.zeros(64, 96, dtype=torch.bool)
    wanted[:, :60] = True
    whole, part = pull_push(sums, _COVERED), pull_push(sums[:, :, :64], _COVERED, wanted[:, :64])
    # 30 % of the pixels know a value, so that no gap needs a level at which the two differ: float32.
    np.testing.assert_allclose(part[:, wanted[:, :64]], whole[:, wanted], atol=1e-6)


@pytest.mark.parametrize("shape", [(1, 1), (5, 8), (33, 17), (64, 64)])
@pytest.mark.parametrize("density", [1.0, 0.2, 0.0])
def test_pulling_and_pushing_a_constant_leaves_it(shape, density):
    random = torch.Generator().manual_seed(0)
    weight = torch.rand(*shape, generator=random) * (torch.rand(*shape, generator=random) < density)
    weight[0, 0] = 0.3
    filled = pull_push(torch.stack([0.37 * weight, -2.0 * weight, weight]), 0.05)
    np.testing.assert_allclose(filled[0], 0.37, rtol=1e-5)  # float32 through a few levels
    np.testing.assert_allclose(filled[1], -2.0, rtol=1e-5)


def test_pulling_and_pushing_nothing_gives_zero():
    filled = pull_push(torch.zeros(4, 9, 13), 0.05)
    assert filled.shape == (3, 9, 13)
    assert not filled.any()


def test_gradients_are_finite_where_nothing_is_known():
    for corner in (0.0, 0.3):  # no weight at all, and a lone one far from the others
        sums = torch.zeros(4, 33, 17)
        sums[:, 0, 0] = corner
        sums.requires_grad_()
        (gradient,) = torch.autograd.grad(pull_push(sums, 0.05).sum(), sums)
        assert gradient.isfinite().all()


def test_pixels_with_enough_weight_keep_their_values():
    random = torch.Generator().manual_seed(0)
    values, weight = torch.rand(20, 20, generator=random), torch.full((20, 20), 0.05)
    weight[:, 10:] = 0
    filled = pull_push(torch.stack([values * weight, weight]), 0.05)[0]
    np.testing.assert_allclose(filled[:, :10], values[:, :10], rtol=1e-5)
    assert (filled[:, 10:] >= values[:, :10].min()).all()
    assert (filled[:, 10:] <= values[:, :10].max()).all()
