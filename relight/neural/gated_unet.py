"""The rendering network: a U-Net of gated convolutions that takes a raw image at every scale of its encoder.

The network of neural point-based graphics (Aliev et al. 2020, "Neural point-based graphics", after
Ronneberger et al. 2015) with gated convolutions (Yu et al. 2019, "Free-form image inpainting with gated
convolution"), as in Sevastopolsky et al. 2020, section 3.2. Scale t of the encoder works on H / 2^t x W / 2^t
pixels; the raw image S[t] is concatenated to its features. Going up, features are interpolated and convolved,
never deconvolved: deconvolution leaves a checker pattern.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import nn
from torch.nn.functional import avg_pool2d, interpolate, leaky_relu

_LEAK = 0.2


class GatedConv(nn.Module):
    """3 x 3 convolution whose features are multiplied by a gate in 0..1 of their own, then normalised.

    A gate learns where there is something to be said of: raw images are empty between points and off the
    subject (Yu et al. 2019, eq. 2). Of the activations that their equation leaves free, a leaky ReLU
    is the cheapest that lets every gradient through.
    """

    def __init__(self, channels_in: int, channels_out: int, *, normalised: bool) -> None:
        """Random weights; `normalised` adds a normalisation over the features of each pixel (Ba et al. 2016).

        In neural point-based graphics it is over a batch, but the statistics of a batch of one patch are not
        those of the next, nor of a whole view.
        """
        super().__init__()
        self.channels_out = channels_out
        # Features and gates in one convolution: half the passes over the input.
        self.conv = nn.Conv2d(channels_in, 2 * channels_out, 3, padding=1, padding_mode="zeros")
        self.norm = nn.LayerNorm(channels_out) if normalised else None

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """[B, channels_in, H, W] to [B, channels_out, H, W]."""
        features, gate = self.conv(x).split(self.channels_out, dim=1)
        gated = leaky_relu(features, _LEAK) * torch.sigmoid(gate)
        return gated if self.norm is None else self.norm(gated.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)


class GatedUNet(nn.Module):
    """From raw images at several scales to one image of as many channels as wanted.

    With the paper's 8 channels at 5 scales and the widths 16 to 256 it has 1.93 million parameters, as that
    of neural point-based graphics.
    """

    def __init__(
        self,
        channels_in: Sequence[int],
        channels_out: int,
        widths: Sequence[int],
        *,
        normalised: bool = True,
    ) -> None:
        """Random weights.

        Args:
            channels_in: Of each raw image, finest first; T + 1 of them.
            channels_out: Of the image that comes out, without a non-linearity.
            widths: Of the features at each scale, as many as raw images and each wider than its raw image.
            normalised: Whether gated convolutions are normalised.

        Raises:
            ValueError: `widths` are not as said.
        """
        super().__init__()
        if len(widths) != len(channels_in) or any(
            w <= c for w, c in zip(widths[1:], channels_in[1:], strict=False)
        ):
            raise ValueError(f"widths {tuple(widths)} do not fit raw images of {tuple(channels_in)} channels")
        self.start = GatedConv(channels_in[0], widths[0], normalised=normalised)
        self.down = nn.ModuleList(
            GatedConv(above, width - raw, normalised=normalised)
            for above, width, raw in zip(widths[:-1], widths[1:], channels_in[1:], strict=True)
        )
        self.up = nn.ModuleList(nn.Conv2d(below, width, 3, padding=1) for width, below in pairwise(widths))
        self.merge = nn.ModuleList(
            GatedConv(2 * width, width, normalised=normalised) for width in widths[:-1]
        )
        self.last = nn.Conv2d(widths[0], channels_out, 1)

    @property
    def scales(self) -> int:
        """How many raw images it takes."""
        return len(self.down) + 1

    def forward(self, raw_images: Sequence[torch.Tensor]) -> torch.Tensor:
        """[B, channels_out, H, W] of raw images [B, channels_in[t], H / 2^t, W / 2^t].

        H and W are multiples of 2^T.
        """
        features = [self.start(raw_images[0])]
        for down, raw in zip(self.down, raw_images[1:], strict=True):
            features.append(torch.cat([down(avg_pool2d(features[-1], 2)), raw], dim=1))
        x = features.pop()
        for up, merge in zip(reversed(self.up), reversed(self.merge), strict=True):
            x = up(interpolate(x, scale_factor=2.0, mode="bilinear", align_corners=False))
            x = merge(torch.cat([x, features.pop()], dim=1))
        return self.last(x)
