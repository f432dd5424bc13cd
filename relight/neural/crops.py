"""Random zooms and crops of a frame: square patches about the subject, as pictures and as cameras.

The paper's augmentation (Sevastopolsky et al. 2020, section 3.3 and 4.1): a zoom in or out, then a patch of
fixed size whose centre lies on the subject. A patch is a camera of its own, with the frame's pose, so that
points are rasterised for it at its own scale. It may reach beyond the frame; nothing is known there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch

from capture.cameras import Camera


@dataclass(frozen=True)
class Crop:
    """A square of a frame, brought to another size.

    Attributes:
        left: Of its first column in the frame, pixels; may be negative.
        top: Of its first row.
        side: Pixels of the frame that it spans.
        size: Pixels that it has itself.
    """

    left: int
    top: int
    side: int
    size: int

    def camera(self, camera: Camera) -> Camera:
        """The camera that takes the patch, of that which takes the frame."""
        zoom = self.size / self.side
        change = np.array([[zoom, 0, -zoom * self.left], [0, zoom, -zoom * self.top], [0, 0, 1.0]])
        return replace(camera, width=self.size, height=self.size, K=change @ camera.K)

    def of(self, image: torch.Tensor) -> torch.Tensor:
        """The patch [C, size, size] of a frame's image [C, H, W]: averaged where it shrinks, 0 beyond it."""
        height, width = image.shape[1:]
        top, bottom = (min(max(row, 0), height) for row in (self.top, self.top + self.side))
        left, right = (min(max(column, 0), width) for column in (self.left, self.left + self.side))
        patch = image.new_zeros(len(image), self.side, self.side, dtype=torch.float32)
        within = patch[:, top - self.top : bottom - self.top, left - self.left : right - self.left]
        if within.numel():
            within.copy_(image[:, top:bottom, left:right])
        if self.side == self.size:
            return patch
        return torch.nn.functional.interpolate(
            patch[None], (self.size, self.size), mode="bilinear", align_corners=False, antialias=True
        )[0]


def random_crop(
    subject: torch.Tensor, size: int, zooms: tuple[float, float], generator: torch.Generator
) -> Crop:
    """A patch about a random point of the subject, at a random zoom (even in its logarithm).

    Args:
        subject: [H, W] bool; where it is empty, the whole picture counts.
        size: Of the patch, pixels.
        zooms: Least and most; above 1 the patch shows less of the frame, larger.
        generator: Of chance, on the CPU.
    """
    draw = torch.rand(2, generator=generator, dtype=torch.float64)
    low, high = (math.log(zoom) for zoom in zooms)
    side = max(1, round(size / math.exp(low + float(draw[0]) * (high - low))))
    places = subject.flatten().nonzero()[:, 0]
    count = len(places) or subject.numel()
    pick = min(int(float(draw[1]) * count), count - 1)
    place = int(places[pick]) if len(places) else pick
    row, column = divmod(place, subject.shape[1])
    return Crop(column - side // 2, row - side // 2, side, size)
