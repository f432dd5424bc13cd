"""Thin-plate smoothing of a map of inverse depths, with creases and steps left where they are.

Minimises  sum w (x - d)^2 + stiffness sum g (second differences of x)^2  by conjugate gradients, g falling
with the second difference of the last solution (two or three reweightings). A plane seen in perspective is
linear in inverse depth, so planes of any slant cost nothing; where w is 0 the sheet spans the gap.
"""

from __future__ import annotations

import torch

_GRADUATION = 3.0


def smoothed(
    values: torch.Tensor,
    weight: torch.Tensor,
    stiffness: float,
    crease: float,
    iterations: int = 40,
    reweightings: int = 2,
) -> torch.Tensor:
    """[H, W] smooth map.

    Args:
        values: [H, W], in units in which `crease` is given.
        weight: [H, W], at least 0, about 1 where a value is as well known as usual.
        stiffness: Of the plate, in the same weights.
        crease: Second difference that counts half.
        iterations: Of the conjugate gradients, each time.
        reweightings: How often the creases are found.
    """
    solution = values
    for step in range(reweightings):
        # Graduated: single outliers look like creases at first, and would stay.
        width = crease * _GRADUATION ** (reweightings - 1 - step)
        plates = [_plate(second, width) for second in _second_differences(solution)]
        solution = _solved(values, weight, [stiffness * plate for plate in plates], solution, iterations)
    return solution


def _plate(second: torch.Tensor, crease: float) -> torch.Tensor:
    return 1.0 / (1.0 + (second / crease) ** 2) ** 2


def _second_differences(x: torch.Tensor) -> list[torch.Tensor]:
    """Along columns, rows and both mixed: [H, W-2], [H-2, W], [H-1, W-1]."""
    return [
        x[:, :-2] - 2.0 * x[:, 1:-1] + x[:, 2:],
        x[:-2] - 2.0 * x[1:-1] + x[2:],
        x[:-1, :-1] - x[:-1, 1:] - x[1:, :-1] + x[1:, 1:],
    ]


def _applied(x: torch.Tensor, weight: torch.Tensor, plates: list[torch.Tensor]) -> torch.Tensor:
    """The normal equations' matrix times x."""
    along, down, mixed = (p * s for p, s in zip(plates, _second_differences(x), strict=True))
    mixed = 2.0 * mixed
    result = weight * x
    result[:, :-2] += along
    result[:, 1:-1] -= 2.0 * along
    result[:, 2:] += along
    result[:-2] += down
    result[1:-1] -= 2.0 * down
    result[2:] += down
    result[:-1, :-1] += mixed
    result[:-1, 1:] -= mixed
    result[1:, :-1] -= mixed
    result[1:, 1:] += mixed
    return result


def _solved(
    values: torch.Tensor,
    weight: torch.Tensor,
    plates: list[torch.Tensor],
    start: torch.Tensor,
    iterations: int,
) -> torch.Tensor:
    diagonal = _diagonal(weight, plates)
    x = start.clone()
    residual = weight * values - _applied(x, weight, plates)
    z = residual / diagonal
    direction = z
    product = (residual.double() * z).sum()
    for _ in range(iterations):
        image = _applied(direction, weight, plates)
        length = (direction.double() * image).sum()
        if not float(length) > 0.0:
            break
        step = float(product / length)
        x = x + step * direction
        residual = residual - step * image
        z = residual / diagonal
        fresh = (residual.double() * z).sum()
        direction = z + float(fresh / product.clamp(min=1e-30)) * direction
        product = fresh
    return x


def _diagonal(weight: torch.Tensor, plates: list[torch.Tensor]) -> torch.Tensor:
    along, down, mixed = plates
    diagonal = weight + 1e-6
    diagonal[:, :-2] += along
    diagonal[:, 1:-1] += 4.0 * along
    diagonal[:, 2:] += along
    diagonal[:-2] += down
    diagonal[1:-1] += 4.0 * down
    diagonal[2:] += down
    for part in (diagonal[:-1, :-1], diagonal[:-1, 1:], diagonal[1:, :-1], diagonal[1:, 1:]):
        part += 2.0 * mixed
    return diagonal
