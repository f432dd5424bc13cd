"""What the light did not reach on one side of a face, taken from the other side.

Instead of the mean of the nearest known points (`relight.infill`) a point takes the values of the known
points about its mirror image: brows, lips and stubble are where they belong. The two sides are not of one
colour everywhere, so what is taken is brought to this side's level: the ratio of both sides' known values is
measured where both are known, and carried smoothly into the hole.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from relight.face.plane import Plane

_NEIGHBOURS = 8
_RATIO_NEIGHBOURS = 200
_FACING = 0.5  # cosine between a point's mirrored normal and that of what lies there
_FLOOR = 0.004  # as good as black
_RATIO_LIMIT = 2.0


@dataclass(frozen=True, eq=False)
class MirrorFill:
    """Values after filling.

    Attributes:
        values: [P, C]; as given where no mirror image helps.
        information: [P], raised to `worth` times what is known of the mirror image.
        filled: [P] bool, which points took something from the other side.
    """

    values: torch.Tensor
    information: torch.Tensor
    filled: torch.Tensor


def fill_from_mirror(
    points: torch.Tensor,
    normals_world: torch.Tensor,
    values: torch.Tensor,
    information: torch.Tensor,
    plane: Plane,
    *,
    known: float,
    reach: float,
    worth: float = 0.1,
) -> MirrorFill:
    """Fills values where little is known from the mirror image; `infill` does the rest afterwards.

    Args:
        points: [P, 3], world.
        normals_world: [P, 3] unit.
        values: [P, C] >= 0, such as albedo.
        information: [P] >= 0, how much each value rests on, as in `relight.infill`.
        plane: Of symmetry.
        known: Information above which a point helps others; twice that needs no help itself.
        reach: Distance from the mirror image within which points stand for it, world units: a few spacings
            and the asymmetry of a face, some 3 mm.
        worth: Information of a mirrored value as a share of that at the mirror image. A tenth makes `infill`
            take about as much from the neighbours, which is better than either alone.
    """
    filled = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    good = (information > known).nonzero()[:, 0]
    poor = (information < 2.0 * known).nonzero()[:, 0]
    if len(good) < _NEIGHBOURS or not len(poor):
        return MirrorFill(values, information, filled)
    at = points.cpu().double().numpy()
    facing = normals_world.cpu().double().numpy()
    known_values = values[good].cpu().double().numpy()
    strength = information[good].cpu().double().numpy()
    tree = cKDTree(at[good.cpu()])

    def mirrored(ids: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Values about the mirror images of points, and the information there; 0 where nothing is known."""
        images, turned = plane.reflect(at[ids]), plane.reflect_directions(facing[ids])
        distances, near = tree.query(images, k=_NEIGHBOURS, distance_upper_bound=reach, workers=1)
        found = np.isfinite(distances)
        near = np.where(found, near, 0)
        cosine = (turned[:, None] * facing[good.cpu()][near]).sum(axis=-1)
        weight = found * (cosine > _FACING) / (np.where(found, distances, 0.0) + 0.2 * reach) ** 2
        total = weight.sum(axis=1)
        share = weight / np.maximum(total, 1e-30)[:, None]
        taken = (share[..., None] * known_values[near]).sum(axis=1)
        return taken, (share * strength[near]).sum(axis=1) * (total > 0)

    poor_ids = poor.cpu().numpy()
    taken, info = mirrored(poor_ids)
    helped = info > known
    if not helped.any():
        return MirrorFill(values, information, filled)
    taken[helped] *= _levels(at, values, good.cpu().numpy(), mirrored, poor_ids[helped], known)
    places = torch.from_numpy(poor_ids[helped]).to(points.device)
    own = (information[places] / known).clamp(max=2.0) ** 2
    own = (own / (own + 1.0))[:, None]
    result, gained = values.clone(), information.clone()
    result[places] = own * values[places] + (1.0 - own) * torch.from_numpy(taken[helped]).to(values)
    gained[places] = torch.maximum(
        information[places], torch.from_numpy(worth * info[helped]).to(information)
    )
    filled[places] = True
    return MirrorFill(result, gained, filled)


def _levels(
    at: NDArray[np.float64],
    values: torch.Tensor,
    good: NDArray[np.int64],
    mirrored: Callable[[NDArray[np.int64]], tuple[NDArray[np.float64], NDArray[np.float64]]],
    places: NDArray[np.int64],
    known: float,
) -> NDArray[np.float64]:
    """Ratio [K, C] of this side to the other about places to fill, from points known on both sides."""
    sample = good[:: max(1, len(good) // 20_000)]
    other, info = mirrored(sample)
    both = info > known
    if both.sum() < 20:
        return np.ones((len(places), values.shape[1]))
    own = values[sample[both]].cpu().double().numpy()
    # A least squares near black may come out below it.
    own, other = np.maximum(own, 0.0), np.maximum(other, 0.0)
    logs = np.log((own + _FLOOR) / (other[both] + _FLOOR)).clip(-np.log(_RATIO_LIMIT), np.log(_RATIO_LIMIT))
    tree = cKDTree(at[sample[both]])
    count = min(_RATIO_NEIGHBOURS, int(both.sum()))
    _, near = tree.query(at[places], k=list(range(1, count + 1)), workers=1)
    return np.asarray(np.exp(np.median(logs[near], axis=1)))
