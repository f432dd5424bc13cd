"""Maps of a portrait from any view: as its decoder makes them, else its points splatted, holes filled, and a
soft mask.

Visible points are spread over 3x3 pixels with a Gaussian as wide as half their spacing on the screen, and
the sums divided by the weights (Zwicker et al. 2001, "Surface splatting", with screen-aligned splats). What
lies between the points is filled by pull-push (Gortler et al. 1996, "The lumigraph"): averaged down a
pyramid where there are weights, and read back up where there are none. The mask is where the splats cover,
closed over gaps of a pixel; holes that are enclosed and small are the cloud's, not the subject's, and are
filled too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from capture.cameras import Camera
from relight.observations import visible_points
from relight.portrait import Portrait
from relight.raster import NEAR_M, IdPyramid, project, rasterize_ids

_WIDTH = 0.5  # of a splat, standard deviation in spacings of the points on the screen
_NARROWEST_PX = 0.35  # below this a splat between two pixel centres would reach neither
_WIDEST_PX = 2.5  # points further apart leave gaps between their 3x3 pixels: such views are drawn smaller
_COVERED = 0.05  # sum of weights with which a pixel has a value of its own: a point 1.5 pixels away
_INSIDE = 0.4  # of the sum of weights on an even surface; at its edge the sum is half of it, less some gaps
_TRACE = 1e-3  # of coverage, beyond the outline: if that errs by a pixel there are values nevertheless
_GRAZING = 0.02  # cosine under which a point does not face the view
_CELL, _TOLERANCE = 2.4, 5.0  # of the visibility test, in spacings: finer than for observing, edges show
_ENCLOSED_SHARE = 0.01  # of the mask: larger enclosed gaps are the subject's, e.g. under a bent arm
_ID_LEVELS = 4  # pixels without a point of their own take that of a coarser level


@dataclass(frozen=True, eq=False)
class Maps:
    """What a view sees of a portrait, float32; values are 0 where the mask is 0.

    Attributes:
        albedo: [H, W, 3] linear.
        normals_world: [H, W, 3] unit.
        room_radiance: [H, W, 3] linear radiance under the room's light.
        shading: [H, W] room shading s, 0..1.
        mask: [H, W] 0..1 coverage, at least a thousandth wherever there are values; the other maps are not
            premultiplied by it.
        depth: [H, W] z along the optical axis, world units.
        points_world: [H, W, 3] world.
        confidence: [H, W] 0..1.
        gloss: [H, W] factor on the reflectance's f0.
        point_ids: [H, W] int64, a point of the portrait seen in or near the pixel, -1 off the subject.
    """

    albedo: torch.Tensor
    normals_world: torch.Tensor
    room_radiance: torch.Tensor
    shading: torch.Tensor
    mask: torch.Tensor
    depth: torch.Tensor
    points_world: torch.Tensor
    confidence: torch.Tensor
    gloss: torch.Tensor
    point_ids: torch.Tensor


def render_maps(portrait: Portrait, camera: Camera) -> Maps:
    """Maps of a portrait from a camera: by its decoder where it has one, else splatted.

    Args:
        portrait: At least one point.
        camera: Lens distortion is not drawn: the maps are those of the pinhole.

    Returns:
        Maps of the camera's size, all zero where no point is seen.
    """
    if portrait.decoder is not None:
        return portrait.decoder.decode(portrait, camera)
    return splat_maps(portrait, camera)


def splat_maps(portrait: Portrait, camera: Camera) -> Maps:
    """Maps of a portrait from a camera by its points' values alone.

    Args:
        portrait: At least one point.
        camera: Lens distortion is not drawn: the maps are those of the pinhole.

    Returns:
        Maps of the camera's size, all zero where no point is seen.
    """
    drawn = camera.scaled(_drawn_share(portrait, camera))
    values, mask, point_ids = _draw(portrait, drawn)
    if (drawn.width, drawn.height) != (camera.width, camera.height):
        values, mask, point_ids = _enlarged(values, mask, point_ids, camera)
    support = (mask > 0)[..., None]
    values = torch.where(support, values, 0.0)
    normals, depth = values[..., :3], values[..., 12]
    return Maps(
        albedo=values[..., 3:6].clamp(min=0.0),
        normals_world=normals / torch.linalg.vector_norm(normals, dim=-1, keepdim=True).clamp(min=1e-12),
        room_radiance=values[..., 6:9].clamp(min=0.0),
        shading=values[..., 9].clamp(0.0, 1.0),
        mask=mask,
        depth=depth,
        points_world=torch.where(support, _unproject(depth, camera), 0.0),
        confidence=values[..., 10].clamp(0.0, 1.0),
        gloss=values[..., 11].clamp(min=0.0),
        point_ids=point_ids,
    )


def _drawn_share(portrait: Portrait, camera: Camera) -> float:
    """Size, relative to the camera's, at which the points are not too far apart for their splats."""
    sample = portrait.points[:: max(1, len(portrait.points) // 5_000)]
    uv_px, z = project(sample, camera)
    seen = (z > NEAR_M) & (uv_px >= 0).all(dim=1)
    seen &= (uv_px[:, 0] < camera.width) & (uv_px[:, 1] < camera.height)
    if not bool(seen.any()):
        return 1.0
    return min(1.0, _WIDEST_PX * float(z[seen].median()) / (portrait.spacing * float(camera.K[0, 0])))


def _draw(portrait: Portrait, camera: Camera) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Values [H, W, 13], mask [H, W] and point ids [H, W] of a view."""
    height, width = camera.height, camera.width
    surface = portrait.points, portrait.normals_world, camera, portrait.spacing
    uv_px, cosine, _ = visible_points(*surface, cell=_CELL, tolerance=_TOLERANCE)
    _, behind, _ = visible_points(*surface, cell=_CELL, tolerance=_TOLERANCE, margin=False)
    surely = cosine > _GRAZING
    seen = (surely | (behind > _GRAZING)).nonzero()[:, 0]
    points, cosine, surely = portrait.points[seen], torch.maximum(cosine, behind)[seen], surely[seen]
    rotation = torch.as_tensor(camera.cam_from_world).to(points)
    z = points @ rotation[2, :3] + rotation[2, 3]
    values = torch.cat(
        [
            portrait.normals_world[seen],
            portrait.albedo[seen],
            portrait.room_radiance[seen],
            portrait.shading[seen, None],
            portrait.confidence[seen, None],
            portrait.gloss[seen, None],
            z[:, None],
        ],
        dim=1,
    )
    natural_px = _WIDTH * portrait.spacing * float(camera.K[0, 0]) / z.clamp(min=1e-9)
    spread_px = natural_px.clamp(min=_NARROWEST_PX)
    # Slanted surfaces have more points a pixel, splats that are kept from being too narrow overlap more, and
    # of wide ones a part lies outside of 3x3 pixels: with these weights the sum is 2 pi _WIDTH^2 everywhere.
    weight = cosine.clamp(min=0.1) * (natural_px / spread_px) ** 2
    weight = weight / torch.erf(1.5 / math.sqrt(2.0) / spread_px) ** 2
    uv_px = uv_px[seen]
    sums, rest = (
        _splat(values[part], uv_px[part], spread_px[part], weight[part], height, width)
        for part in (surely, ~surely)
    )
    # Close behind an outline, as of the chin before the neck, only the points without a margin reach.
    sums = torch.where(sums[-1] > _COVERED, sums, sums + rest)
    inside = sums[-1] > _INSIDE * 2.0 * math.pi * _WIDTH**2
    support = _soft_mask((sums[-1] > _COVERED).cpu().numpy()).to(sums) > 0
    mask = torch.where(support, _soft_mask(inside.cpu().numpy()).to(sums).clamp(min=_TRACE), 0.0)
    ids = _point_ids(rasterize_ids(points, camera, _ID_LEVELS), seen, support)
    return pull_push(sums, _COVERED).permute(1, 2, 0), mask, ids


def _enlarged(
    values: torch.Tensor, mask: torch.Tensor, ids: torch.Tensor, camera: Camera
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """What was drawn smaller, at a camera's size."""

    def resized(image: torch.Tensor, mode: str) -> torch.Tensor:
        return torch.nn.functional.interpolate(image[None], size=(camera.height, camera.width), mode=mode)[0]

    mask = resized(mask[None], "bilinear")[0]
    ids = resized(ids[None].double(), "nearest-exact")[0].long()  # float64 holds every id
    return (
        resized(values.permute(2, 0, 1), "bilinear").permute(1, 2, 0),
        mask,
        torch.where(mask > 0, ids, -1),
    )


def pull_push(sums: torch.Tensor, full: float) -> torch.Tensor:
    """Fills an image where it has little or no weight, smoothly, from where it has.

    Args:
        sums: [C + 1, H, W], weighted sums and, last, the weights.
        full: Weight from which a pixel needs nothing of its surroundings.

    Returns:
        [C, H, W], 0 everywhere if there are no weights at all.
    """
    weight = sums[-1:]
    share = (weight / full).clamp(max=1.0)
    values = torch.where(weight > 0, sums[:-1] / weight.clamp(min=1e-20), 0.0)
    pyramid = [(values, share)]
    while max(pyramid[-1][0].shape[1:]) > 1:
        values, share = pyramid[-1]
        pooled = _pool(torch.cat([values * share, share]))
        total = pooled[-1:]
        values = torch.where(total > 0, pooled[:-1] / total.clamp(min=1e-20), 0.0)
        pyramid.append((values, (4.0 * total).clamp(max=1.0)))
    values, share = pyramid.pop()
    for finer, finer_share in reversed(pyramid):
        # What the coarser level knows is weighted by how much it knows, or empty pixels would darken their
        # neighbours.
        both = torch.nn.functional.interpolate(
            torch.cat([values * share, share])[None],
            size=finer.shape[1:],
            mode="bilinear",
            align_corners=False,
        )[0]
        around = torch.where(both[-1:] > 0, both[:-1] / both[-1:].clamp(min=1e-20), 0.0)
        values = finer_share * finer + (1.0 - finer_share) * around
        share = torch.maximum(finer_share, (both[-1:] > 0).to(both))
    return values


def _pool(image: torch.Tensor) -> torch.Tensor:
    """Means over 2x2 pixels; at an odd edge over those that there are, counting the missing as empty."""
    height, width = image.shape[1:]
    image = torch.nn.functional.pad(image, (0, width % 2, 0, height % 2))
    return torch.nn.functional.avg_pool2d(image[None], 2)[0]


def _splat(
    values: torch.Tensor,
    uv_px: torch.Tensor,
    spread_px: torch.Tensor,
    weight: torch.Tensor,
    height: int,
    width: int,
) -> torch.Tensor:
    """Sums [C + 1, H, W] of values [P, C] under Gaussians about uv_px [P, 2], and of their weights."""
    padded = width + 2  # a frame of one pixel takes what falls outside
    sums = values.new_zeros((height + 2) * padded, values.shape[1] + 1)
    rows = torch.cat([values, torch.ones_like(values[:, :1])], dim=1)
    corner = uv_px.floor()
    offset = uv_px - corner - 0.5
    place = (corner[:, 1].long() + 1) * padded + corner[:, 0].long() + 1
    falloff = -0.5 / spread_px**2
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            square = (dx - offset[:, 0]) ** 2 + (dy - offset[:, 1]) ** 2
            sums.index_add_(
                0, place + dy * padded + dx, rows * (weight * torch.exp(square * falloff))[:, None]
            )
    return sums.view(height + 2, padded, -1)[1:-1, 1:-1].permute(2, 0, 1).contiguous()


def _soft_mask(covered: NDArray[np.bool_]) -> torch.Tensor:
    """Coverage [H, W] 0..1 of covered pixels: gaps of a pixel and small enclosed holes closed, edges two
    pixels soft."""
    mask = cv2.morphologyEx(covered.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    height, width = mask.shape
    count, labels, statistics, _ = cv2.connectedComponentsWithStats(1 - mask, connectivity=4)
    for label in range(1, count):
        left, top, columns, rows, area = statistics[label]
        inside = left > 0 and top > 0 and left + columns < width and top + rows < height
        if inside and area < _ENCLOSED_SHARE * mask.sum():
            mask[labels == label] = 1
    # Reflected at the border: a subject cut by the picture's edge does not fade there.
    return torch.from_numpy(
        cv2.GaussianBlur(mask.astype(np.float32), (5, 5), 0.7, borderType=cv2.BORDER_REPLICATE)
    )


def _point_ids(pyramid: IdPyramid, seen: torch.Tensor, support: torch.Tensor) -> torch.Tensor:
    """Ids into all points [H, W], from the finest level that has one."""
    height, width = support.shape
    ids = pyramid.ids[-1]
    for finer in reversed(pyramid.ids[:-1]):
        rows, columns = finer.shape
        above = ids.repeat_interleave(2, 0)[:rows].repeat_interleave(2, 1)[:, :columns]
        ids = torch.where(finer >= 0, finer, above)
    known = support & (ids >= 0)
    result = torch.full((height, width), -1, dtype=torch.int64, device=ids.device)
    result[known] = seen[ids[known]]
    return result


def _unproject(depth: torch.Tensor, camera: Camera) -> torch.Tensor:
    """World positions [H, W, 3] of the pixel centres at given depths [H, W]."""
    height, width = depth.shape
    v, u = torch.meshgrid(
        torch.arange(height, device=depth.device) + 0.5,
        torch.arange(width, device=depth.device) + 0.5,
        indexing="ij",
    )
    pixels = torch.stack([u, v, torch.ones_like(u)], dim=-1).to(depth)
    rotation = camera.cam_from_world[:3, :3]
    world_from_pixel = torch.as_tensor(rotation.T @ np.linalg.inv(camera.K)).to(depth)
    return (pixels @ world_from_pixel.T) * depth[..., None] + torch.as_tensor(camera.centre_world).to(depth)
