"""Values for the points that the light did not reach, from those that it did.

Behind the ears, under the chin and on the crown no flash frame says anything. Left at zero such points
would be black under every new light; here they take the weighted mean of the nearest points that are known,
and the two are blended by how much the point itself has seen.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import cKDTree

_NEIGHBOURS = 24


def infill(
    points: torch.Tensor, values: torch.Tensor, information: torch.Tensor, *, known: float, nearest: float
) -> torch.Tensor:
    """Fills values where little is known.

    Args:
        points: [P, 3].
        values: [P, C].
        information: [P] >= 0, how much each value rests on.
        known: Information above which a point helps others; well above it (twice) it needs no help itself.
        nearest: Distance below which neighbours count alike, in the unit of the points: their spacing.

    Returns:
        [P, C]; `values` where nothing is known anywhere.
    """
    good = (information > known).nonzero()[:, 0]
    poor = (information < 2.0 * known).nonzero()[:, 0]
    if not len(good) or not len(poor):
        return values
    tree = cKDTree(points[good].cpu().numpy())
    neighbours = min(_NEIGHBOURS, len(good))
    distances, ids = tree.query(points[poor].cpu().numpy(), k=list(range(1, neighbours + 1)), workers=-1)
    squared = torch.from_numpy(np.square(distances + nearest)).to(values)
    nearby = good[torch.from_numpy(ids).to(good.device)]
    weight = information[nearby].clamp(max=8.0 * known) / squared
    weight = weight / weight.sum(dim=1, keepdim=True)
    borrowed = (weight[..., None] * values[nearby]).sum(dim=1)
    share = (information[poor] / known).clamp(max=2.0) ** 2
    share = (share / (share + 1.0))[:, None]
    filled = values.clone()
    filled[poor] = share * values[poor] + (1.0 - share) * borrowed
    return filled
