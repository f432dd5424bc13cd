"""The part of a picture that shows a region, and how far things in it move from view to view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from capture.cameras import Camera
from relight.head_region import HeadRegion

_FEWEST_PX = 12


@dataclass(frozen=True)
class Window:
    """A rectangle of pixels.

    Attributes:
        left: First column.
        top: First row.
        width: Columns.
        height: Rows.
        distance: Depth of the region's centre in this view, world units.
    """

    left: int
    top: int
    width: int
    height: int
    distance: float

    def cut(self, picture: torch.Tensor) -> torch.Tensor:
        """The window's part of a picture [H, W]."""
        return picture[self.top : self.top + self.height, self.left : self.left + self.width]


def region_window(camera: Camera, region: HeadRegion) -> Window | None:
    """The window that shows a sphere; None where the picture shows hardly any of it."""
    centre = camera.cam_from_world[:3, :3] @ region.centre_world + camera.cam_from_world[:3, 3]
    distance = float(centre[2])
    if distance <= 1.05 * region.radius:
        return None
    # The outline of a sphere seen at distance d is that of its radius at d / cos^2, sin = radius / d.
    reach = region.radius / np.sqrt(distance**2 - region.radius**2)
    sides = []
    for row, size in ((0, camera.width), (1, camera.height)):
        middle = camera.K[row, 2] + camera.K[row, row] * centre[row] / distance
        ends = middle + camera.K[row, row] * np.array([-reach, reach])
        low, high = np.clip([np.floor(ends[0]), np.ceil(ends[1])], 0, size)
        sides.append((int(low), int(high - low)))
    (left, width), (top, height) = sides
    if width < _FEWEST_PX or height < _FEWEST_PX:
        return None
    return Window(left, top, width, height, distance)


def relative_projection(reference: Camera, source: Camera) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A [3, 3] and b [3] of a pixel's place in a source: x ~ A (u, v, 1) + b / depth, in pixels."""
    source_from_reference = source.cam_from_world @ np.linalg.inv(reference.cam_from_world)
    A = source.K @ source_from_reference[:3, :3] @ np.linalg.inv(reference.K)
    return A, source.K @ source_from_reference[:3, 3]


def parallax_px(reference: Camera, sources: Sequence[Camera], point_world: NDArray[np.float64]) -> float:
    """Pixels by which a point moves in a source for a unit of inverse depth, in the source where it moves
    most."""
    at = reference.cam_from_world[:3, :3] @ point_world + reference.cam_from_world[:3, 3]
    pixel, inverse = reference.K @ (at / at[2]), 1.0 / at[2]
    largest = 0.0
    for source in sources:
        A, b = relative_projection(reference, source)
        ends = [A @ pixel + factor * inverse * b for factor in (0.99, 1.01)]
        moved = ends[1][:2] / ends[1][2] - ends[0][:2] / ends[0][2]
        largest = max(largest, float(np.linalg.norm(moved) / (0.02 * inverse)))
    return largest


def transferred(
    values: torch.Tensor, window: Window, camera: Camera, to_window: Window, to_camera: Camera
) -> torch.Tensor:
    """A map of one resolution at the pixels of another of the same picture, bilinear."""
    across = (torch.arange(to_window.width) + to_window.left + 0.5) * (camera.width / to_camera.width)
    down = (torch.arange(to_window.height) + to_window.top + 0.5) * (camera.height / to_camera.height)
    x = (across - window.left) * (2.0 / window.width) - 1.0
    y = (down - window.top) * (2.0 / window.height) - 1.0
    grid = torch.stack([x[None].expand(len(y), -1), y[:, None].expand(-1, len(x))], dim=-1).to(values)
    return torch.nn.functional.grid_sample(
        values[None, None], grid[None], mode="bilinear", padding_mode="border", align_corners=False
    )[0, 0]
