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
from scipy.sparse import csc_array

from capture.cameras import Camera
from relight.observations import sample_bilinear
from relight.occlusion import Sight
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
_MARGIN_PX = 4  # of a splat, the closing of gaps and the mask's soft edge
_COARSE_PX = 32  # of a level that fills gaps; wider ones are rare
_VALUES = 14  # of a pixel: normal, albedo, room radiance, shading, confidence, gloss, bounce, depth
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
        flash_bounce: [H, W], see `Portrait.flash_bounce`.
        point_ids: [H, W] int64, a point of the portrait seen in or near the pixel, -1 off the subject.
        flash_radiance: [H, W, 3] linear radiance that the camera's own flash adds, where a decoder has a
            light model of its own for it; None = it follows from the other maps.
        flash_gain: [H, W, 3] factor on what follows from the other maps; None = 1.
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
    flash_bounce: torch.Tensor
    point_ids: torch.Tensor
    flash_radiance: torch.Tensor | None = None
    flash_gain: torch.Tensor | None = None


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
    normals, room, depth = values[..., :3], values[..., 6:9], values[..., 13]
    normals = normals / torch.linalg.vector_norm(normals, dim=-1, keepdim=True).clamp(min=1e-12)
    points = torch.where(support, unproject(depth, camera), 0.0)
    if portrait.room_gloss is not None:
        on = mask > 0
        centre = torch.as_tensor(camera.centre_world).to(points)
        seen = points[on], normals[on], values[..., 11][on].clamp(min=0.0)
        room[on] += portrait.room_gloss.radiance(*seen, centre, portrait.reflectance)
    return Maps(
        albedo=values[..., 3:6].clamp(min=0.0),
        normals_world=normals,
        room_radiance=room.clamp(min=0.0),
        shading=values[..., 9].clamp(0.0, 1.0),
        mask=mask,
        depth=depth,
        points_world=points,
        confidence=values[..., 10].clamp(0.0, 1.0),
        gloss=values[..., 11].clamp(min=0.0),
        flash_bounce=values[..., 12].clamp(min=0.0),
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
    """Values [H, W, 14], mask [H, W] and point ids [H, W] of a view."""
    height, width = camera.height, camera.width
    sight = Sight(portrait.points, portrait.normals_world, camera, portrait.spacing, _CELL, _TOLERANCE)
    facing = (sight.cosine > _GRAZING).nonzero()[:, 0]
    surely = sight.unhidden(facing)
    kept = surely | sight.unhidden(facing, margin=False)
    seen, surely = facing[kept], surely[kept]
    values = torch.zeros(height, width, _VALUES).to(portrait.points)
    if not len(seen):
        return values, values[..., 0], torch.full((height, width), -1, device=values.device)
    uv_px, z = sight.uv_px[seen], sight.z[seen]
    natural_px = _WIDTH * portrait.spacing * float(camera.K[0, 0]) / z.clamp(min=1e-9)
    spread_px = natural_px.clamp(min=_NARROWEST_PX)
    # Slanted surfaces have more points a pixel, splats that are kept from being too narrow overlap more, and
    # of wide ones a part lies outside of 3x3 pixels: with these weights the sum is 2 pi _WIDTH^2 everywhere.
    weight = sight.cosine[seen].clamp(min=0.1) * (natural_px / spread_px) ** 2
    weight = weight / torch.erf(1.5 / math.sqrt(2.0) / spread_px) ** 2
    rows = torch.cat(
        [
            portrait.normals_world[seen],
            portrait.albedo[seen],
            portrait.room_radiance[seen],
            portrait.shading[seen, None],
            portrait.confidence[seen, None],
            portrait.gloss[seen, None],
            portrait.flash_bounce[seen, None],
            z[:, None],
            torch.ones_like(z)[:, None],
        ],
        dim=1,
    )
    window, corner = _window(uv_px, height, width)
    size = tuple(side.stop - side.start for side in window)
    sums = _splat(rows, uv_px - corner, spread_px, weight, surely, size)
    # Close behind an outline, as of the chin before the neck, only the points without a margin reach.
    sums = torch.where(sums[0, -1:] > _COVERED, sums[0], sums.sum(dim=0))
    covered, inside = (
        torch.nn.functional.pad(sums[-1] > least, _around(window, height, width)).cpu().numpy()
        for least in (_COVERED, _INSIDE * 2.0 * math.pi * _WIDTH**2)
    )
    support = _soft_mask(covered).to(sums) > 0
    mask = torch.where(support, _soft_mask(inside).to(sums).clamp(min=_TRACE), 0.0)
    # What lies beyond the window is off the subject but for the mask's soft edge.
    values[window] = pull_push(sums, _COVERED, support[window]).permute(1, 2, 0)
    ids = _point_ids(rasterize_ids(portrait.points[seen], camera, _ID_LEVELS), seen, support)
    return values, mask, ids


def _window(uv_px: torch.Tensor, height: int, width: int) -> tuple[tuple[slice, slice], torch.Tensor]:
    """Rows and columns of the picture that splats about uv_px [P, 2] reach, and the first of them as u, v.

    A head fills half of its picture, and the rest costs nothing. A margin holds the mask's soft edge, and the
    window begins and ends where a coarse level's pixels do, so that gaps are filled as in the whole picture.
    """
    low = (uv_px.amin(dim=0).floor().long() - _MARGIN_PX).clamp(min=0) // _COARSE_PX * _COARSE_PX
    high = uv_px.amax(dim=0).floor().long() + _MARGIN_PX + _COARSE_PX
    (left, top), (right, bottom) = low.tolist(), (high // _COARSE_PX * _COARSE_PX).tolist()
    return (slice(top, min(height, bottom)), slice(left, min(width, right))), low.to(uv_px)


def _around(window: tuple[slice, slice], height: int, width: int) -> list[int]:
    """Pixels left, right, above and below a window, as `pad` takes them."""
    rows, columns = window
    return [columns.start, width - columns.stop, rows.start, height - rows.stop]


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


def pull_push(sums: torch.Tensor, full: float, wanted: torch.Tensor | None = None) -> torch.Tensor:
    """Fills an image where it has little or no weight, smoothly, from where it has.

    Args:
        sums: [C + 1, H, W], weighted sums and, last, the weights.
        full: Weight from which a pixel needs nothing of its surroundings.
        wanted: [H, W] bool, pixels whose values matter, by default all; elsewhere they mean nothing.

    Returns:
        [C, H, W], 0 everywhere if there are no weights at all.
    """
    # Values times their share (how much is known of them, 0..1), and last the share: when levels are mixed,
    # what knows little counts for little, or empty pixels would darken their neighbours.
    finest = sums / sums[-1:].clamp(min=full)
    if max(sums.shape[1:]) == 1:
        return finest[:-1] / finest[-1:].clamp(min=1e-20)
    coarser = []
    level = finest
    while max(level.shape[1:]) > 1:
        level = _pool(level)
        level = level / level[-1:].clamp(min=0.25)  # a quarter of the pixels are enough for a share of 1
        coarser.append(level)
    filled = coarser.pop()
    for level in reversed(coarser):
        around = torch.nn.functional.interpolate(
            filled[None], size=level.shape[1:], mode="bilinear", align_corners=False
        )[0]
        filled = torch.cat([_completed(level, around), (around[-1:] > 0).to(around)])
    missing = finest[-1] < 1.0 if wanted is None else (finest[-1] < 1.0) & wanted
    rows, columns = missing.nonzero().unbind(1)
    values = finest[:-1]
    # The same interpolation, where it is needed: at the finest level most pixels are known.
    uv_px = torch.stack([columns, rows], dim=1) + 0.5
    uv_px = uv_px * uv_px.new_tensor([size / whole for size, whole in _sides(filled, finest)])
    around = sample_bilinear(filled, uv_px.to(filled)).T
    values[:, rows, columns] = _completed(finest[:, rows, columns], around)
    return values


def _completed(level: torch.Tensor, around: torch.Tensor) -> torch.Tensor:
    """Values [C, ...] of a level [C + 1, ...], for what is missing of their share those around them."""
    share = around[-1:]
    # Divided by next to nothing, the nothing that is around an empty pixel would have an infinite gradient.
    return level[:-1] + (1.0 - level[-1:]) * around[:-1] / share.where(share > 0, 1.0)


def _sides(image: torch.Tensor, larger: torch.Tensor) -> list[tuple[int, int]]:
    """Widths and heights of two images [C, H, W]."""
    return [(image.shape[side], larger.shape[side]) for side in (2, 1)]


def _pool(image: torch.Tensor) -> torch.Tensor:
    """Means over 2x2 pixels; at an odd edge over those that there are, counting the missing as empty."""
    height, width = image.shape[1:]
    image = torch.nn.functional.pad(image, (0, width % 2, 0, height % 2))
    return torch.nn.functional.avg_pool2d(image[None], 2)[0]


def _splat(
    rows: torch.Tensor,
    uv_px: torch.Tensor,
    spread_px: torch.Tensor,
    weight: torch.Tensor,
    first: torch.Tensor,
    size: tuple[int, int],
) -> torch.Tensor:
    """Sums [2, C, H, W] of rows [P, C] under Gaussians about uv_px [P, 2]: the `first` [P], then others."""
    padded = size[0] + 2, size[1] + 2  # a frame of one pixel takes what falls outside
    pixels = padded[0] * padded[1]
    corner = uv_px.floor()
    offset = uv_px - corner - 0.5
    place = (corner[:, 1].int() + 1) * padded[1] + corner[:, 0].int() + 1
    place = torch.where(first, place, place + pixels)
    step = torch.arange(-1, 2, device=uv_px.device)
    falloff = -0.5 / spread_px**2
    across, down = (torch.exp((step - offset[:, axis, None]) ** 2 * falloff[:, None]) for axis in (0, 1))
    shares = (down * weight[:, None])[:, :, None] * across[:, None]
    places = place[:, None] + (step[:, None] * padded[1] + step).flatten().int()
    sums = _add_at(places, shares.flatten(1), rows, 2 * pixels)
    return sums.view(2, *padded, -1)[:, 1:-1, 1:-1].permute(0, 3, 1, 2).contiguous()


def _add_at(places: torch.Tensor, shares: torch.Tensor, rows: torch.Tensor, count: int) -> torch.Tensor:
    """Sums [count, C] of rows [P, C] at K places [P, K] each, times their shares [P, K].

    On a CPU as the product with a sparse matrix in scipy, which goes through the points once: three times as
    fast as torch's `index_add_`, and with no copy of the rows a place.
    """
    if rows.device.type != "cpu":
        sums = rows.new_zeros(count, rows.shape[1])
        for place, share in zip(places.long().unbind(1), shares.unbind(1), strict=True):
            sums.index_add_(0, place, rows * share[:, None])
        return sums
    starts = np.arange(len(places) + 1, dtype=np.int32) * places.shape[1]
    matrix = csc_array((shares.numpy().ravel(), places.numpy().ravel(), starts), shape=(count, len(places)))
    return torch.from_numpy(matrix @ rows.numpy())


def _soft_mask(covered: NDArray[np.bool_]) -> torch.Tensor:
    """Coverage [H, W] 0..1 of covered pixels: gaps of a pixel and small enclosed holes closed, edges two
    pixels soft."""
    mask = cv2.morphologyEx(covered.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    height, width = mask.shape
    _, labels, statistics, _ = cv2.connectedComponentsWithStats(1 - mask, connectivity=4)
    left, top, columns, rows, area = statistics.T
    small = (left > 0) & (top > 0) & (left + columns < width) & (top + rows < height)
    small &= area < _ENCLOSED_SHARE * mask.sum()
    small[0] = False  # what is covered
    mask[small[labels]] = 1
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


def unproject(depth: torch.Tensor, camera: Camera) -> torch.Tensor:
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
