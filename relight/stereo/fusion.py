"""From depth maps to one cloud: what several maps agree on, once for each cell of the surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from relight.head_region import HeadRegion
from relight.stereo.depth import DepthMap

_EDGE_PX = 3  # windows reach over an edge of the surface by their radius
_STEP = 6.0  # depth between neighbouring pixels, in widths of a pixel, that is an edge: 80 degrees of slant
_GRAZING = 0.12  # cosine
_CHUNK = 1 << 18  # points at a time where float64 copies are made
_SLANTED = 3.0  # tolerances by which depths may differ where the surfaces do not
_SEES_THROUGH = 3.0  # tolerances by which a point lies before what another map sees


@dataclass(frozen=True, eq=False)
class CheckedMap:
    """A depth map, and which of its pixels are a surface in the region.

    Attributes:
        depth: The map.
        valid: [h, w] bool: in the region, not at an edge, not grazing.
        outside: [h, w] bool: of something that is not in the region.
    """

    depth: DepthMap
    valid: torch.Tensor
    outside: torch.Tensor


@dataclass(frozen=True, eq=False)
class Agreement:
    """What other maps say of the valid pixels of one.

    Attributes:
        place: [n] index of the pixel in the flattened map.
        points: [n, 3] world, the mean of those that agree.
        normals: [n, 3] world.
        cosine: [n] between normal and viewing direction.
        support: [n] maps that agree, itself included.
        against: [n] maps that see through the point.
        asked: [n] maps that have something to say.
    """

    place: torch.Tensor
    points: torch.Tensor
    normals: torch.Tensor
    cosine: torch.Tensor
    support: torch.Tensor
    against: torch.Tensor
    asked: torch.Tensor


def checked(depth: DepthMap, region: HeadRegion) -> CheckedMap:
    """Finds which pixels of a depth map are a surface in the region."""
    points, _, cosine = _surface(depth)
    z = 1.0 / depth.inverse_depth.clamp(min=1e-9)
    middle = torch.as_tensor(region.centre_world).to(z)
    inside = torch.linalg.vector_norm(points - middle, dim=-1) < region.radius
    width = z / float(depth.camera.K[0, 0])
    step = torch.zeros_like(z)
    step[:, 1:] = (z[:, 1:] - z[:, :-1]).abs() / width[:, 1:]
    step[1:] = torch.maximum(step[1:], (z[1:] - z[:-1]).abs() / width[1:])
    edge = (step > _STEP).float()[None, None]
    near_edge = torch.nn.functional.max_pool2d(edge, 2 * _EDGE_PX + 1, 1, _EDGE_PX)[0, 0] > 0
    valid = inside & (cosine > _GRAZING) & ~near_edge & torch.isfinite(points).all(dim=-1)
    return CheckedMap(depth, valid, ~inside)


def _surface(depth: DepthMap) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Points [h, w, 3], normals [h, w, 3] towards the camera and their cosine [h, w] with the view."""
    rays = _rays_world(depth)
    z = 1.0 / depth.inverse_depth.clamp(min=1e-9)
    points = torch.as_tensor(depth.camera.centre_world).to(z) + rays * z[..., None]
    right, down = torch.zeros_like(points), torch.zeros_like(points)
    right[:, 1:-1] = points[:, 2:] - points[:, :-2]
    down[1:-1] = points[2:] - points[:-2]
    normals = torch.nn.functional.normalize(torch.linalg.cross(down, right), dim=-1)
    cosine = -(normals * torch.nn.functional.normalize(rays, dim=-1)).sum(dim=-1)
    return points, normals, cosine


