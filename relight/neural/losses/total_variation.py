"""Total variation: how much a map changes from pixel to pixel, by L1 (Sevastopolsky et al. 2020, section
3.3).

Of the room shading it asks for smoothness, so that fine detail goes into the albedo.
"""

from __future__ import annotations

import torch


def total_variation(image: torch.Tensor) -> torch.Tensor:
    """Mean |difference| of horizontal neighbours plus that of vertical ones, of [..., H, W].

    0 for a constant image, and for one without neighbours; the subgradient of |0| is 0.
    """
    rows, columns = image.diff(dim=-2).abs(), image.diff(dim=-1).abs()
    return sum((part.mean() for part in (rows, columns) if part.numel()), start=image.new_zeros(()))
