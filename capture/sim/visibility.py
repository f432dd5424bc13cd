"""Which light reaches which point of the sitter: depth maps seen from the light.

Broad light (room, environments) is blocked per vertex, once: `BroadShadows` looks at the head from many
directions. Small lights (flash, point) get one sharp depth map each time: `point_visibility`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from capture.cameras import Camera
from capture.sim.ahead import computed_ahead
from capture.sim.bust import Bust
from capture.sim.environment import Environment, TurnedEnvironment, fibonacci_directions
from capture.sim.rasterize import Raster, project

_FAR_LIGHT_M = 12.0  # so far that its rays are parallel to 1.5 degrees over the bust
_TARGET = np.array([0.0, -0.11, -0.01])
_REACH_M = 0.37  # radius of the ball around _TARGET that the bust fills


def view_from(position: np.ndarray, target: np.ndarray, reach_m: float, size: int) -> Camera:
    """A square view from a light that just holds a ball of radius `reach_m` around `target`."""
    forward = target - position
    distance = float(np.linalg.norm(forward))
    forward = forward / distance
    aside = np.array([0.0, 1.0, 0.0]) if abs(forward[1]) < 0.9 else np.array([1.0, 0.0, 0.0])
    right = np.cross(forward, aside)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    cam_from_world = np.eye(4)
    cam_from_world[:3, :3] = rotation
    cam_from_world[:3, 3] = -rotation @ position
    focal = 0.5 * size * np.sqrt(max(distance**2 - reach_m**2, 0.01)) / reach_m
    K = np.array([[focal, 0.0, size / 2], [0.0, focal, size / 2], [0.0, 0.0, 1.0]])
    return Camera("light", size, size, K, cam_from_world)


def depth_visibility(raster: Raster, points: np.ndarray, bias_m: float, soft_m: float) -> np.ndarray:
    """Share of light [P] that reaches points [P, 3]: 1 on the depth map, falling over `soft_m` behind it.

    The four texels around the point's projection are compared and weighted (percentage-closer filtering).
    """
    view = raster.camera
    pixel, depth = project(view, points)
    column = np.clip(pixel[:, 0] - 0.5, 0.0, view.width - 1.001)
    row = np.clip(pixel[:, 1] - 0.5, 0.0, view.height - 1.001)
    left, top = column.astype(np.int32), row.astype(np.int32)
    fx, fy = column - left, row - top
    flat = raster.depth.ravel()
    start = top * view.width + left
    total = np.zeros(len(points), dtype=np.float32)
    for step, weight in (
        (0, (1 - fx) * (1 - fy)),
        (1, fx * (1 - fy)),
        (view.width, (1 - fx) * fy),
        (view.width + 1, fx * fy),
    ):
        behind = depth - flat[start + step] - bias_m
        total += weight * np.clip(1.0 - behind / soft_m, 0.0, 1.0)
    return total


def point_visibility(bust: Bust, position: np.ndarray, chosen: np.ndarray, size: int = 800) -> np.ndarray:
    """Share of a point light's rays [C] that reach the chosen vertices ([C] indices)."""
    raster = Raster.empty(view_from(position, _TARGET, _REACH_M, size))
    raster.draw(bust.vertices, bust.triangles, None)
    # Off the surface by 1.5 mm along the normal and 1 mm in depth: a facet must not shade itself.
    lifted = bust.vertices[chosen] + np.float32(0.0015) * bust.normals[chosen]
    return depth_visibility(raster, lifted, 0.001, 0.003)


@dataclass(frozen=True, eq=False)
class BroadShadows:
    """How much of each environment's light at a vertex the sitter does not block.

    Attributes:
        passed: for each environment [V, 3]: received irradiance over what an unblocked vertex would receive.
    """

    passed: tuple[np.ndarray, ...]

    @classmethod
    def trace(
        cls,
        bust: Bust,
        environments: Sequence[Environment | TurnedEnvironment],
        directions: int,
        size: int = 320,
    ) -> BroadShadows:
        """Depth maps of the occluder from `directions` even directions, applied to every environment."""
        towards = fibonacci_directions(directions)
        powers = [environment.cells(towards) for environment in environments]
        points = bust.occluder.vertices
        normals = bust.occluder.normals()
        lifted = points + np.float32(0.003) * normals
        shape = (len(points), 3)
        received = [np.full(shape, 1e-6, np.float32) for _ in environments]
        unblocked = [np.full(shape, 1e-6, np.float32) for _ in environments]

        def seen_from(direction: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            cosine = np.maximum(normals @ direction.astype(np.float32), 0.0)
            facing = np.nonzero(cosine > 0)[0]
            raster = Raster.empty(view_from(_TARGET + _FAR_LIGHT_M * direction, _TARGET, _REACH_M, size))
            raster.draw(points, bust.occluder.triangles, None)
            open_ = depth_visibility(raster, lifted[facing], 0.002, 0.004)
            return facing, cosine[facing], open_

        for k, (facing, cosine, open_) in enumerate(computed_ahead(seen_from, towards)):
            for power, sum_received, sum_unblocked in zip(powers, received, unblocked, strict=True):
                light = cosine[:, None] * power[k].astype(np.float32)
                sum_unblocked[facing] += light
                sum_received[facing] += open_[:, None] * light
        passed = []
        for sum_received, sum_unblocked in zip(received, unblocked, strict=True):
            ratio = sum_received / sum_unblocked
            passed.append(ratio[bust.occluder_of].mean(axis=1).astype(np.float32))
        return cls(tuple(passed))
