"""Which frames see which texels of a face, with the rest of the head in the way."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from scipy.spatial import cKDTree

from capture.cameras import Camera
from relight.face.plane import Floats
from relight.face.surface import FaceSurface
from relight.observations import visible_points
from relight.stages import Progress, no_progress

_MOST_OCCLUDERS = 100_000
_CELL = 2.4  # spacings a cell of the z-buffer: a nose hides the cheek beside it no further than it does
_MARGIN_PX = 1.0  # at the picture's very edge nothing can be interpolated


def texel_cosines(
    surface: FaceSurface,
    points: Floats,
    normals: Floats,
    cameras: Mapping[int, Camera],
    progress: Progress = no_progress,
) -> torch.Tensor:
    """How each frame sees each texel of the face.

    Args:
        surface: The face.
        points: [P, 3] of the whole cloud: what may hide the face.
        normals: [P, 3].
        cameras: By frame index, without distortion.
        progress: Told ("face", fraction).

    Returns:
        [F, 256, 256] uint8: 255 * cosine between normal and direction to the camera, at least 1 where the
        frame shows the texel; 0 where it is hidden, turned away, outside, or not of the face's region.
    """
    chosen = np.flatnonzero(np.isfinite(points).all(axis=1))
    chosen = chosen[:: max(1, len(chosen) // _MOST_OCCLUDERS)]
    wanted = surface.region & surface.valid
    texels, texel_normals = surface.points[wanted], surface.normals_world[wanted]
    cosines = torch.zeros(len(cameras), *wanted.shape, dtype=torch.uint8)
    if not len(texels):
        return cosines
    everything = torch.cat([texels, torch.from_numpy(np.ascontiguousarray(points[chosen], np.float32))])
    directions = torch.cat(
        [texel_normals, torch.from_numpy(np.ascontiguousarray(normals[chosen], np.float32))]
    )
    spacing = _spacing(points[chosen])
    for k, camera in enumerate(cameras.values()):
        uv_px, cosine, inside = visible_points(everything, directions, camera, spacing, cell=_CELL)
        u, v = uv_px[: len(texels)].unbind(1)
        well_inside = inside[: len(texels)] & (u >= _MARGIN_PX) & (v >= _MARGIN_PX)
        well_inside &= (u <= camera.width - _MARGIN_PX) & (v <= camera.height - _MARGIN_PX)
        seen = torch.where(well_inside, cosine[: len(texels)], 0.0)
        codes = torch.where(seen > 0, (seen * 255.0).round().clamp(min=1.0), 0.0)
        cosines[k][wanted] = codes.to(torch.uint8)
        progress("face", (k + 1) / len(cameras))
    return cosines


def _spacing(points: Floats) -> float:
    """Typical distance of the points that are left."""
    neighbours = min(5, len(points))
    sample = points[:: max(1, len(points) // 4000)]
    distances, _ = cKDTree(points).query(sample, k=[neighbours], workers=1)
    return max(float(np.median(distances)) / 1.26, 1e-12)
