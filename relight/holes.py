"""Small holes of a surface's point cloud, found and filled with the quadratic that continues their
surroundings.

A point at the edge of a hole or of the cloud has no neighbours on one side (largest angular gap in the
tangent plane: Bendels et al. 2006, "Detecting holes in point set surfaces"). Edge points that lie close
together make a rim. A small rim is a hole's; the rim of the whole cloud, as below the shoulders, is large
and stays open.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError, cKDTree

from relight.tangents import tangents

Floats = NDArray[np.float32]

_NEIGHBOURS = 16
_GAP_RAD = math.radians(100)  # on an even sampling the gaps between 16 neighbours stay below 60 degrees
_LINK = 2.5  # spacings between points of one rim
_FEWEST = 6  # points of a rim: fewer enclose nothing that the sampling would show
_SURROUNDINGS = 1.5  # radii of a hole from which its patch is fitted
_FLATTEST_FIT = 0.15  # residual of the patch, in radii of the hole, above which it is no patch of one surface
_STEEPEST_RIM = 0.1  # a patch whose normal is further than 84 degrees from a normal of its rim is none


def fill_holes(points: Floats, normals: Floats, spacing: float, widest: float) -> tuple[Floats, Floats]:
    """Points and normals to add.

    Args:
        points: [P, 3], evenly sampled.
        normals: [P, 3], unit, consistently oriented.
        spacing: Of the points.
        widest: Holes wider than this stay open.

    Returns:
        Points [Q, 3] and unit normals [Q, 3] inside the holes, at the same spacing; Q = 0 without holes.
    """
    empty = np.empty((0, 3), np.float32)
    if len(points) <= _NEIGHBOURS:
        return empty, empty
    tree = cKDTree(points)
    edge = _edge_points(points, normals, tree).nonzero()[0]
    added, directions = [empty], [empty]
    for rim in _rims(points[edge], _LINK * spacing):
        ids = edge[rim]
        extent = np.ptp(points[ids], axis=0)
        if len(ids) >= _FEWEST and 0.0 < float(np.linalg.norm(extent)) <= widest:
            patch = _patch(points, normals, tree, ids, spacing)
            if patch is not None:
                added.append(patch[0])
                directions.append(patch[1])
    return np.concatenate(added), np.concatenate(directions)


def _edge_points(points: Floats, normals: Floats, tree: cKDTree) -> NDArray[np.bool_]:
    """Points [P] bool with a wide sector of their tangent plane free of neighbours."""
    _, ids = tree.query(points, k=_NEIGHBOURS, workers=-1)
    offsets = points[ids[:, 1:]] - points[:, None]
    u, v = tangents(normals)
    angles = np.sort(
        np.arctan2((offsets * v[:, None]).sum(axis=-1), (offsets * u[:, None]).sum(axis=-1)), axis=1
    )
    gaps = np.diff(np.concatenate([angles, angles[:, :1] + 2 * np.pi], axis=1), axis=1)
    edge: NDArray[np.bool_] = gaps.max(axis=1) > _GAP_RAD
    return edge


def _rims(points: Floats, link: float) -> list[NDArray[np.int64]]:
    """Groups of edge points that hang together."""
    if not len(points):
        return []
    pairs = cKDTree(points).query_pairs(link, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(points),) * 2)
    count, label = connected_components(graph, directed=False)
    order = np.argsort(label, kind="stable")
    return np.split(order, np.cumsum(np.bincount(label, minlength=count))[:-1])


def _patch(
    points: Floats, normals: Floats, tree: cKDTree, rim: NDArray[np.int64], spacing: float
) -> tuple[Floats, Floats] | None:
    """New points and normals inside a rim, None where it encloses nothing or its surroundings are no
    patch."""
    centre = points[rim].mean(axis=0)
    normal = normals[rim].mean(axis=0)
    if np.linalg.norm(normal) < 0.3:
        return None  # the rim runs around an edge or a thin sheet
    normal = (normal / np.linalg.norm(normal)).astype(np.float32)
    if ((normals[rim] @ normal) < _STEEPEST_RIM).any():
        return None
    radius = float(np.linalg.norm(points[rim] - centre, axis=1).max())
    around = np.asarray(tree.query_ball_point(centre, _SURROUNDINGS * radius + 2 * spacing), dtype=np.int64)
    around = around[normals[around] @ normal > _STEEPEST_RIM]
    frame = np.stack([*(axis[0] for axis in tangents(normal[None])), normal])
    local = (points[around] - centre) @ frame.T / radius
    basis = _basis(local[:, 0], local[:, 1])
    coefficients, *_ = np.linalg.lstsq(basis, local[:, 2].astype(np.float64), rcond=None)
    if np.sqrt(np.mean((basis @ coefficients - local[:, 2]) ** 2)) > _FLATTEST_FIT:
        return None
    inside = _grid_inside((points[rim] - centre) @ frame[:2].T / radius, spacing / radius)
    if inside is None:
        return None
    x, y = inside.T
    heights = _basis(x, y) @ coefficients
    new = (centre + radius * np.stack([x, y, heights], axis=1) @ frame).astype(np.float32)
    _, c1, c2, c3, c4, c5 = coefficients
    slopes = np.stack([-(c1 + 2 * c3 * x + c4 * y), -(c2 + c4 * x + 2 * c5 * y), np.ones_like(x)], axis=1)
    direction = (slopes / np.linalg.norm(slopes, axis=1, keepdims=True) @ frame).astype(np.float32)
    free = tree.query(new, k=[1])[0][:, 0] > 0.7 * spacing
    return new[free], direction[free]


def _grid_inside(rim: NDArray[np.floating], step: float) -> NDArray[np.float64] | None:
    """Grid points [Q, 2] inside the convex hull of a rim [R, 2]; None where the hull has no area."""
    try:
        hull = ConvexHull(rim)
    except QhullError:
        return None
    low, high = rim.min(axis=0), rim.max(axis=0)
    grid = np.stack(np.meshgrid(*(np.arange(a, b, step) for a, b in zip(low, high, strict=True))), axis=-1)
    grid = grid.reshape(-1, 2)
    inside: NDArray[np.float64] = grid[
        (grid @ hull.equations[:, :2].T + hull.equations[:, 2] <= 0).all(axis=1)
    ]
    return inside


def _basis(x: NDArray[np.floating], y: NDArray[np.floating]) -> NDArray[np.float64]:
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1).astype(np.float64)
