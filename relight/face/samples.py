"""A few thousand evenly spread points of a cloud, and a lattice that tells the nearest of them at once.

What a search over thousands of planes asks is always the same: which point is nearest to the mirror image of
this one. A distance transform answers for every cell of a lattice beforehand; what is then left of a look-up
is one index.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

from relight.face.plane import Floats

_MOST_RAW = 60_000  # points that the thinning starts from
_CELLS = 56  # along the largest side of the cloud: 5 mm on head and shoulders
_FEWEST = 200
_OUTLIER_NEIGHBOURS = 6
_OUTLIER_FACTOR = 2.5
_ALBEDO_FLOOR = 0.02


@dataclass(frozen=True, eq=False)
class Samples:
    """Averages over the occupied cells of a lattice.

    Attributes:
        points: [N, 3] float64, world.
        normals: [N, 3] float64, unit.
        albedo: [N, 3] float64 relative to the cloud's median, None = not known.
        trust: [N] 0..1, how far each albedo is to be trusted.
        cell: Side of a cell, world units.
        radius: Half the typical breadth of the cloud (robust), world units.
        nearest: [X, Y, Z] int32, id of the sample nearest to each cell of a larger lattice.
        origin: [3] corner of that lattice.
    """

    points: NDArray[np.float64]
    normals: NDArray[np.float64]
    albedo: NDArray[np.float64] | None
    trust: NDArray[np.float64]
    cell: float
    radius: float
    nearest: NDArray[np.int32]
    origin: NDArray[np.float64]

    def ids_near(self, places: Floats) -> NDArray[np.int32]:
        """[...] ids of the samples nearest to places [..., 3], to within a cell."""
        index = ((places - self.origin) / self.cell).astype(np.int64)
        # What is outside looks up the border's sample, which is far away and so tells that it is outside.
        np.clip(index, 0, np.array(self.nearest.shape) - 1, out=index)
        found: NDArray[np.int32] = self.nearest[index[..., 0], index[..., 1], index[..., 2]]
        return found

    def albedo_agreement(
        self, first: NDArray[np.int64], second: NDArray[np.int32], tolerance: float
    ) -> NDArray[np.float64]:
        """How alike the albedos of samples are, 0..1; 1 where it is not known.

        Args:
            first: [...] ids.
            second: [...] ids.
            tolerance: Difference relative to the mean that still agrees (standard deviation).
        """
        if self.albedo is None:
            return np.ones(np.broadcast_shapes(first.shape, second.shape))
        one, other = self.albedo[first], self.albedo[second]
        total = (one + other).mean(axis=-1) + 2 * _ALBEDO_FLOOR
        relative = np.abs(one - other).mean(axis=-1) / total
        alike = np.exp(-0.5 * (2.0 * relative / tolerance) ** 2)
        trust = np.minimum(self.trust[first], self.trust[second])
        return np.asarray(1.0 - trust + trust * alike)


def take_samples(
    points: Floats, normals: Floats, albedo: Floats | None, trust: Floats | None = None
) -> Samples | None:
    """Thins a cloud to samples, and leaves out what is not finite or has no neighbours.

    Args:
        points: [P, 3], world.
        normals: [P, 3]; zero or not finite = unknown, such points are left out.
        albedo: [P, 3] linear, or None.
        trust: [P] 0..1, how far the albedo is known; None = everywhere.

    Returns:
        None where too little is left to speak of a shape.
    """
    length = np.linalg.norm(normals, axis=1)
    good = np.isfinite(points).all(axis=1) & np.isfinite(length) & (length > 1e-6)
    if albedo is not None:
        good &= np.isfinite(albedo).all(axis=1)
    kept = np.flatnonzero(good)
    kept = kept[:: max(1, len(kept) // _MOST_RAW)]
    if len(kept) < _FEWEST:
        return None
    kept = kept[_with_neighbours(points[kept])]
    low, high = np.percentile(points[kept], [0.5, 99.5], axis=0)
    side = float((high - low).max())
    if len(kept) < _FEWEST or not side > 0:
        return None
    cell = side / _CELLS
    kept = kept[((points[kept] > low - 4 * cell) & (points[kept] < high + 4 * cell)).all(axis=1)]
    index = np.floor((points[kept] - low) / cell).astype(np.int64)
    _, group, counts = np.unique(index, axis=0, return_inverse=True, return_counts=True)
    group = group.ravel()

    def averaged(values: Floats) -> NDArray[np.float64]:
        sums = [np.bincount(group, values[:, axis].astype(np.float64)) for axis in range(values.shape[1])]
        return np.stack(sums, axis=1) / counts[:, None]

    mean_normals = averaged(normals[kept] / length[kept, None])
    agreement = np.linalg.norm(mean_normals, axis=1)  # below 1 where a cell holds two sheets
    enough = (counts >= max(1.0, 0.15 * float(np.median(counts)))) & (agreement > 0.5)
    if enough.sum() < _FEWEST:
        return None
    mean_points = averaged(points[kept])[enough]
    mean_albedo = None
    if albedo is not None:
        mean_albedo = averaged(albedo[kept])[enough]
        mean_albedo = mean_albedo / max(float(np.median(mean_albedo.mean(axis=1))), 1e-9)
    own = np.ones(len(counts)) if trust is None else averaged(trust[kept, None])[:, 0]
    nearest, origin = _nearest_lattice(mean_points, cell)
    spread = np.percentile(mean_points, [5, 95], axis=0)
    return Samples(
        points=mean_points,
        normals=mean_normals[enough] / agreement[enough, None],
        albedo=mean_albedo,
        trust=own[enough].clip(0.0, 1.0),
        cell=cell,
        radius=0.5 * float(np.sort(spread[1] - spread[0])[1]),
        nearest=nearest,
        origin=origin,
    )


def _with_neighbours(points: Floats) -> NDArray[np.int64]:
    """Indices of the points whose neighbours are about as near as those of the others."""
    count = min(_OUTLIER_NEIGHBOURS + 1, len(points))
    distances, _ = cKDTree(points).query(points, k=[count], workers=1)
    limit = _OUTLIER_FACTOR * float(np.median(distances))
    kept: NDArray[np.int64] = np.flatnonzero(distances[:, 0] <= limit)
    return kept


def _nearest_lattice(points: Floats, cell: float) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    margin = 8
    origin = points.min(axis=0) - margin * cell
    index = ((points - origin) / cell).astype(np.int64)
    shape = index.max(axis=0) + margin + 1
    ids = np.full(shape, -1, dtype=np.int32)
    ids[tuple(index.T)] = np.arange(len(points), dtype=np.int32)
    where = distance_transform_edt(ids < 0, return_distances=False, return_indices=True)
    return ids[tuple(where)], np.asarray(origin, dtype=np.float64)
