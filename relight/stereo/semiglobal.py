"""Semi-global regularisation of a cost volume (Hirschmueller 2008, "Stereo processing by semiglobal matching
and mutual information", eq. 13): the sum over straight paths of the least cost of reaching each label.

Where a window has no contrast its costs are flat, and labels follow those of the neighbours that know.
"""

from __future__ import annotations

import torch

_AXES = ((0, 1), (1, 0))
_DIAGONALS = ((1, 1), (1, -1))


def regularised(
    cost: torch.Tensor, step_penalty: float, jump_penalty: torch.Tensor, diagonals: bool = False
) -> torch.Tensor:
    """Costs [H, W, D] summed over 4 or 8 paths, divided by their number.

    Args:
        cost: [H, W, D], labels in order.
        step_penalty: Of neighbours one label apart.
        jump_penalty: [H, W], of neighbours further apart, at the pixel that is reached.
        diagonals: Whether to take 8 paths.
    """
    total = torch.zeros_like(cost)
    directions = _AXES + (_DIAGONALS if diagonals else ())
    for down, right in directions:
        for flip in (False, True):
            total += _along(cost, step_penalty, jump_penalty, down, right, flip)
    return total / (2 * len(directions))


def _along(
    cost: torch.Tensor, step: float, jump: torch.Tensor, down: int, right: int, flip: bool
) -> torch.Tensor:
    """Path costs in one direction: (down, right), or its opposite when flipped."""
    if down == 0:  # along rows: turn the picture, so that paths run down
        return _along(cost.transpose(0, 1), step, jump.T, 1, 0, flip).transpose(0, 1)
    if flip:
        cost, jump = cost.flip(0), jump.flip(0)
        right = -right
    path = torch.empty_like(cost, memory_format=torch.contiguous_format)
    path[0] = cost[0]
    width = cost.shape[1]
    none = torch.zeros_like(cost[0, :1])  # a path that enters at the side begins there
    for row in range(1, len(cost)):
        before = path[row - 1]
        if right == 1:
            before = torch.cat([none, before[: width - 1]])
        elif right == -1:
            before = torch.cat([before[1:], none])
        least = before.amin(dim=1, keepdim=True)
        best = torch.minimum(before, least + jump[row][:, None])
        best[:, 1:] = torch.minimum(best[:, 1:], before[:, :-1] + step)
        best[:, :-1] = torch.minimum(best[:, :-1], before[:, 1:] + step)
        path[row] = cost[row] + best - least
    return path.flip(0) if flip else path
