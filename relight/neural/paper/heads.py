"""The network's eight channels as maps: albedo, normals, room shading and mask, each non-linear."""

from __future__ import annotations

from dataclasses import dataclass

import torch

CHANNELS = 8

_SHORTEST = 1e-3  # of a normal before it is divided by its length: its gradient stays below 1000


@dataclass(frozen=True, eq=False)
class NeuralMaps:
    """Maps of a patch or view (Sevastopolsky et al. 2020, section 3.2).

    Attributes:
        albedo: [3, H, W] linear, 0..1.
        normals_world: [3, H, W] unit; shorter where the network gives next to nothing.
        shading: [1, H, W] room shading, 0..1.
        mask: [1, H, W] probability that a pixel is the subject's.
    """

    albedo: torch.Tensor
    normals_world: torch.Tensor
    shading: torch.Tensor
    mask: torch.Tensor


def neural_maps(channels: torch.Tensor) -> NeuralMaps:
    """Maps of the network's output [1, 8, H, W]: sigmoid, unit length, sigmoid, sigmoid."""
    albedo, normals, shading, mask = channels[0].float().split([3, 3, 1, 1])
    return NeuralMaps(
        albedo=torch.sigmoid(albedo),
        normals_world=unit(normals),
        shading=torch.sigmoid(shading),
        mask=torch.sigmoid(mask),
    )


def unit(vectors: torch.Tensor) -> torch.Tensor:
    """Vectors [3, ...] by their lengths; zero stays zero, with a finite gradient.

    Lengths err by 5e-7 from a length of one on, less beyond.
    """
    return vectors * torch.rsqrt((vectors * vectors).sum(dim=0, keepdim=True) + _SHORTEST**2)
