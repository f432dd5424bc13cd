"""Settings and result of the dense stereo."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class StereoConfig:
    """How the dense cloud is made.

    Attributes:
        references: Frames that get a depth map, spread over the path.
        angles_deg: Angles between a reference and its sources at the coarse, middle and fine resolution;
            one source is taken on either side for each.
        widest_deg: No source is further away.
        working_px: Longer side of the head's window at the fine resolution; larger pictures are reduced.
        second_pass: Whether depth maps are estimated once more from what the first ones agreed on.
        neighbours: Other depth maps that a depth map is checked against.
        depth_tolerance: Relative difference of depths that still agree.
        fewest_maps: Depth maps, its own included, that must agree on a point.
        cell_px: Side of the cube that one point stands for, in pixels of the nearer views.
    """

    references: int = 36
    angles_deg: tuple[tuple[float, ...], ...] = (
        (4.0, 7.0, 10.0),
        (4.0, 8.0, 12.0),
        (5.0, 9.0, 14.0, 18.0),
    )
    widest_deg: float = 30.0
    working_px: int = 512
    second_pass: bool = True
    neighbours: int = 8
    depth_tolerance: float = 0.008
    fewest_maps: int = 3
    cell_px: float = 0.85


@dataclass(frozen=True, eq=False)
class DenseCloud:
    """A cloud of the subject's surface.

    Attributes:
        points: [P, 3] float32, world.
        normals_world: [P, 3] float32, unit, towards the cameras.
        confidence: [P] float32, 0..1: share of the depth maps about a point that agree on it; 0 for a visual
            hull.
        report: Plain numbers and words.
        warnings: One sentence each.
    """

    points: NDArray[np.float32]
    normals_world: NDArray[np.float32]
    confidence: NDArray[np.float32]
    report: dict[str, Any] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
