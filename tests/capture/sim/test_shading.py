"""The flash on a plate, where everything is known in closed form."""

import numpy as np
import pytest

from capture.cameras import Camera
from capture.sim.bust import Bust
from capture.sim.meshing import Mesh
from capture.sim.rasterize import rays_world
from capture.sim.shading import draw_layer, facing_vertices, point_light

SIDE_M = 0.4
ALBEDO = 0.5
COLOR = np.array([0.2, 0.15, 0.1])


def plate(z: float, side: float, count: int) -> Mesh:
    """A square plate [-side/2, side/2]^2 at height z that faces +z."""
    line = np.linspace(-side / 2, side / 2, count)
    x, y = np.meshgrid(line, line)
    vertices = np.stack([x, y, np.full_like(x, z)], axis=-1).reshape(-1, 3).astype(np.float32)
    index = np.arange(count * count).reshape(count, count)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    triangles = [np.stack(corner, axis=-1).reshape(-1, 3) for corner in ((a, b, c), (a, c, d))]
    return Mesh(vertices, np.concatenate(triangles).astype(np.int32))


def bust_of(*meshes: Mesh, gloss: float = 0.0) -> Bust:
    starts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])
    vertices = np.concatenate([mesh.vertices for mesh in meshes])
    triangles = np.concatenate(
        [mesh.triangles + start for mesh, start in zip(meshes, starts[:-1], strict=True)]
    )
    count = len(vertices)
    return Bust(
        vertices=vertices,
        normals=np.tile(np.array([0, 0, 1], np.float32), (count, 1)),
        albedo=np.full((count, 3), ALBEDO, np.float32),
        gloss=np.full(count, gloss, np.float32),
        wet=np.zeros(count, bool),
        tangents=np.zeros((count, 3), np.float32),
        triangles=triangles.astype(np.int32),
        strand_start=count,
        occluder=meshes[0],
        occluder_of=np.zeros((count, 3), np.int32),
    )


@pytest.fixture
def camera() -> Camera:
    pose = np.diag([1.0, -1.0, -1.0, 1.0])  # at (0, 0, 0.5), looking down at the plate
    pose[2, 3] = 0.5
    return Camera("c", 60, 60, np.array([[120.0, 0, 30], [0, 120.0, 30], [0, 0, 1]]), pose)


def lit(bust: Bust, camera: Camera, lamp: np.ndarray, eye: np.ndarray | None = None) -> np.ndarray:
    chosen = facing_vertices(bust, camera.centre_world)
    radiance = np.zeros_like(bust.albedo)
    radiance[chosen] = point_light(bust, lamp, COLOR, chosen, eye)
    return draw_layer(bust, camera, radiance, 2).radiance


def test_the_flash_falls_off_with_the_square_of_the_distance_and_the_cosine(camera: Camera) -> None:
    lamp = camera.centre_world + np.array([0.05, 0.02, 0.0])
    picture = lit(bust_of(plate(0.0, SIDE_M, 161)), camera, lamp)
    points = camera.centre_world + 0.5 * rays_world(camera)
    ray = lamp - points
    square = (ray**2).sum(-1)
    expected = ALBEDO * COLOR * (ray[..., 2] / square**1.5)[..., None]
    # Vertices 2.5 mm apart, light that changes over half a metre: interpolation costs (2.5 mm / 0.5 m)^2.
    assert np.abs(picture / expected - 1).max() < 1e-3


def test_a_small_plate_casts_its_shadow_where_the_rays_say(camera: Camera) -> None:
    lamp = np.array([0.2, 0.0, 0.4])
    blocker = plate(0.05, 0.03, 31)
    shadowed = lit(bust_of(plate(0.0, SIDE_M, 401), blocker), camera, lamp)
    open_ = lit(bust_of(plate(0.0, SIDE_M, 401)), camera, lamp)
    # The ray from the lamp through the blocker's middle meets the plate at x = -0.2 * 0.05 / 0.35.
    centre = np.array([-0.2 * 0.05 / 0.35, 0.0])
    points = (camera.centre_world + 0.5 * rays_world(camera))[..., :2]
    half = 0.5 * 0.03 * 0.4 / 0.35
    inside = (np.abs(points - centre) < half - 0.006).all(-1)
    # Pixels of the blocker itself, with a margin of two pixels.
    itself = (np.abs(points) < 0.5 * 0.03 * 0.5 / 0.45 + 0.009).all(-1)
    outside = (np.abs(points - centre) > half + 0.006).any(-1) & ~itself
    assert (inside & ~itself).sum() > 10
    assert shadowed[inside & ~itself].max() < 1e-6
    assert np.allclose(shadowed[outside], open_[outside], rtol=1e-3)


def test_gloss_adds_light_where_the_lamp_is_mirrored_and_little_elsewhere(camera: Camera) -> None:
    lamp, eye = camera.centre_world + np.array([0.02, 0, 0]), camera.centre_world
    matt = lit(bust_of(plate(0.0, SIDE_M, 81)), camera, lamp, eye)
    glossy = lit(bust_of(plate(0.0, SIDE_M, 81), gloss=0.04), camera, lamp, eye)
    added = (glossy - matt).max(axis=-1) / matt.max(axis=-1)
    peak = 0.04 * (22 + 8) / 8 / ALBEDO  # the lobe's height (m + 8) / 8 over the Lambertian part
    assert added[30, 31] == pytest.approx(peak, rel=0.02)
    assert added[0, 0] < 0.6 * peak
