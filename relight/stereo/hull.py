"""The visual hull: what lies inside the subject's outline in all masks.

It touches the surface wherever some camera sees it edge-on. So it is right where stereo is weakest: along the
outlines, behind the ears, on a skull without texture. It has no hollows (eye sockets, ears) and bulges where
no camera looked.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from relight.head_region import HeadRegion
from relight.observations import sample_bilinear
from relight.raster import NEAR_M, project
from relight.stereo.frames import GreyFrames
from relight.stereo.views import directions_from, spread_out
from relight.tangents import tangents

FEWEST_POINTS = 500

_FEWEST_MASKS = 5
_MOST_MASKS = 40
_GRID = 112  # boxes along the region's diameter: 5 mm on a head; points are then moved to the outlines
_MISSES = 1.5  # masks that may leave a point out: a mask may err, and so may a pose
_SHOWN = 0.5  # of the masks that must have a point in the picture: nothing bounds the hull below them
_MOST_A_POINT = 64
_GOLDEN_ANGLE = 2.399963
_SEARCH = 7  # offsets along the normal on which the outline is looked for


@dataclass(frozen=True, eq=False)
class VisualHull:
    """The surface of a visual hull.

    Attributes:
        points: [P, 3] float32, world.
        normals_world: [P, 3] float32, unit, outwards.
        masks: How many it was carved by.
        spacing: Of the points, about.
        inside: Tells of points [P, 3] whether they are inside, 0..1.
    """

    points: NDArray[np.float32]
    normals_world: NDArray[np.float32]
    masks: int
    spacing: float
    inside: Callable[[torch.Tensor], torch.Tensor]

    def resampled(
        self, chosen: NDArray[np.bool_], spacing: float
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Some of the points as discs of finer spacing about them, with their normals."""
        points, normals = self.points[chosen], self.normals_world[chosen]
        count = int(np.clip(2.0 * (self.spacing / spacing) ** 2, 1, _MOST_A_POINT))
        u, v = tangents(normals)
        copies = []
        for step in range(count):
            reach, angle = 0.8 * self.spacing * np.sqrt((step + 0.5) / count), step * _GOLDEN_ANGLE
            copies.append(points + np.float32(reach) * (np.cos(angle) * u + np.sin(angle) * v))
        dense, outwards = np.concatenate(copies).astype(np.float32), np.tile(normals, (count, 1))
        if not len(dense):
            return dense, outwards
        lattice = np.floor((dense - dense.min(axis=0)) / spacing).astype(np.int64)
        sides = lattice.max(axis=0) + 1
        _, kept = np.unique(
            (lattice[:, 0] * sides[1] + lattice[:, 1]) * sides[2] + lattice[:, 2], return_index=True
        )
        return dense[kept], outwards[kept]

    def to_outline(self, points: NDArray[np.float32], normals: NDArray[np.float32]) -> NDArray[np.float32]:
        """Points near the hull moved onto it, along their normals."""
        moved = _to_outline(
            torch.from_numpy(points), torch.from_numpy(normals), self.inside, 0.5 * self.spacing
        )
        return np.asarray(moved.numpy(), np.float32)


def visual_hull(frames: GreyFrames, region: HeadRegion) -> VisualHull | None:
    """The hull of the masks that the session has; None where these are too few or empty."""
    masked = [index for index in frames.cameras if frames.has_mask(index)]
    if len(masked) < _FEWEST_MASKS:
        return None
    directions = directions_from(region.centre_world, [frames.cameras[index] for index in masked])
    masks = {}
    for place in spread_out(directions, _MOST_MASKS):
        mask = frames.mask(masked[place])
        if mask is not None and mask.max() > 0.5:
            masks[masked[place]] = torch.from_numpy(mask)[None]
    if len(masks) < _FEWEST_MASKS:
        return None

    def inside(points: torch.Tensor) -> torch.Tensor:
        return _inside(points, frames, masks)

    steps = ((np.arange(_GRID) + 0.5) / _GRID * 2.0 - 1.0) * region.radius
    lattice = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    ball = np.linalg.norm(lattice, axis=1) < region.radius
    fill = torch.zeros(len(lattice))
    centre = torch.from_numpy(region.centre_world.astype(np.float32))
    fill[torch.from_numpy(ball)] = inside(torch.from_numpy(lattice[ball].astype(np.float32)) + centre)
    side = float(steps[1] - steps[0])
    points, normals = _surface(fill.view(_GRID, _GRID, _GRID), side)
    points = points + centre + float(steps[0])
    within = torch.linalg.vector_norm(points - centre, dim=1) < region.radius - 2.0 * side
    points, normals = points[within], normals[within]
    if len(points) < FEWEST_POINTS:
        return None
    points = _to_outline(points, normals, inside, 1.5 * side)
    return VisualHull(points.numpy(), normals.numpy(), len(masks), side, inside)


