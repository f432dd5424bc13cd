"""A head's own axes and size, and the nose: what tells a face from anything else that is symmetric.

The frame stands on the plane of symmetry. `left` is its normal towards the subject's left, `up` the world's
up brought into it, `forward` where the face looks. The unit of everything is `breadth`, the head's own.

A nose is found in the profile: at each height, how far the middle stands out before the cheeks beside it. A
ball or a helmet stands out a little at every height, the edge of a box much at every height; a nose does at
one height, over a fifth to a half of a breadth, with the brow above it and the mouth below.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from relight.face.plane import Floats, Plane

_LEVEL = 0.025  # breadths between the levels of the profile
_MIDDLE = 0.05  # breadths from the plane that count as the middle
_BESIDE = (0.12, 0.19)  # breadths from the plane: beside the wings of a nose, but still on a chin
_ABOVE = (0.15, 0.5)  # breadths above the tip between which the nose ends
_BELOW = (0.07, 0.3)
_FEWEST_LEVELS = 3
_LONGEST = 0.24  # breadths that a nose may stand out; what does more has a neck beside it and is a chin
_BEHIND = 0.1  # breadths that a tip may lie behind the foremost point: of a chin, where the head is tilted
_FEWEST = 3
_MOST_LEVELS = 400


@dataclass(frozen=True)
class HeadFrame:
    """Axes of a head.

    Attributes:
        plane: Of symmetry; its normal points to the subject's left.
        up: [3] unit, in the plane.
        forward: [3] unit, in the plane, where the face looks.
        origin: [3] on the plane, on the upright axis of the head, at the height of the tip of the nose.
        breadth: Of the head across the plane, world units; hair and ears make it wider.
        nose_tip: [3] on the plane.
        nose_height: How far the nose stands out before the cheeks, over what other levels do, in breadths.
    """

    plane: Plane
    up: tuple[float, float, float]
    forward: tuple[float, float, float]
    origin: tuple[float, float, float]
    breadth: float
    nose_tip: tuple[float, float, float]
    nose_height: float

    @property
    def axes(self) -> NDArray[np.float64]:
        """[3, 3] rows left, up, forward."""
        return np.stack([self.plane.n, np.array(self.up), np.array(self.forward)])

    def local(self, points: Floats) -> NDArray[np.float64]:
        """Points [..., 3] along left, up and forward from the origin, in breadths."""
        return np.asarray((points - np.array(self.origin)) @ self.axes.T / self.breadth)

    def world(self, local: Floats) -> NDArray[np.float64]:
        """`local` undone."""
        return np.asarray(local * self.breadth @ self.axes + np.array(self.origin))


def head_frame(points: Floats, normals: Floats, plane: Plane, up: Floats, towards: Floats) -> HeadFrame:
    """The frame of a head whose plane of symmetry is known.

    Args:
        points: [N, 3] of the head alone, evenly spread, without outliers.
        normals: [N, 3] unit.
        plane: Of symmetry.
        up: [3] unit, roughly.
        towards: [3] unit, from the head to where the cameras are: the face is on that side.
    """
    n = plane.n
    upright = up - (up @ n) * n
    upright /= np.linalg.norm(upright)
    forward = np.cross(n, upright)
    if forward @ towards < 0:
        forward, n = -forward, -n
        plane = Plane.of(n, -plane.offset)
    side = plane.distance(points)
    heights, depths = points @ upright, points @ forward
    breadth = _breadth(side)
    facing = normals @ forward > 0.0
    levels, protrusion, middle = _profile(side[facing], heights[facing], depths[facing], breadth)
    tip_height, tip_depth, stands_out = _nose(levels, protrusion, middle, breadth)
    near = np.abs(heights - tip_height) < 0.5 * breadth
    axis_depth = _axis_depth(side[near], depths[near], tip_depth, breadth)
    on_plane = plane.offset * n
    origin = on_plane + upright * tip_height + forward * axis_depth
    tip = on_plane + upright * tip_height + forward * tip_depth
    return HeadFrame(
        plane, _three(upright), _three(forward), _three(origin), breadth, _three(tip), stands_out
    )


def _breadth(side: Floats) -> float:
    """Twice the distance of the outermost points; of the wider side, for the other may be cut off."""
    reach = [
        float(np.percentile(side[side * sign > 0] * sign, 97)) for sign in (-1, 1) if (side * sign > 0).any()
    ]
    return max(2.0 * max(reach, default=0.0), 1e-9)  # a sheet in the plane has none


def _profile(side: Floats, heights: Floats, depths: Floats, breadth: float) -> tuple[Floats, Floats, Floats]:
    """Heights [L] of levels, how far the middle stands out before what is beside it, and the middle's depth.

    NaN where a level has no middle or nothing beside it.
    """
    low, high = (float(heights.min()), float(heights.max())) if len(heights) else (0.0, 0.0)
    count = int(np.clip((high - low) / (_LEVEL * breadth), 1, _MOST_LEVELS))
    levels = low + (np.arange(count) + 0.5) * (high - low) / count
    middle, beside = np.full(count, np.nan), np.full(count, np.nan)
    reach = np.abs(side) / breadth
    for k, level in enumerate(levels):
        here = np.abs(heights - level) <= _LEVEL * breadth
        inner = depths[here & (reach < _MIDDLE)]
        if len(inner) >= _FEWEST:
            middle[k] = np.percentile(inner, 85)
        cheeks = [
            float(np.median(depths[here & (reach > _BESIDE[0]) & (reach < _BESIDE[1]) & (side * sign > 0)]))
            for sign in (-1, 1)
            if (here & (reach > _BESIDE[0]) & (reach < _BESIDE[1]) & (side * sign > 0)).sum() >= _FEWEST
        ]
        if cheeks:
            beside[k] = np.mean(cheeks)
    return levels, (middle - beside) / breadth, middle


def _nose(levels: Floats, protrusion: Floats, middle: Floats, breadth: float) -> tuple[float, float, float]:
    """Height and depth of the tip, and how far it stands out over what the levels about the nose do."""
    known = np.isfinite(protrusion)
    foremost = float(middle[np.isfinite(middle)].max(initial=-np.inf))
    best = (float(np.median(levels)), foremost if np.isfinite(foremost) else 0.0, 0.0)
    if known.sum() < 5:
        return best
    reach = (levels[known, None] - levels[known]) / breadth  # [others, tip]
    stands = protrusion[known]
    for k, (at, height) in enumerate(zip(np.flatnonzero(known), stands, strict=True)):
        if foremost - middle[at] > _BEHIND * breadth or height > _LONGEST:
            continue
        above = stands[(reach[:, k] > _ABOVE[0]) & (reach[:, k] < _ABOVE[1])]
        below = stands[(reach[:, k] < -_BELOW[0]) & (reach[:, k] > -_BELOW[1])]
        if len(above) < _FEWEST_LEVELS or len(below) < _FEWEST_LEVELS:
            continue
        # A low percentile and not the least: the lip below a nose is a few levels high.
        stands_out = float(height - max(np.percentile(above, 20), np.percentile(below, 20)))
        if stands_out > best[2]:
            best = (float(levels[at]), float(middle[at]), stands_out)
    return best


def _axis_depth(side: Floats, depths: Floats, tip_depth: float, breadth: float) -> float:
    """Depth of the upright axis: the middle of a circle through the sides of the head, not its front.

    x^2 + (z - c)^2 = r^2 is linear in c and r^2 - c^2; kept between 0.4 and 0.9 breadths behind the nose.
    """
    if len(side) >= 8:
        matrix = np.stack([2.0 * depths, np.ones_like(depths)], axis=1)
        solution, *_ = np.linalg.lstsq(matrix, side**2 + depths**2, rcond=None)
        centre = float(solution[0])
    else:
        centre = tip_depth - 0.65 * breadth
    return float(np.clip(centre, tip_depth - 0.9 * breadth, tip_depth - 0.4 * breadth))


def _three(values: Floats) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z
