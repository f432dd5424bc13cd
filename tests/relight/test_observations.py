"""Which frames see a point, against rays cut with spheres, and what is read there."""

import numpy as np
import pytest
import torch
from analytic_scene import Frame, MemoryScene, looking_at

from capture.cameras import Camera
from relight.cloud import SurfaceCloud
from relight.observations import observe_points, sample_bilinear, visible_points
from relight.scene import NoiseModel

# A head, and a small ball before it that hides some of it.
CENTRES = np.array([[0.0, 0.0, 0.0], [0.05, 0.02, 0.2]])
RADII = np.array([0.1, 0.025])
SPACING_M = 0.002
CAMERA = looking_at(np.array([0.0, 0.0, 0.6]), np.zeros(3), size=256)


def ball(centre, radius):
    count = int(4 * np.pi * radius**2 / SPACING_M**2)
    i = np.arange(count) + 0.5
    z, phi = 1 - 2 * i / count, i * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - z * z)
    normals = np.stack([ring * np.cos(phi), ring * np.sin(phi), z], axis=1)
    return centre + radius * normals, normals


def two_balls():
    parts = [ball(centre, radius) for centre, radius in zip(CENTRES, RADII, strict=True)]
    points, normals = (np.concatenate([part[k] for part in parts]) for k in range(2))
    return points.astype(np.float32), normals.astype(np.float32)


def miss_m(points, eye):
    """By how much [P] the way from each point to the eye clears the other ball; below 0 = hidden."""
    towards = eye - points
    length = np.linalg.norm(towards, axis=1)
    towards = towards / length[:, None]
    clear = np.full(len(points), np.inf)
    for centre, radius in zip(CENTRES, RADII, strict=True):
        own = np.abs(np.linalg.norm(points - centre, axis=1) - radius) < 1e-4
        along = ((centre - points) * towards).sum(axis=1).clip(0, length)
        distance = np.linalg.norm(points + along[:, None] * towards - centre, axis=1) - radius
        clear = np.where(own, clear, np.minimum(clear, distance))
    return clear


def surface_of(points, normals):
    return SurfaceCloud(points.astype(np.float32), normals.astype(np.float32), SPACING_M, 0.0)


def flat_scene(radiance, hit, points, normals, **options):
    """One no-flash frame of a given picture."""
    frame = Frame(
        looking_at(np.array([0.0, 0.0, 0.6]), np.zeros(3), size=len(hit), flash=0), hit, *[radiance] * 4
    )
    return MemoryScene([frame], [radiance], torch.from_numpy(points), **options)


def test_hidden_and_turned_points_are_told_as_rays_tell_them():
    points, normals = two_balls()
    _, cosine, inside = (
        result.numpy()
        for result in visible_points(torch.from_numpy(points), torch.from_numpy(normals), CAMERA, SPACING_M)
    )
    eye = CAMERA.centre_world
    towards = (eye - points) / np.linalg.norm(eye - points, axis=1, keepdims=True)
    facing = (normals * towards).sum(axis=1)
    clear = miss_m(points, eye)
    assert inside.all()
    # The z-buffer's cell is 4.8 spacings, 9.6 mm, wide and its neighbours count: within two cells of the
    # occluder's outline either answer may come.
    undecided = np.abs(clear) < 2 * 4.8 * SPACING_M
    assert (clear < -2 * 4.8 * SPACING_M).sum() > 50  # the test has something to find
    seen = cosine > 0
    decided = ~undecided & (np.abs(facing) > 1e-3)  # cosines in float32
    np.testing.assert_array_equal(seen[decided], (facing > 0)[decided] & (clear > 0)[decided])
    # Never wrongly lit: whatever rays say is hidden by more than half a cell is never seen.
    assert not (seen & (clear < -0.5 * 4.8 * SPACING_M)).any()
    np.testing.assert_allclose(cosine[seen], facing[seen], atol=1e-5)  # float32


