"""From the given point cloud to an even, smooth sampling of the surface with normals.

A dense stereo cloud is noisy along the viewing rays, has outliers and holes, and its spacing has nothing to
do with the pixels. The steps, all in multiples of the cloud's own spacing so that the unit of length does
not matter:

1. `clean`: points without near neighbours, or outside the subject's masks, go.
2. `smooth`: planes fitted to neighbourhoods as large as the noise asks for, with a robust quadratic for the
   heights (moving least squares: Alexa et al. 2003, "Computing and rendering point set surfaces").
3. `orient`: normals turned to the cameras that see the point.
4. `relight.holes`: holes of a few centimetres on a head are filled.
5. `resample`: discs around the smooth points filled with new ones, thinned to the wanted spacing and
   projected onto the surface: fine enough for the pixels.

Neighbours are found by scipy's k-d tree on the CPU; the sums run in torch.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from capture.cameras import Camera
from relight.errors import PlanError
from relight.holes import fill_holes
from relight.raster import NEAR_M, project
from relight.tangents import tangents

Floats = NDArray[np.float32]

FEWEST_POINTS = 32
"""Fewer points than one neighbourhood do not make a surface."""

_NOISE_NEIGHBOURS = 16
_OUTLIER_NEIGHBOURS = 8
_SUPPORT_NEIGHBOURS = 34  # points in a smoothing disc after averaging to a third of its radius
_MOST_NEIGHBOURS = 64
_DECIDED = 0.3  # mean cosine to the cameras; at the horizon the z-buffer takes some of the far side for seen
_CHUNK = 1 << 16  # points at a time where [P, k, 3] arrays are made: 50 MB


@dataclass(frozen=True)
class CloudConfig:
    """How the cloud is prepared.

    Attributes:
        outlier_factor: A point whose 8th neighbour is further than this many times the median is an outlier.
        smoothing: Radius of the smoothing disc is `smoothing * spacing * (noise / spacing)^(1/3)`: a
            plane's slope error falls with radius^2 and the bias of curvature grows with it, so the best
            radius goes with the cube root of the noise. The factor was found on clouds with known normals.
        footprint: Wanted spacing of the result in pixels of the nearest views.
        max_points: The spacing is widened to keep about this many points.
        widest_hole: Holes up to this many spacings of the given cloud are filled.
    """

    outlier_factor: float = 3.0
    smoothing: float = 7.3
    footprint: float = 0.9
    max_points: int = 400_000
    widest_hole: float = 60.0


@dataclass(frozen=True, eq=False)
class SurfaceCloud:
    """An even sampling of the surface.

    Attributes:
        points: [P, 3] float32, world.
        normals_world: [P, 3] float32, unit, towards the cameras.
        spacing: Typical distance of neighbours, world units.
        noise: Standard deviation of the given cloud about the smooth surface, world units.
    """

    points: Floats
    normals_world: Floats
    spacing: float
    noise: float


def prepare_cloud(
    points: Floats,
    normals_world: Floats | None,
    cameras: Sequence[Camera],
    config: CloudConfig = CloudConfig(),
) -> SurfaceCloud:
    """All steps of the module.

    Args:
        points: [P, 3] as given; non-finite ones are dropped.
        normals_world: [P, 3] as given with the cloud, or None; zero or non-finite ones are estimated.
        cameras: Those that took the frames.
        config: See there.

    Raises:
        PlanError: Too few points are left for a surface.
    """
    keep = clean(points, config.outlier_factor)
    if len(keep) < FEWEST_POINTS:
        raise PlanError(
            f"Only {len(keep)} of {len(points)} points of the cloud lie close enough to others to form a "
            "surface; a fit needs a dense cloud."
        )
    points = np.ascontiguousarray(points[keep], dtype=np.float32)
    hints = None if normals_world is None else normals_world[keep]
    spacing, noise = spacing_and_noise(points)
    radius = config.smoothing * spacing * max(noise / spacing, 0.02) ** (1 / 3)
    points, hints = _thin(points, hints, radius / math.sqrt(_SUPPORT_NEIGHBOURS / math.pi))
    points, normals = smooth(points, radius)
    normals = orient(points, normals, cameras, hints)
    patches = fill_holes(points, normals, _mean_spacing(points), config.widest_hole * spacing)
    points, normals = np.concatenate([points, patches[0]]), np.concatenate([normals, patches[1]])
    wanted = config.footprint * _nearest_footprint(points, cameras)
    area = len(points) * _mean_spacing(points) ** 2
    wanted = max(wanted, math.sqrt(area / config.max_points))
    sampled = resample(points, normals, wanted)
    if len(sampled[0]) > 1.1 * config.max_points:  # the area was an estimate
        wanted *= math.sqrt(len(sampled[0]) / config.max_points)
        sampled = resample(points, normals, wanted)
    return SurfaceCloud(*sampled, wanted, noise)


def clean(points: Floats, outlier_factor: float) -> NDArray[np.int64]:
    """Indices of the finite points that have neighbours as near as the others have."""
    finite = np.flatnonzero(np.isfinite(points).all(axis=1))
    if len(finite) <= _OUTLIER_NEIGHBOURS:
        return finite[:0]
    # Copies of one point are one point, and would make every other look like an outlier.
    finite = finite[np.unique(points[finite], axis=0, return_index=True)[1]]
    if len(finite) <= _OUTLIER_NEIGHBOURS:
        return finite[:0]
    distances, _ = cKDTree(points[finite]).query(points[finite], k=[_OUTLIER_NEIGHBOURS + 1], workers=-1)
    kept: NDArray[np.int64] = np.sort(finite[distances[:, 0] <= outlier_factor * np.median(distances)])
    return kept


def spacing_and_noise(points: Floats) -> tuple[float, float]:
    """Mean spacing of a cloud, and its standard deviation about local planes (median over the cloud)."""
    step = max(1, len(points) // 20_000)
    sample = points[::step]
    neighbours = min(_NOISE_NEIGHBOURS, len(points))
    distances, ids = cKDTree(points).query(sample, k=neighbours, workers=-1)
    spacing = float(np.median(distances[:, -1])) * math.sqrt(math.pi / neighbours)
    _, _, variances = _planes(points, ids, np.ones(ids.shape, np.float32))
    # A plane takes three of the degrees of freedom.
    noise = math.sqrt(float(np.median(variances)) * neighbours / max(1, neighbours - 3))
    return spacing, noise


def smooth(points: Floats, radius: float) -> tuple[Floats, Floats]:
    """Points moved onto robust local quadratics, and the normals of local planes (unit, sign arbitrary).

    Args:
        points: [P, 3].
        radius: Standard deviation of the Gaussian weight; the neighbourhood ends at about one radius, where
            the weights are still 0.6, because the tails would cost more neighbours than they add.
    """
    spacing = _mean_spacing(points)
    neighbours = int(np.clip(math.pi * (radius / spacing) ** 2, 12, _MOST_NEIGHBOURS))
    neighbours = min(neighbours, len(points))
    tree = cKDTree(points)
    moved, normals = np.empty_like(points), np.empty_like(points)
    for start in range(0, len(points), _CHUNK):
        part = slice(start, start + _CHUNK)
        distances, ids = tree.query(points[part], k=neighbours, workers=-1)
        weights = np.exp(-0.5 * (distances / radius) ** 2).astype(np.float32)
        _, normals[part], _ = _planes(points, ids, weights)
        heights = _quadratic_heights(points, ids, weights, normals[part], points[part], radius)
        moved[part] = points[part] + normals[part] * heights[:, None]
    return moved, normals


def orient(points: Floats, normals: Floats, cameras: Sequence[Camera], hints: Floats | None = None) -> Floats:
    """Normals turned towards the cameras that see their points, or towards the given hints where there are
    any.

    Which camera sees a point is told from a coarse z-buffer, without normals. Hints that are for the most
    part contrary to the cameras are taken for turned inside out. Over what no camera saw but from the side,
    the sign spreads from neighbour to neighbour.
    """
    cloud = torch.from_numpy(points)
    towards, cameras_seen = torch.zeros_like(cloud), torch.zeros(len(cloud))
    spacing = _mean_spacing(points)
    for camera in cameras[:: max(1, len(cameras) // 12)]:
        seen, directions = _unoccluded(cloud, camera, spacing)
        towards += seen[:, None] * directions
        cameras_seen += seen
    side = ((torch.from_numpy(normals) * towards).sum(dim=1) / cameras_seen.clamp(min=1.0)).numpy()
    if hints is not None:
        by_hint = np.nan_to_num((normals * hints).sum(axis=1))
        if np.sign(by_hint * side).sum() < 0:
            by_hint = -by_hint
        side = np.where(np.abs(by_hint) > 0.1, np.sign(by_hint), side)
    normals = normals * np.where(side < 0, -1.0, 1.0).astype(np.float32)[:, None]
    _, ids = cKDTree(points).query(points, k=min(16, len(points)), workers=-1)
    decided = np.abs(side) > _DECIDED
    reached = ~decided
    while decided.any() and reached.any():
        missing = (~decided).nonzero()[0]
        around = (decided[ids[missing]][..., None] * normals[ids[missing]]).sum(axis=1)
        turned = missing[(normals[missing] * around).sum(axis=1) < 0]
        normals[turned] *= -1.0
        reached = decided[ids[missing]].any(axis=1)
        decided[missing[reached]] = True
    for _ in range(3):
        majority = normals[ids].mean(axis=1)
        normals = (
            normals * np.where((normals * majority).sum(axis=1) < 0, -1.0, 1.0).astype(np.float32)[:, None]
        )
    return normals


def resample(points: Floats, normals: Floats, spacing: float) -> tuple[Floats, Floats]:
    """The surface of the given points sampled at another spacing.

    Each point stands for a disc in its tangent plane, as wide as its neighbours are apart, so gaps of up to
    twice that are closed. Discs are filled in a sunflower pattern, one candidate is kept a cube of the
    wanted spacing, and the kept ones are projected onto the surface.
    """
    base = _mean_spacing(points)
    radius = 1.3 * base
    count = int(np.clip(round(4.0 * (radius / spacing) ** 2), 4, 48))
    turns = np.arange(len(points)) * 2.399963  # golden angle: the patterns of neighbours do not line up
    u, v = tangents(normals)
    candidates = [points]
    for step in range(count):
        reach = radius * math.sqrt((step + 0.5) / count)
        angle = turns + step * 2.399963
        offsets = u * np.cos(angle)[:, None] + v * np.sin(angle)[:, None]
        candidates.append((points + reach * offsets).astype(np.float32))
    kept = _one_a_cube(np.concatenate(candidates), spacing)
    return _project_to_surface(kept, points, normals, 1.4 * base)


def _project_to_surface(
    candidates: Floats, points: Floats, normals: Floats, width: float
) -> tuple[Floats, Floats]:
    """Candidates moved onto the weighted mean of their neighbours' planes, and the mean normals."""
    tree = cKDTree(points)
    moved, directions = np.empty_like(candidates), np.empty_like(candidates)
    for start in range(0, len(candidates), _CHUNK):
        part = slice(start, start + _CHUNK)
        at = candidates[part]
        distances, ids = tree.query(at, k=min(12, len(points)), workers=-1)
        # Relative to the nearest, so that the weights cannot all underflow.
        weights = np.exp(-0.5 * (distances**2 - distances[:, :1] ** 2) / width**2).astype(np.float32)
        # Neighbours on the other side of a fold or a thin sheet do not take part.
        facing = (normals[ids] * normals[ids[:, :1]]).sum(axis=-1).clip(min=0.0)
        weights *= facing
        weights /= weights.sum(axis=1, keepdims=True)
        mean = (weights[..., None] * normals[ids]).sum(axis=1)
        mean /= np.linalg.norm(mean, axis=1, keepdims=True)
        heights = (weights * ((at[:, None] - points[ids]) * normals[ids]).sum(axis=-1)).sum(axis=1)
        moved[part] = at - heights[:, None] * mean
        directions[part] = mean
    return moved, directions


