"""Where a cloud covers a picture, and how deep: its silhouette, holes between the points closed.

A pixel is covered where the points about it are as dense as the sampling of the surface promises (or a part
of that), which single strays never are. Gaps between the points are closed by a disc of their spacing, small
enclosed holes are filled. No z-buffer is needed for that; the depth comes from one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from capture.cameras import Camera
from relight.raster import NEAR_M, project, rasterize_ids

Floats = NDArray[np.float32]

_DENSE = 0.25  # of the points that a surface facing the camera has in a window
_ENCLOSED_SHARE = 0.02  # of the silhouette: enclosed holes up to this size are the cloud's
_HALF, _PILE = 0.35, 2.0  # of the height of the pile at the outline; its reach in standard deviations
_SCATTER = 0.5  # standard deviations by which a noisy outline is too wide
_WIDEST_GAP_PX = 12.0


@dataclass(frozen=True, eq=False)
class Silhouette:
    """A cloud seen from a camera.

    Attributes:
        inside: [H, W] bool.
        distance_px: [H, W] float32, to the outline, positive inside; the picture's border is no outline.
        depth: [H, W] float32, z along the optical axis, smooth, continued beyond the outline from the nearest
            covered pixel.
        noise_px: How far the points scatter about the outline.
    """

    inside: NDArray[np.bool_]
    distance_px: Floats
    depth: Floats
    noise_px: float


def silhouette(points: torch.Tensor, camera: Camera, spacing: float, noise: float) -> Silhouette:
    """The silhouette of points at a camera's size.

    Args:
        points: [Q, 3] float32, world.
        camera: Without distortion.
        spacing: Of the points, world units.
        noise: Standard deviation of the points about the surface, world units: by so much they reach beyond
            the outline.
    """
    height, width = camera.height, camera.width
    uv_px, z = project(points, camera)
    seen = (z > NEAR_M) & (uv_px >= 0).all(dim=1)
    seen &= (uv_px[:, 0] < width) & (uv_px[:, 1] < height)
    if not bool(seen.any()):
        empty = np.zeros((height, width), bool)
        return Silhouette(empty, signed_distance_px(empty), np.zeros((height, width), np.float32), 0.0)
    gap_px = spacing * float(camera.K[0, 0]) / float(z[seen].median())
    place = (uv_px[seen, 1].long() * width + uv_px[seen, 0].long()).numpy()
    counts = np.bincount(place, minlength=height * width).reshape(height, width).astype(np.float32)
    inside = _covered(counts, min(gap_px, _WIDEST_GAP_PX), noise / spacing * gap_px)
    depth = rasterize_ids(points, camera).depth_m[0].numpy()
    noise_px = noise / spacing * gap_px
    distance_px = signed_distance_px(inside) - np.float32(_SCATTER * noise_px)
    inside = distance_px > 0
    return Silhouette(inside, distance_px, _smooth_depth(depth, inside, gap_px), noise_px)


def signed_distance_px(inside: NDArray[np.bool_]) -> Floats:
    """[H, W] distance of pixel centres to the outline, positive inside; without an outline +-H+W."""
    far = float(sum(inside.shape))
    if inside.all() or not inside.any():
        return np.full(inside.shape, far if inside.all() else -far, np.float32)
    mask = inside.astype(np.uint8)
    to_outside = cv2.distanceTransform(mask, cv2.DIST_L2, cv2.DIST_MASK_5)
    to_inside = cv2.distanceTransform(1 - mask, cv2.DIST_L2, cv2.DIST_MASK_5)
    return np.where(inside, to_outside - 0.5, 0.5 - to_inside).astype(np.float32)


def filled(mask: NDArray[np.bool_], share: float = _ENCLOSED_SHARE) -> NDArray[np.bool_]:
    """A mask with its enclosed holes filled that are smaller than a share of it."""
    height, width = mask.shape
    count, labels, statistics, _ = cv2.connectedComponentsWithStats((~mask).astype(np.uint8), connectivity=4)
    left, top, columns, rows, area = statistics.T
    hole = (left > 0) & (top > 0) & (left + columns < width) & (top + rows < height)
    hole &= area < share * np.count_nonzero(mask)
    hole[0] = False  # the mask itself
    return mask | hole[labels] if count > 1 else mask


def _covered(counts: Floats, gap_px: float, noise_px: float) -> NDArray[np.bool_]:
    """Where points are dense, closed over their gaps.

    Along the outline a surface is grazed and its points pile up; noise spreads the pile outwards, and its
    edge is where half (here `_HALF`) of the pile's height is left.
    """
    radius = max(1, math.ceil(gap_px))
    window = (2 * radius + 1, 2 * radius + 1)
    found = cv2.boxFilter(counts, -1, window, normalize=False, borderType=cv2.BORDER_CONSTANT)
    room = cv2.boxFilter(np.ones_like(counts), -1, window, normalize=False, borderType=cv2.BORDER_CONSTANT)
    dense = found >= np.maximum(_DENSE * room / max(gap_px, 1e-6) ** 2, min(3.0, room.min()))
    dense &= counts > 0
    covered = _closed(dense, gap_px)
    reach = 2 * math.ceil(_PILE * noise_px + 0.5 * gap_px) + 1
    pile = cv2.dilate(found, np.ones((reach, reach), np.uint8))
    return covered & filled(_closed(dense & (found >= _HALF * pile), gap_px), 1.0)


def _closed(points: NDArray[np.bool_], gap_px: float) -> NDArray[np.bool_]:
    """Pixels with points, and those between them: at the outline points are dense and little needs to be
    closed, and what is wider inside is enclosed."""
    reach = max(1, math.ceil(0.75 * gap_px))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    padded = np.pad(points.astype(np.uint8), 2 * reach, mode="edge")
    closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, kernel)
    return filled(closed[2 * reach : -2 * reach, 2 * reach : -2 * reach] > 0)


def _smooth_depth(depth: Floats, inside: NDArray[np.bool_], gap_px: float) -> Floats:
    """Depth of the nearer points in a neighbourhood, smoothed, and continued to all pixels."""
    known = np.isfinite(depth) & inside
    if not known.any():
        known = np.isfinite(depth)
    if not known.any():
        return np.zeros(depth.shape, np.float32)
    size = 2 * max(1, math.ceil(gap_px)) + 1
    values = np.where(known, depth, 0.0).astype(np.float32)
    weight = known.astype(np.float32)
    for _ in range(2):
        total = cv2.blur(weight, (size, size))
        mean = cv2.blur(values * weight, (size, size)) / np.maximum(total, 1e-6)
        # Points behind the surface, seen through its gaps, are further than the mean of their surroundings.
        weight = weight * (values <= mean * 1.02)
    total = cv2.blur(weight, (size, size))
    mean = cv2.blur(values * weight, (size, size)) / np.maximum(total, 1e-6)
    sure = total > 1e-3
    if not sure.any():
        return np.full(depth.shape, float(np.median(depth[known])), np.float32)
    _, labels = cv2.distanceTransformWithLabels(
        (~sure).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    by_label = np.zeros(int(labels.max()) + 1, np.float32)
    by_label[labels[sure]] = mean[sure]
    return np.asarray(cv2.blur(by_label[labels], (5, 5)), np.float32)
