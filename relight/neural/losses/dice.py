"""The mask's loss: minus the logarithm of the Dice coefficient, the F1 score of soft masks.

Sudre et al. 2017, "Generalised Dice overlap"; Sevastopolsky et al. 2020, section 3.3. A tenth of a pixel is
added to numerator and denominator, so that two empty masks agree, and a mask where there should be none costs
something finite.
"""

from __future__ import annotations

import torch

_SMOOTH_PX = 0.1


def dice(mask: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
    """2 sum(m t) / (sum(m) + sum(t)), in 0..1, of masks [...] with values 0..1."""
    overlap = 2.0 * (mask * truth).sum() + _SMOOTH_PX
    return overlap / (mask.sum() + truth.sum() + _SMOOTH_PX)


def mask_loss(mask: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
    """-log of `dice`: 0 where the masks agree and are sharp."""
    return -torch.log(dice(mask, truth))
