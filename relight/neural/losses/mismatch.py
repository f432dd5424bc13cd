"""The mismatch of two pictures: Delta(a, b) = perceptual(a, b) + beta * L1(pool(a), pool(b)).

Sevastopolsky et al. 2020, section 3.3: the perceptual term asks for detail, the L1 of averages over 4 x 4
pixels for colour; an L1 of the pixels themselves would blur. beta = 2500 brings the two to one range.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

BETA = 2500.0
POOL_PX = 4

Perceptual = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]
"""(picture, reference), both [1, 3, H, W] display values, to a number."""


def pooled_l1(first: torch.Tensor, second: torch.Tensor, kernel: int = POOL_PX) -> torch.Tensor:
    """Mean absolute deviation of averages over kernel x kernel pixels; an uneven edge is left out."""
    return torch.nn.functional.avg_pool2d(first - second, kernel).abs().mean()


@dataclass(frozen=True)
class Mismatch:
    """Delta.

    Attributes:
        perceptual: The term for detail.
        beta: Weight of the term for colour.
    """

    perceptual: Perceptual
    beta: float = BETA

    def __call__(self, picture: torch.Tensor, reference: torch.Tensor) -> torch.Tensor:
        """A number, of [1, 3, H, W] display values."""
        return self.perceptual(picture, reference) + self.beta * pooled_l1(picture, reference)