def _planes(
    points: Floats, ids: NDArray[np.int64], weights: Floats
) -> tuple[Floats, Floats, NDArray[np.float64]]:
    """Weighted planes through neighbourhoods: means [N, 3], unit normals [N, 3], variances about them [N]."""
    near = torch.from_numpy(points)[torch.from_numpy(ids)]
    weight = torch.from_numpy(weights)
    total = weight.sum(dim=1, keepdim=True)
    mean = (weight[..., None] * near).sum(dim=1) / total
    offsets = near - mean[:, None]
    covariance = torch.einsum("pki,pkj->pij", weight[..., None] * offsets, offsets) / total[..., None]
    # float64: the smallest eigenvalue is 1e-3 of the largest and less.
    values, vectors = torch.linalg.eigh(covariance.double())
    return mean.numpy(), vectors[:, :, 0].float().numpy(), values[:, 0].clamp(min=0.0).numpy()


def _quadratic_heights(
    points: Floats, ids: NDArray[np.int64], weights: Floats, normals: Floats, at: Floats, radius: float
) -> Floats:
    """Height over `at`, along the normal, of a quadratic fitted to each neighbourhood, robust by one
    reweighting."""
    offsets = torch.from_numpy(points[ids] - at[:, None]) / radius
    x, y, z = (
        (offsets @ torch.from_numpy(axis)[..., None])[..., 0] for axis in (*tangents(normals), normals)
    )
    basis = torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y], dim=-1)
    weight = torch.from_numpy(weights)
    ridge = 1e-4 * weight.sum(dim=1)[:, None, None] * torch.eye(6)
    for _ in range(2):
        weighted = weight[..., None] * basis
        left = (weighted.transpose(1, 2) @ basis + ridge).double()
        right = (weighted * z[..., None]).sum(dim=1).double()
        coefficients = torch.linalg.solve(left, right).float()
        residual = z - (basis @ coefficients[..., None])[..., 0]
        scale = 1.5 * (weight * residual.abs()).sum(1, keepdim=True) / weight.sum(1, keepdim=True)
        weight = weight / (1.0 + (residual / (2.0 * scale + 1e-6)) ** 2)  # Cauchy
    # A smooth surface is near its points: what moves further than half the disc was no neighbourhood of one
    # sheet.
    return (coefficients[:, 0].clamp(-0.5, 0.5) * radius).numpy()


