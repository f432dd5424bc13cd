"""Point clouds of the sitter: exact ones for measuring, and one as noisy as dense stereo gives."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from capture.cameras import Camera
from capture.ply import PointCloud
from capture.sim.bust import Bust
from capture.sim.noise import value_noise
from capture.sim.rasterize import Raster, project
from capture.sim.visibility import depth_visibility
from capture.transfer import to_display

_STRAND_SHARE = 0.03  # of the points lie on loose strands
_FLOOR_M = -0.36  # below, the bust is cut off; no camera looks there
_NOISE_M = 0.0005
_BUMPS_M = 0.0004
_BUMP_SCALE_M = 0.02
_HOLES = 0.02
_HOLE_RADIUS_M = 0.006
_OUTLIERS = 0.01


def _sample(
    bust: Bust, triangles: np.ndarray, count: int, rng: np.random.Generator
) -> tuple[np.ndarray, ...]:
    """Points, normals, albedo [count, 3] evenly over triangles."""
    a, b, c = (bust.vertices[triangles[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=-1).astype(np.float64)
    area *= (a[:, 1] > _FLOOR_M) & (b[:, 1] > _FLOOR_M) & (c[:, 1] > _FLOOR_M)
    chosen = triangles[rng.choice(len(triangles), size=count, p=area / area.sum())]
    r1, r2 = np.sqrt(rng.random((count, 1))), rng.random((count, 1))
    weights = np.concatenate([1 - r1, r1 * (1 - r2), r1 * r2], axis=-1).astype(np.float32)
    points, normals, albedo = (
        np.einsum("ti,tic->tc", weights, values[chosen])
        for values in (bust.vertices, bust.normals, bust.albedo)
    )
    return points, normals / np.linalg.norm(normals, axis=-1, keepdims=True), albedo


def sample_surface(bust: Bust, count: int, rng: np.random.Generator) -> PointCloud:
    """Exact points on skin, shirt and hair, with shading normals and sRGB reflectance as colours."""
    on_strands = round(count * _STRAND_SHARE) if len(bust.strand_triangles) else 0
    parts = [_sample(bust, bust.solid_triangles, count - on_strands, rng)]
    if on_strands:
        parts.append(_sample(bust, bust.strand_triangles, on_strands, rng))
    points, normals, albedo = (np.concatenate(values) for values in zip(*parts, strict=True))
    return PointCloud(points, normals, to_display(albedo, "srgb"))


def stereo_cloud(bust: Bust, cameras: list[Camera], count: int, rng: np.random.Generator) -> PointCloud:
    """Points as dense stereo finds them: what cameras see, with noise, bumps, holes and outliers.

    Noise of 0.5 mm along the ray of the camera that sees a point best, more at grazing angles; bumps of 0.4
    mm; about 2 % of the points missing in holes and 1 % of outliers. No normals, no colours.
    """
    exact = sample_surface(bust, 5 * count // 2, rng)  # half and more may be hidden or below the picture
    assert exact.normals is not None
    best = np.full(len(exact.points), 0.15)  # cosine below which stereo finds nothing
    rays = np.zeros_like(exact.points)
    for camera in cameras:
        raster = Raster.empty(camera)
        raster.draw(bust.vertices, bust.triangles, None)
        pixel, depth = project(camera, exact.points)
        inside = (
            (depth > 0)
            & (pixel > 1).all(axis=-1)
            & (pixel < [camera.width - 1, camera.height - 1]).all(axis=-1)
        )
        ray = exact.points - camera.centre_world.astype(np.float32)
        ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
        cosine = -(ray * exact.normals).sum(axis=-1)
        seen = inside & (depth_visibility(raster, exact.points, 0.002, 0.002) > 0.5) & (cosine > best)
        best[seen], rays[seen] = cosine[seen], ray[seen]
    found = np.nonzero(best > 0.15)[0][:count]
    points, rays = exact.points[found], rays[found]
    spread = _NOISE_M / np.sqrt(best[found])
    bumps = _BUMPS_M * value_noise(points, _BUMP_SCALE_M, 4)
    points = points + (spread * rng.normal(size=len(points)))[:, None] * rays
    points = points + bumps[:, None] * exact.normals[found]
    per_hole = max(1.0, len(points) * np.pi * _HOLE_RADIUS_M**2 / 0.2)  # the bust shows about 0.2 m^2
    centres = points[rng.choice(len(points), size=max(1, round(_HOLES * len(points) / per_hole)))]
    distance, _ = cKDTree(centres).query(points)
    points = points[distance > _HOLE_RADIUS_M]
    strays = rng.choice(len(points), size=round(_OUTLIERS * len(points)), replace=False)
    points[strays] += rng.normal(0.0, 0.015, (len(strays), 3))
    return PointCloud(points.astype(np.float32), None, None)
