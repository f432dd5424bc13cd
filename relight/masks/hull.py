"""Agreement between the views: the visual hull of their masks (Laurentini 1994), asked point by point.

A point of the subject lies in the mask of every frame that has it in the picture, whether it is seen there or
hidden. So a point of the cloud that is off the masks in several frames is not the subject's; and a pixel that
a mask claims beyond the cloud must have, somewhere near the subject's depth along its ray, a point that the
other masks claim too.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from capture.cameras import Camera
from relight.masks.frames import Floats
from relight.masks.sweep import epipolar, mean_at
from relight.observations import sample_bilinear
from relight.raster import NEAR_M, project

DEPTHS = (0.8, 0.87, 0.94, 1.0, 1.06, 1.13, 1.2)
"""Where along a ray the subject is sought, factors on its depth."""

_OFF = 0.3  # coverage under which a point is off a mask
_TOLERATED = 0.15  # share of the views that may say so of a point of the subject
_FOR, _AGAINST = 1.0, -3.0  # log-odds of pixels that no view and that many views contradict


class Votes:
    """How often each point of a cloud is off the masks."""

    def __init__(self, points: NDArray[np.floating]) -> None:
        """Args: points [P, 3] world; those that are not finite are never in a picture."""
        self._points = torch.from_numpy(np.ascontiguousarray(points, dtype=np.float32))
        self._off = torch.zeros(len(points))
        self._seen = torch.zeros(len(points))

    def add(self, mask: Floats, camera: Camera) -> None:
        """One frame's mask [H, W] 0..1 of a camera of its size; a point by its outline is not yet off it."""
        uv_px, z = project(self._points, camera)
        inside = (z > NEAR_M) & (uv_px >= 0).all(dim=1)
        inside &= (uv_px[:, 0] < camera.width) & (uv_px[:, 1] < camera.height)
        which = inside.nonzero()[:, 0]
        wide = torch.from_numpy(cv2.dilate(mask, np.ones((3, 3), np.uint8)))
        coverage = sample_bilinear(wide[None], uv_px[which])[:, 0]
        self._off[which] += (coverage < 0.5).float()
        self._seen[which] += 1.0

    def share(self) -> NDArray[np.float32]:
        """[P] of the frames with the point in the picture, those in which it is off the mask; 1 if none."""
        share = torch.where(self._seen > 0, self._off / self._seen.clamp(min=1.0), 1.0)
        return np.asarray(share.numpy(), np.float32)


def hull_evidence(
    camera: Camera,
    depth: Floats,
    claimed: NDArray[np.bool_],
    masks: Sequence[Floats],
    cameras: Sequence[Camera],
) -> Floats:
    """Log-odds [N] of N claimed pixels being the subject, by the masks of other views.

    Args:
        camera: Of the small picture.
        depth: [h, w] of the subject, continued beyond its outline.
        claimed: [h, w] bool, the pixels in question.
        masks: Of the other views, each [h, w] 0..1.
        cameras: Of these, in the size of their masks.
    """
    rows, columns = np.nonzero(claimed)
    if not masks or not len(rows):
        return np.zeros(len(rows), np.float32)
    off = [(each < _OFF).astype(np.float32) for each in masks]
    lines = [epipolar(camera, other, columns + 0.5, rows + 0.5) for other in cameras]
    least = np.ones(len(rows), np.float32)
    for factor in DEPTHS:
        share, seen = mean_at(off, lines, depth[rows, columns] * np.float32(factor))
        least = np.minimum(least, np.where(seen > 0, share, 0.0))
    agreement = 1.0 - np.minimum(least / _TOLERATED, 1.0)
    return (_AGAINST + (_FOR - _AGAINST) * agreement).astype(np.float32)