def _unoccluded(cloud: torch.Tensor, camera: Camera, spacing: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Whether a camera sees each point [P] bool, by a z-buffer of cells some points wide, and unit
    directions to it."""
    uv_px, z = project(cloud, camera)
    cell = max(4.0, 4.0 * spacing * float(camera.K[0, 0]) / max(float(z.median()), NEAR_M))
    columns, rows = int(camera.width / cell) + 1, int(camera.height / cell) + 1
    inside = (z > NEAR_M) & (uv_px >= 0).all(dim=1)
    inside &= (uv_px[:, 0] < camera.width) & (uv_px[:, 1] < camera.height)
    place = torch.where(inside, (uv_px[:, 1] / cell).long() * columns + (uv_px[:, 0] / cell).long(), 0)
    nearest = torch.full((rows * columns,), torch.inf)
    nearest.scatter_reduce_(0, place[inside], z[inside], "amin")
    towards = torch.from_numpy(camera.centre_world).float() - cloud
    towards = towards / torch.linalg.vector_norm(towards, dim=1, keepdim=True).clamp(min=1e-12)
    return inside & (z <= nearest[place] + 6.0 * spacing), towards


def _thin(points: Floats, hints: Floats | None, cell: float) -> tuple[Floats, Floats | None]:
    """Points averaged over cubes, with their hints; as they are where the cubes are about as small as the
    spacing."""
    if cell < 1.2 * _mean_spacing(points):
        return points, hints
    _, group, counts = np.unique(_cubes(points, cell), return_inverse=True, return_counts=True)
    means = [
        None
        if values is None
        else np.stack([np.bincount(group, values[:, axis]) / counts for axis in range(3)], axis=1)
        for values in (points, hints)
    ]
    return means[0].astype(np.float32), None if means[1] is None else means[1].astype(np.float32)  # type: ignore[union-attr]


def _one_a_cube(points: Floats, cell: float) -> Floats:
    """The first point of every occupied cube."""
    _, first = np.unique(_cubes(points, cell), return_index=True)
    return points[np.sort(first)]


def _cubes(points: Floats, cell: float) -> NDArray[np.int64]:
    """Number of the cube that each point lies in."""
    lattice = np.floor((points - points.min(axis=0)) / cell).astype(np.int64)
    sides = lattice.max(axis=0) + 1
    return (lattice[:, 0] * sides[1] + lattice[:, 1]) * sides[2] + lattice[:, 2]


def _mean_spacing(points: Floats) -> float:
    """Side of the square that a point stands for, from the 8th neighbours of a sample."""
    neighbours = min(_OUTLIER_NEIGHBOURS + 1, len(points))
    sample = points[:: max(1, len(points) // 5_000)]
    distances, _ = cKDTree(points).query(sample, k=[neighbours], workers=-1)
    return max(float(np.median(distances)) * math.sqrt(math.pi / neighbours), 1e-12)


def _nearest_footprint(points: Floats, cameras: Sequence[Camera]) -> float:
    """World size of a pixel on the subject, in the nearer views (20th percentile over views of the median
    depth)."""
    sizes = []
    sample = torch.from_numpy(points[:: max(1, len(points) // 5_000)])
    for camera in cameras:
        _, z = project(sample, camera)
        if (z > NEAR_M).any():
            sizes.append(float(z[z > NEAR_M].median()) / float(camera.K[0, 0]))
    if not sizes:
        raise PlanError("No camera has the cloud before it; are poses and cloud in the same coordinates?")
    return float(np.percentile(sizes, 20))
