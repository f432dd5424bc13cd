"""The network of the refinement: a small gated U-Net that begins by changing nothing."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import nn

from relight.neural.gated_unet import GatedUNet
from relight.neural.refined.layers import CHANGES, FEATURES


class RefinedNetwork(nn.Module):
    """From features of a view and its points' descriptors at several scales to changes of its maps."""

    def __init__(self, descriptors: int, widths: Sequence[int]) -> None:
        """A network whose last layer is zero: it gives no change until it has learned one.

        Args:
            descriptors: Values of a point; 0 = none.
            widths: Features at each scale.
        """
        super().__init__()
        self.descriptors, self.widths, self.changes = descriptors, tuple(widths), CHANGES
        channels = [FEATURES + descriptors, *(descriptors for _ in widths[1:])]
        self.unet = GatedUNet(channels, CHANGES, widths, normalised=False)
        for parameter in self.unet.last.parameters():
            nn.init.zeros_(parameter)

    @property
    def scales(self) -> int:
        """How many raw images it takes."""
        return self.unet.scales

    @property
    def multiple(self) -> int:
        """Sides of an image are multiples of this."""
        return 1 << (self.unet.scales - 1)

    def forward(self, features: torch.Tensor, raw: Sequence[torch.Tensor]) -> torch.Tensor:
        """[CHANGES, H, W] of features [FEATURES, H, W] and raw images [1, L, H / 2^t, W / 2^t]."""
        finest = torch.cat([features[None], raw[0]], dim=1).contiguous(memory_format=torch.channels_last)
        return self.unet([finest, *raw[1:]])[0]
