"""Textures of a face: sampled from pictures through a position map, halved, mirrored, and their median.

The paper's I ⊙ Posmap (Sevastopolsky et al. 2020, section 3.4) is `sample_texture`, T_F is `median_texture`,
T_A begins as `half_texture` of it, and [T_A, flip(T_A)] is `whole_texture`. All are plain torch: gradients
flow through the pictures and through T_A. Textures are [C, 256, 256], where they are known [256, 256].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch


@dataclass(frozen=True, eq=False)
class PositionMap:
    """Where each texel of the face is in one picture.

    Attributes:
        uv_px: [256, 256, 2] float32, pixels of the picture, centres at 0.5; may lie outside of it.
        cosine: [256, 256] float32, between normal and direction to the camera; 0 where the picture does not
            show the texel.
    """

    uv_px: torch.Tensor
    cosine: torch.Tensor

    @property
    def visible(self) -> torch.Tensor:
        """[256, 256] bool, where the picture shows the texel."""
        return self.cosine > 0


def sample_texture(
    image: torch.Tensor, position_map: PositionMap, least_cosine: float = 0.2
) -> tuple[torch.Tensor, torch.Tensor]:
    """I ⊙ Posmap: a picture's face brought into the texture.

    Args:
        image: [C, H, W]; gradients flow to it.
        position_map: Of the picture.
        least_cosine: Where the face is seen at a more grazing angle the texture is not defined.

    Returns:
        [C, 256, 256] bilinear samples, 0 where not defined; [256, 256] float32, 1 where defined.
    """
    height, width = image.shape[1:]
    uv_px = position_map.uv_px.to(image)
    inside = (uv_px >= 0).all(dim=-1) & (uv_px[..., 0] <= width) & (uv_px[..., 1] <= height)
    defined = (inside & (position_map.cosine.to(image) > least_cosine)).to(image)
    grid = torch.where(inside[..., None], uv_px / uv_px.new_tensor([width, height]) * 2.0 - 1.0, 0.0)
    sampled = torch.nn.functional.grid_sample(
        image[None], grid[None], mode="bilinear", padding_mode="border", align_corners=False
    )[0]
    return sampled * defined, defined


def median_texture(
    textures: Sequence[torch.Tensor], defined: Sequence[torch.Tensor]
) -> tuple[torch.Tensor, torch.Tensor]:
    """T_F: the median of each texel over the pictures that define it.

    Returns:
        [C, 256, 256], 0 where none does; [256, 256] float32, by how many pictures a texel is defined.

    Raises:
        ValueError: There is no texture.
    """
    if not textures:
        raise ValueError("a median needs at least one texture")
    stack = torch.stack(list(textures))
    known = torch.stack(list(defined))[:, None] > 0.5
    median = torch.where(known, stack, torch.nan).nanmedian(dim=0).values
    return median.nan_to_num(0.0), known[:, 0].to(stack).sum(dim=0)


def half_texture(texture: torch.Tensor, defined: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """The left half and the flipped right half averaged where both are defined, else the one that is.

    Args:
        texture: [C, 256, 256].
        defined: [256, 256], how far each texel is (a weight, or 0 and 1).

    Returns:
        [C, 256, 128], 0 where neither is; [256, 128] float32 sum of the two weights.
    """
    middle = texture.shape[-1] // 2
    left, right = texture[..., :middle], texture.flip(-1)[..., :middle]
    weight_left, weight_right = defined[..., :middle], defined.flip(-1)[..., :middle]
    total = weight_left + weight_right
    return (left * weight_left + right * weight_right) / total.clamp(min=1e-6), total


def whole_texture(half: torch.Tensor) -> torch.Tensor:
    """[T_A, flip(T_A)]: [..., 128] to [..., 256]."""
    return torch.cat([half, half.flip(-1)], dim=-1)
