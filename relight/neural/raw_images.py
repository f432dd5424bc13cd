"""Raw images S[0], ..., S[T]: the descriptors of a view's nearest points at several scales, in one lookup.

What `relight.raster.gather_descriptors` gives for one scale (Sevastopolsky et al. 2020, section 3.2), for all
of them at once: the gradient of a lookup is as large as all descriptors, and one costs a fifth of five.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch


def raw_images(descriptors: torch.Tensor, ids: Sequence[torch.Tensor]) -> list[torch.Tensor]:
    """The raw images of a view.

    Args:
        descriptors: [P, L]; gradients flow to those that are seen.
        ids: Of the levels of a `relight.raster.IdPyramid`, [H_t, W_t] int64, -1 where there is no point.

    Returns:
        [1, L, H_t, W_t] a level, zero (the null descriptor) where there is no point; channels last in memory.
    """
    flat = torch.cat([level.flatten() for level in ids])
    seen = (flat >= 0).nonzero()[:, 0]
    values = descriptors.index_select(0, flat[seen])
    pixels = descriptors.new_zeros(len(flat), descriptors.shape[1]).index_copy(0, seen, values)
    levels = pixels.split([level.numel() for level in ids])
    return [
        pixels.view(1, *level.shape, -1).permute(0, 3, 1, 2)
        for pixels, level in zip(levels, ids, strict=True)
    ]
