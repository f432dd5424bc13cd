"""From a signed distance to a triangle mesh: sparse surface nets, subdivision, projection, vertex normals.

Surface nets: one vertex in each grid cell that the surface crosses (the mean of the crossings of its edges),
one quad around each grid edge that it crosses. Only blocks near the surface are ever evaluated.
Source: Gibson 1998, Constrained Elastic Surface Nets (without the relaxation: vertices are projected
    instead).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

Distance = Callable[[np.ndarray], np.ndarray]

_BLOCK = 4  # cells along the edge of a block
_KEY = 1 << 20  # more than the cells along any axis
_CORNERS = np.array([[i & 1, i >> 1 & 1, i >> 2 & 1] for i in range(8)])
_EDGES = [(a, b) for a in range(8) for b in range(a + 1, 8) if np.abs(_CORNERS[a] - _CORNERS[b]).sum() == 1]


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles in space, counter-clockwise seen from outside.

    Attributes:
        vertices: [V, 3] float32, metres.
        triangles: [T, 3] int32 vertex indices.
    """

    vertices: np.ndarray
    triangles: np.ndarray

    def normals(self) -> np.ndarray:
        """Unit vertex normals [V, 3] float32, weighted by triangle area; zero at unused vertices."""
        a, b, c = (self.vertices[self.triangles[:, i]] for i in range(3))
        area = np.cross(b - a, c - a)
        total = np.stack(
            [
                np.bincount(
                    self.triangles.ravel(), weights=np.repeat(area[:, i], 3), minlength=len(self.vertices)
                )
                for i in range(3)
            ],
            axis=-1,
        )
        length = np.linalg.norm(total, axis=-1, keepdims=True)
        return (total / np.maximum(length, 1e-20)).astype(np.float32)


def _active_blocks(distance: Distance, lower: np.ndarray, upper: np.ndarray, cell: float) -> np.ndarray:
    """Integer coordinates [B, 3] of the blocks that the surface may cross, from coarse to fine."""
    counts = np.ceil((upper - lower) / (cell * _BLOCK * 4)).astype(int)
    blocks = np.stack(np.meshgrid(*[np.arange(n) for n in counts], indexing="ij"), axis=-1).reshape(-1, 3)
    for per_block in (4, 2, 1):
        size = cell * _BLOCK * per_block
        centres = (lower + (blocks + 0.5) * size).astype(np.float32)
        # 0.87 = half the diagonal of a unit cube; the margin covers smooth unions, whose slope may pass 1,
        # and ears.
        blocks = blocks[np.abs(distance(centres)) < 0.87 * 1.8 * size]
        if per_block > 1:
            blocks = (blocks[:, None, :] * 2 + _CORNERS).reshape(-1, 3)
    return blocks


def surface_nets(distance: Distance, lower: np.ndarray, upper: np.ndarray, cell: float) -> Mesh:
    """Mesh of the zero level inside the box.

    Args:
        distance: [P, 3] points to [P] signed distances, negative inside.
        lower: [3] corner of the box; the surface should not touch the box.
        upper: [3] opposite corner.
        cell: grid spacing, in the unit of the points.
    """
    blocks = _active_blocks(distance, lower, upper, cell)
    steps = np.arange(_BLOCK + 1)
    local = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1)
    corners = (blocks[:, None, None, None] * _BLOCK + local).reshape(-1, 3)
    values = distance((lower + corners * cell).astype(np.float32)).reshape(-1, *[_BLOCK + 1] * 3)
    around = np.stack(
        [values[:, i : i + _BLOCK, j : j + _BLOCK, k : k + _BLOCK] for i, j, k in _CORNERS], axis=-1
    )
    inside_count = (around < 0).sum(axis=-1)
    crossing = np.nonzero((inside_count > 0) & (inside_count < 8))
    cells = blocks[crossing[0]] * _BLOCK + np.stack(crossing[1:], axis=-1)
    around = around[crossing]

    keys = (cells[:, 0].astype(np.int64) * _KEY + cells[:, 1]) * _KEY + cells[:, 2]
    order = np.argsort(keys)
    keys, cells, around = keys[order], cells[order], around[order]
    vertices = lower + (cells + _mean_crossing(around)) * cell
    return Mesh(vertices.astype(np.float32), _quads(keys, cells, around))