def test_a_convex_body_does_not_hide_itself():
    points, normals = (torch.from_numpy(values.astype(np.float32)) for values in ball(CENTRES[0], RADII[0]))
    for eye in ([0.0, 0.1, 0.6], [0.4, -0.2, -0.3], [-1.0, 0.0, 0.2]):
        camera = looking_at(np.array(eye), np.zeros(3), size=256)
        _, cosine, inside = visible_points(points, normals, camera, SPACING_M)
        towards = torch.from_numpy(camera.centre_world).float() - points
        facing = (normals * towards).sum(dim=1) / towards.norm(dim=1)
        np.testing.assert_array_equal((cosine > 0)[inside], (facing > 0)[inside])


def test_points_behind_the_camera_outside_the_picture_or_not_finite_are_not_seen():
    nan = float("nan")
    points = torch.tensor([[0.0, 0, 1.0], [0.0, 0, 0.6], [0.5, 0, 0.0], [nan, 0, 0.0], [0.0, 0, 0.0]])
    normals = torch.tensor([0.0, 0.0, 1.0]).expand(5, 3)
    _, cosine, inside = visible_points(points, normals, CAMERA, SPACING_M)
    np.testing.assert_array_equal(inside, [False, False, False, False, True])
    np.testing.assert_array_equal(cosine, [0, 0, 0, 0, 1])


def test_no_point_in_the_picture_gives_no_sight():
    away = looking_at(np.array([0.0, 0.0, 0.6]), np.array([0.0, 0.0, 2.0]), size=32)
    points, normals = (torch.from_numpy(values) for values in two_balls())
    _, cosine, inside = visible_points(points, normals, away, SPACING_M)
    assert not inside.any()
    assert not cosine.any()


def test_samples_at_pixel_centres_are_the_pixels():
    image = torch.rand(3, 5, 7, generator=torch.Generator().manual_seed(0))
    v, u = np.mgrid[0:5, 0:7] + 0.5
    samples = sample_bilinear(
        image, torch.tensor(np.stack([u, v], axis=-1).reshape(-1, 2), dtype=torch.float32)
    )
    # grid_sample goes through -1..1 in float32: 1e-6 of a pixel.
    np.testing.assert_allclose(samples, image.flatten(1).T, atol=1e-5)


def test_samples_between_pixels_are_linear_and_the_border_is_repeated():
    v, u = torch.meshgrid(torch.arange(6) + 0.5, torch.arange(8) + 0.5, indexing="ij")
    image = (2.0 * u + 3.0 * v)[None]
    at = torch.tensor([[1.25, 2.75], [4.0, 3.0], [7.1, 0.9], [0.0, 0.0], [8.0, 6.0]])
    expected = [2 * 1.25 + 3 * 2.75, 17.0, 2 * 7.1 + 3 * 0.9, 2 * 0.5 + 3 * 0.5, 2 * 7.5 + 3 * 5.5]
    np.testing.assert_allclose(sample_bilinear(image, at)[:, 0], expected, rtol=1e-5)


def test_points_read_the_pixel_they_project_to():
    points, normals = ball(CENTRES[0], RADII[0])
    v, u = np.mgrid[0:64, 0:64] + 0.5
    radiance = np.stack([u / 100, v / 100, np.full_like(u, 0.25)], axis=-1)
    scene = flat_scene(radiance, np.ones((64, 64), bool), points, normals, with_masks=False)
    observed = observe_points(scene, surface_of(points, normals))
    seen = observed.cosine[0] > 0
    assert seen.float().mean() > 0.3
    pose, K = scene.frames[0].camera.cam_from_world, scene.frames[0].camera.K
    projected = (points @ pose[:3, :3].T + pose[:3, 3]) @ K.T
    uv_px = projected[:, :2] / projected[:, 2:]
    np.testing.assert_allclose(observed.radiance[0, seen, :2], uv_px[seen] / 100, atol=1e-5)
    assert not observed.radiance[0, ~seen].any()
    assert not observed.outside.any()


