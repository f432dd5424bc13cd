"""From pixels to the surface: world points of places in frames, by the cloud's depth there."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from capture.cameras import Camera
from relight.face.plane import Floats
from relight.raster import rasterize_ids

_LEVELS = 5  # a hole between points is filled from pixels up to 16 times as wide
_TOGETHER = 0.05  # of the depth: what a coarser pixel holds further apart is another surface


def lift(points: torch.Tensor, camera: Camera, uv_px: Floats) -> NDArray[np.float64]:
    """World points [..., 3] that a frame shows at pixels [..., 2]; NaN where it shows none of the cloud.

    Args:
        points: [P, 3] float32, the cloud.
        camera: Without distortion.
        uv_px: Pixels, centres at 0.5.
    """
    flat = np.asarray(uv_px, np.float64).reshape(-1, 2)
    pyramid = rasterize_ids(points, camera, _LEVELS)
    depth = np.full(len(flat), np.nan)
    with np.errstate(invalid="ignore"):
        inside = (flat >= 0).all(axis=1) & (flat[:, 0] < camera.width) & (flat[:, 1] < camera.height)
    nearest = pyramid.depth_m[2].numpy()
    place = np.where(inside[:, None], flat, 0.0).astype(np.int64)
    # What shows between the points of the nearer surface lies behind the nearest of its neighbourhood.
    limit = nearest[place[:, 1] >> 2, place[:, 0] >> 2] * (1.0 + _TOGETHER)
    for level, depths in enumerate(pyramid.depth_m):
        found = depths.numpy()[place[:, 1] >> level, place[:, 0] >> level]
        take = inside & np.isnan(depth) & np.isfinite(found) & (found <= np.where(level < 2, limit, np.inf))
        depth[take] = found[take]
    rays = np.concatenate([flat, np.ones((len(flat), 1))], axis=1) @ np.linalg.inv(camera.K).T
    world = (rays * depth[:, None] - camera.cam_from_world[:3, 3]) @ camera.cam_from_world[:3, :3]
    lifted: NDArray[np.float64] = world.reshape(*uv_px.shape[:-1], 3)
    return lifted
