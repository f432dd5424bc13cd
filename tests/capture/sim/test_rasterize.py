import numpy as np

from capture.cameras import Camera
from capture.sim.rasterize import Raster, project, rays_world


def off_centre_camera() -> Camera:
    angle = 0.3
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    pose[:3, 3] = [0.1, -0.05, 0.4]
    return Camera("c", 90, 60, np.array([[80.0, 0, 40.0], [0, 95.0, 33.0], [0, 0, 1]]), pose)


def test_a_pixel_holds_the_point_that_its_centres_ray_meets() -> None:
    camera = off_centre_camera()
    vertices = np.array([[-2, -2, 1.0], [2, -2, 1.5], [2, 2, 1.5], [-2, 2, 1.0]], np.float32)
    triangles = np.array([[0, 2, 1], [0, 3, 2]], np.int32)
    raster = Raster.empty(camera)
    raster.draw(vertices, triangles, vertices)
    assert raster.covered.all()
    expected = camera.centre_world + raster.depth[..., None] * rays_world(camera)
    # float32 positions of metres, one part in 10^5 after the perspective division
    assert np.abs(raster.values - expected).max() < 3e-5
    pixel, depth = project(camera, raster.values.reshape(-1, 3))
    columns, rows = np.meshgrid(np.arange(90) + 0.5, np.arange(60) + 0.5)
    assert np.abs(pixel - np.stack([columns.ravel(), rows.ravel()], axis=-1)).max() < 5e-3
    assert np.abs(depth - raster.depth.ravel()).max() < 3e-5


def test_a_triangle_seen_from_behind_is_not_drawn() -> None:
    camera = off_centre_camera()
    vertices = np.array([[-2, -2, 1.0], [2, -2, 1.5], [2, 2, 1.5]], np.float32)
    raster = Raster.empty(camera)
    raster.draw(vertices, np.array([[0, 1, 2]], np.int32), None)
    assert not raster.covered.any()