def test_clipped_pixels_and_their_neighbours_have_no_weight():
    points, normals = ball(CENTRES[0], RADII[0])
    radiance = np.full((64, 64, 3), 0.3)
    radiance[:, 32:, 1] = 1.0  # one channel is enough
    scene = flat_scene(radiance, np.ones((64, 64), bool), points, normals, with_masks=False)
    observed = observe_points(scene, surface_of(points, normals))
    seen = observed.cosine[0] > 0
    u = 32 + 1.75 * 64 * points[:, 0] / (0.6 - points[:, 2])
    assert not seen[u > 31.51].any()
    assert seen[u < 31.49].any()
    np.testing.assert_allclose(observed.radiance[0, seen], 0.3, rtol=1e-5)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e30])
def test_what_is_no_measurement_does_not_reach_its_neighbours(value):
    # The point lies a two-thousandth of a pixel towards the broken one: it is trusted, with that share of it.
    point = np.array([[(20.5005 - 32) * 0.6 / (1.75 * 64), 0.0, 0.0]], np.float32)
    radiance = np.full((64, 64, 3), 0.3)
    radiance[:, 21] = value
    noise = NoiseModel(np.full(3, 0.01), np.full(3, 1e-3))
    scene = flat_scene(radiance, np.ones((64, 64), bool), point, point, with_masks=False, noise=noise)
    observed = observe_points(scene, surface_of(point, np.array([[0.0, 0.0, 1.0]])))
    assert observed.cosine[0, 0] > 0.9
    np.testing.assert_allclose(observed.radiance[0, 0], 0.3, rtol=1e-3)  # the share
    np.testing.assert_allclose(observed.variance[0, 0], (0.01**2 + 1e-3 * 0.3) / 3, rtol=1e-3)


def test_off_the_mask_and_at_its_edge_points_have_no_weight_and_count_as_outside():
    points, normals = ball(CENTRES[0], RADII[0])
    hit = np.zeros((64, 64), bool)
    hit[:, :32] = True
    observed = observe_points(
        flat_scene(np.full((64, 64, 3), 0.3), hit, points, normals), surface_of(points, normals)
    )
    seen = (observed.cosine[0] > 0).numpy()
    u = 32 + 1.75 * 64 * points[:, 0] / (0.6 - points[:, 2])
    # The last whole pixel of the mask mixes with the background, and the one before it in the bilinear sum.
    assert not seen[u > 30.51].any()
    assert seen[u < 30.49].any()
    # Half a pixel beyond the mask is still taken for inside: poses err that much.
    np.testing.assert_array_equal(observed.outside[u > 33.1], 1.0)
    np.testing.assert_array_equal(observed.outside[u < 32.9], 0.0)


def test_the_flash_is_where_the_offset_puts_it():
    eye = np.array([0.3, 0.1, 0.5])
    camera = looking_at(eye, np.zeros(3), size=32, flash=1)
    dark = looking_at(-eye, np.zeros(3), size=32, flash=0)
    empty = np.zeros((32, 32, 3))
    frames = [Frame(c, np.ones((32, 32), bool), *[empty] * 4) for c in (camera, dark)]
    points, normals = ball(CENTRES[0], RADII[0])
    observed = observe_points(
        MemoryScene(frames, [empty] * 2, torch.from_numpy(points)), surface_of(points, normals)
    )
    assert observed.flash.tolist() == [True, False]
    rotation = camera.cam_from_world[:3, :3]
    # x is to the right of the picture, y downwards.
    expected = eye + 0.015 * rotation[0] - 0.01 * rotation[1]
    np.testing.assert_allclose(observed.flash_position_world[0], expected, atol=1e-6)


@pytest.mark.parametrize("size", [(1, 1), (3, 2)])
def test_tiny_pictures_can_be_observed(size):
    width, height = size
    K = np.array([[10.0, 0, width / 2], [0, 10.0, height / 2], [0, 0, 1]])
    camera = Camera("tiny", width, height, K, CAMERA.cam_from_world, flash=0)
    picture = np.full((height, width, 3), 0.5)
    points, normals = ball(CENTRES[0], RADII[0])
    frame = Frame(camera, np.ones((height, width), bool), *[picture] * 4)
    scene = MemoryScene([frame], [picture], torch.from_numpy(points), with_masks=False)
    observed = observe_points(scene, surface_of(points, normals))
    np.testing.assert_allclose(observed.radiance[0][observed.cosine[0] > 0], 0.5, rtol=1e-6)  # float32