def _inside(points: torch.Tensor, frames: GreyFrames, masks: dict[int, torch.Tensor]) -> torch.Tensor:
    """[P] 1 inside all outlines, 0 outside of more than may err."""
    outside, shown = torch.zeros(len(points)), torch.zeros(len(points))
    for index, mask in masks.items():
        camera = frames.cameras[index]
        uv_px, z = project(points, camera)
        there = (z > NEAR_M) & (uv_px > 0).all(dim=1)
        there &= (uv_px[:, 0] < camera.width) & (uv_px[:, 1] < camera.height)
        coverage = sample_bilinear(mask, uv_px.where(there[:, None], torch.zeros_like(uv_px)))[:, 0]
        outside += torch.where(there, 1.0 - coverage, 0.0)
        shown += there
    fill = (0.5 + _MISSES - outside).clamp(0.0, 1.0)
    return fill * (shown >= max(_FEWEST_MASKS, _SHOWN * len(masks)))


def _surface(field: torch.Tensor, side: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Points where a field [N, N, N], smoothed, is one half, relative to its first box, and outward
    normals."""
    for _ in range(2):
        field = torch.nn.functional.avg_pool3d(field[None, None], 3, 1, 1)[0, 0]
    gradient = torch.zeros(*field.shape, 3)
    gradient[1:-1, :, :, 0] = (field[2:] - field[:-2]) / 2.0
    gradient[:, 1:-1, :, 1] = (field[:, 2:] - field[:, :-2]) / 2.0
    gradient[:, :, 1:-1, 2] = (field[:, :, 2:] - field[:, :, :-2]) / 2.0
    slope = torch.linalg.vector_norm(gradient, dim=-1)
    # To the level set by one Newton step, from the boxes within about one of it.
    distance = (0.5 - field) / slope.clamp(min=1e-3)
    at = ((slope > 0.05) & (distance.abs() < 0.75)).nonzero()
    picked = tuple(at.unbind(1))
    inwards = gradient[picked] / slope[picked][:, None]
    points = at.float() + inwards * distance[picked][:, None]
    return points * side, -inwards


def _to_outline(
    points: torch.Tensor,
    normals: torch.Tensor,
    inside: Callable[[torch.Tensor], torch.Tensor],
    reach: float,
) -> torch.Tensor:
    """Points moved along their normals to where they leave the hull, if that is within reach."""
    offsets = torch.linspace(reach, -reach, _SEARCH)
    tried = points[None] + offsets[:, None, None] * normals
    fill = inside(tried.reshape(-1, 3)).view(_SEARCH, -1)
    # From outside inwards: the first offset that is in, and how far between it and the one before.
    first = (fill >= 0.5).float().argmax(dim=0)
    found = (fill >= 0.5).any(dim=0) & (first > 0)
    first = first.clamp(min=1)
    after, before = (fill.gather(0, (first - k)[None])[0] for k in (0, 1))
    part = ((0.5 - before) / (after - before).clamp(min=1e-3)).clamp(0.0, 1.0)
    offset = offsets[first - 1] + part * (offsets[1] - offsets[0])
    return points + torch.where(found, offset, 0.0)[:, None] * normals