def agree(own: CheckedMap, others: Sequence[CheckedMap], tolerance: float) -> Agreement:
    """Asks other maps about the valid pixels of one.

    A point is moved along its normal to the mean of the points that the agreeing maps have there, each taken
    for a piece of plane with the same normal.
    """
    place = own.valid.flatten().nonzero()[:, 0]
    all_points, all_normals, all_cosines = _surface(own.depth)
    points, normals = all_points.view(-1, 3)[place], all_normals.view(-1, 3)[place]
    support, against = points.new_ones(len(points)), points.new_zeros(len(points))
    asked, shift = points.new_ones(len(points)), points.new_zeros(len(points))
    for other in others:
        inverse, valid, z, inside = _looked_up(points, other)
        behind = z * inverse - 1.0
        centre = torch.as_tensor(other.depth.camera.centre_world).to(points)
        along = points - centre
        theirs = along / (behind + 1.0).clamp(min=1e-3)[:, None] - along
        # On a slanted surface depths differ by more than the surfaces are apart.
        apart = (theirs * normals).sum(dim=-1)
        near = inside & valid & (apart.abs() < tolerance * z) & (behind.abs() < _SLANTED * tolerance)
        shift += torch.where(near, apart, 0.0)
        support += near
        through = inside & (behind < -_SEES_THROUGH * tolerance)
        against += through
        asked += through | (inside & valid & (behind.abs() < _SEES_THROUGH * tolerance))
    moved = points + (shift / support)[:, None] * normals
    return Agreement(place, moved, normals, all_cosines.flatten()[place], support, against, asked)


def one_a_cell(
    points: torch.Tensor, normals: torch.Tensor, weight: torch.Tensor, cell: float
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Weighted means over cubes: points, unit normals, cube of each given point, points a cube."""
    lattice = ((points - points.min(dim=0).values) / cell).floor().long()
    sides = lattice.max(dim=0).values + 1
    key = (lattice[:, 0] * sides[1] + lattice[:, 1]) * sides[2] + lattice[:, 2]
    _, member, counts = torch.unique(key, return_inverse=True, return_counts=True)
    sums = points.new_zeros(len(counts), 7, dtype=torch.float64)
    for start in range(0, len(points), _CHUNK):
        part = slice(start, start + _CHUNK)
        values = torch.cat([points[part], normals[part], torch.ones_like(points[part, :1])], dim=1)
        sums.index_add_(0, member[part], values.double() * weight[part, None])
    means = sums[:, :6] / sums[:, 6:].clamp(min=1e-30)
    directions = torch.nn.functional.normalize(means[:, 3:], dim=1)
    return means[:, :3].float(), directions.float(), member, counts


def _looked_up(
    points: torch.Tensor, other: CheckedMap
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Another map's inverse depth where points [n, 3] project, whether it is valid there, their depths in
    it, and whether they are in it at all."""
    depth = other.depth
    projection = torch.as_tensor(depth.camera.K @ depth.camera.cam_from_world[:3])
    projection = projection.to(points)
    u, v, z = (points @ projection[:, :3].T + projection[:, 3]).unbind(1)
    window = depth.window
    x = (u / z - window.left) * (2.0 / window.width) - 1.0
    y = (v / z - window.top) * (2.0 / window.height) - 1.0
    inside = (z > 0) & (x.abs() < 0.99) & (y.abs() < 0.99)
    grid = torch.stack([x, y], dim=-1).where(inside[:, None], torch.zeros_like(x)[:, None])
    layers = torch.stack([depth.inverse_depth, other.valid.to(depth.inverse_depth)])
    sampled = torch.nn.functional.grid_sample(layers[None], grid[None, None], align_corners=False)[0, :, 0]
    return sampled[0], sampled[1] > 0.99, z, inside


def _rays_world(depth: DepthMap) -> torch.Tensor:
    """[h, w, 3] directions with camera z 1, in world axes."""
    window, K = depth.window, depth.camera.K
    device = depth.inverse_depth.device
    x = (torch.arange(window.width, dtype=torch.float64) + window.left + 0.5 - K[0, 2]) / K[0, 0]
    y = (torch.arange(window.height, dtype=torch.float64) + window.top + 0.5 - K[1, 2]) / K[1, 1]
    y, x = torch.meshgrid(y, x, indexing="ij")
    in_camera = torch.stack([x, y, torch.ones_like(x)], dim=-1)
    return (in_camera @ torch.as_tensor(depth.camera.cam_from_world[:3, :3])).float().to(device)
