"""The visual hull: what lies inside the subject's outline in all masks, where stereo finds no surface.

It has no hollows (eye sockets, ears) and bulges where no camera looked; it is the fallback.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from relight.head_region import HeadRegion
from relight.observations import sample_bilinear
from relight.raster import NEAR_M, project
from relight.stereo.frames import GreyFrames
from relight.stereo.views import directions_from, spread_out

_FEWEST_MASKS = 5
_MOST_MASKS = 40
_GRID = 112  # boxes along the region's diameter: 5 mm on a head, and the outlines' curvature in between
_FEWEST_POINTS = 500
_MISSES = 0.05  # share of the masks that may leave a point out: masks err


def visual_hull(
    frames: GreyFrames, region: HeadRegion
) -> tuple[NDArray[np.float32], NDArray[np.float32], int] | None:
    """Points [P, 3], outward unit normals [P, 3] and the number of masks; None without enough of them."""
    masks = {index: mask for index in frames.cameras if (mask := frames.mask(index)) is not None}
    masks = {index: mask for index, mask in masks.items() if mask.max() > 0.5}
    if len(masks) < _FEWEST_MASKS:
        return None
    order = list(masks)
    directions = directions_from(region.centre_world, [frames.cameras[index] for index in order])
    chosen = [order[place] for place in spread_out(directions, _MOST_MASKS)]
    steps = ((np.arange(_GRID) + 0.5) / _GRID * 2.0 - 1.0) * region.radius
    lattice = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    points = torch.from_numpy((lattice + region.centre_world).astype(np.float32))
    inside, shown = torch.zeros(len(points)), torch.zeros(len(points))
    for index in chosen:
        camera = frames.cameras[index]
        uv_px, z = project(points, camera)
        there = (z > NEAR_M) & (uv_px > 0).all(dim=1)
        there &= (uv_px[:, 0] < camera.width) & (uv_px[:, 1] < camera.height)
        place = uv_px.where(there[:, None], torch.zeros_like(uv_px))
        coverage = sample_bilinear(torch.from_numpy(masks[index])[None], place)[:, 0]
        inside += torch.where(there, coverage, 0.0)
        shown += there
    # 1 inside all masks, 0 outside more than may err; linear in between.
    share = inside / shown.clamp(min=1.0)
    fill = ((share - (1.0 - 2.0 * _MISSES)) / (2.0 * _MISSES)).clamp(0.0, 1.0)
    fill *= shown >= min(_FEWEST_MASKS, len(chosen))
    fill *= torch.from_numpy((np.linalg.norm(lattice, axis=1) < region.radius).astype(np.float32))
    found = _surface(fill.view(1, 1, _GRID, _GRID, _GRID), steps[1] - steps[0])
    if len(found[0]) < _FEWEST_POINTS:
        return None
    surface = found[0] + torch.from_numpy((region.centre_world + steps[0]).astype(np.float32))
    return surface.numpy(), found[1].numpy(), len(chosen)


def _surface(fill: torch.Tensor, side: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Points where a smoothed field [1, 1, N, N, N] is one half, relative to its first box, and outward
    normals."""
    for _ in range(2):
        fill = torch.nn.functional.avg_pool3d(fill, 3, 1, 1)
    field = fill[0, 0]
    gradient = torch.zeros(*field.shape, 3)
    gradient[1:-1, :, :, 0] = (field[2:] - field[:-2]) / 2.0
    gradient[:, 1:-1, :, 1] = (field[:, 2:] - field[:, :-2]) / 2.0
    gradient[:, :, 1:-1, 2] = (field[:, :, 2:] - field[:, :, :-2]) / 2.0
    slope = torch.linalg.vector_norm(gradient, dim=-1)
    # To the level set by one Newton step: boxes within one of it.
    distance = (0.5 - field) / slope.clamp(min=1e-3)
    at = ((slope > 0.05) & (distance.abs() < 0.75)).nonzero()
    picked = tuple(at.unbind(1))
    inwards = gradient[picked] / slope[picked][:, None]
    points = at.float() + inwards * distance[picked][:, None]
    return points * side, -inwards