def _mean_crossing(around: np.ndarray) -> np.ndarray:
    """Mean of the points [C, 3] where the surface crosses the edges of each unit cell."""
    total = np.zeros((len(around), 3))
    count = np.zeros((len(around), 1))
    for a, b in _EDGES:
        crossed = (around[:, a] < 0) != (around[:, b] < 0)
        span = np.where(crossed, around[:, a] - around[:, b], 1.0)
        t = np.where(crossed, around[:, a] / span, 0.0)
        point = _CORNERS[a] + t[:, None] * (_CORNERS[b] - _CORNERS[a])
        total += np.where(crossed[:, None], point, 0.0)
        count += crossed[:, None]
    return total / np.maximum(count, 1)


def _quads(keys: np.ndarray, cells: np.ndarray, around: np.ndarray) -> np.ndarray:
    """Triangles [T, 3] of the quads around all crossed edges that start at a cell's first corner."""
    triangles = []
    for axis in range(3):
        inside_first, inside_second = around[:, 0] < 0, around[:, 1 << axis] < 0
        crossed = np.nonzero(inside_first != inside_second)[0]
        steps = np.eye(3, dtype=int)[[(axis + 1) % 3, (axis + 2) % 3]]
        ring = [np.zeros(3, int), -steps[0], -steps[0] - steps[1], -steps[1]]
        quad = np.empty((len(crossed), 4), dtype=np.int64)
        found = np.ones(len(crossed), dtype=bool)
        for column, step in enumerate(ring):
            neighbour = cells[crossed] + step
            wanted = (neighbour[:, 0].astype(np.int64) * _KEY + neighbour[:, 1]) * _KEY + neighbour[:, 2]
            quad[:, column] = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
            found &= keys[quad[:, column]] == wanted
        quad, outward = quad[found], inside_first[crossed][found]
        quad[~outward] = quad[~outward][:, ::-1]
        triangles += [quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]]
    return np.concatenate(triangles).astype(np.int32)


def subdivide(mesh: Mesh, chosen: np.ndarray) -> Mesh:
    """Triangles between chosen vertices ([V] bool) into four, their neighbours into two: no gap opens.

    An edge is split at its middle when both its ends are chosen. The first V vertices stay what they were.
    """
    triangles = mesh.triangles
    corners = chosen[triangles].sum(axis=-1)
    # Rotate the triangles with two chosen corners so that these come first.
    two = triangles[corners == 2]
    first = np.argmin(chosen[two], axis=-1)
    two = np.take_along_axis(two, (first[:, None] + np.array([1, 2, 3])) % 3, axis=-1)
    three = triangles[corners == 3]
    edges = np.concatenate([three[:, [0, 1]], three[:, [1, 2]], three[:, [2, 0]], two[:, :2]])
    edges = np.sort(edges, axis=-1).astype(np.int64)
    unique, index = np.unique(edges[:, 0] * len(mesh.vertices) + edges[:, 1], return_inverse=True)
    middles = mesh.vertices[np.stack(np.divmod(unique, len(mesh.vertices)), axis=-1)].mean(axis=1)
    split = index + len(mesh.vertices)
    ab, bc, ca = split[: 3 * len(three)].reshape(3, -1)
    a, b, c = three.T
    parts = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    middle, (p, q, r) = split[3 * len(three) :], two.T
    parts += [(p, middle, r), (middle, q, r)]
    refined = np.concatenate([triangles[corners < 2], *(np.stack(part, axis=-1) for part in parts)])
    return Mesh(np.concatenate([mesh.vertices, middles]).astype(np.float32), refined.astype(np.int32))


def project_to_surface(mesh: Mesh, distance: Distance, max_step: float, iterations: int = 2) -> Mesh:
    """Vertices moved along their normals onto the zero level, at most `max_step` each time."""
    vertices = mesh.vertices
    for _ in range(iterations):
        step = np.clip(distance(vertices), -max_step, max_step)
        vertices = vertices - step[:, None] * Mesh(vertices, mesh.triangles).normals()
    return Mesh(vertices.astype(np.float32), mesh.triangles)
