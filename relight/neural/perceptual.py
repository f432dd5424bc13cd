"""How different two pictures look: by VGG-16 where its weights are given, else by bands of a Laplacian
pyramid.

Both take display values [1, 3, H, W] and weigh about as much as the paper's VGG(., .) beside 2500 times an L1
of pooled pictures (Sevastopolsky et al. 2020, section 3.3), whose range beta was chosen to equal.

Without weights: the picture's bands of detail (Burt and Adelson 1983) are compared by L1, each divided by the
local amplitude of the reference's band, as the eye divides by contrast (Laparra et al. 2016, "Perceptual
image quality assessment using a normalized Laplacian pyramid"); to that comes how much the structure of
luminance differs at three scales (Wang et al. 2003, "Multi-scale structural similarity", its
contrast-structure part). Both parts are finite with their gradients for constant, equal and black pictures.
"""

from __future__ import annotations

import torch
from torch import nn

from relight.neural.vgg import Vgg16

_MEAN, _SPREAD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet, as in torchvision's training
_EIGHT_BIT = 255.0 * 0.226
"""Activations of weights that were trained on pictures in units of their spread, in units of 8-bit codes, in
which VGG-16 was published and in which beta = 2500 balances it: a ReLU network scales with its input."""

BANDS = 5
_FLOOR = 0.05  # display values: amplitude of a band under which contrast counts no more
_STRUCTURE_SCALES = 3
_WINDOW_PX = 8
_STRUCTURE_FLOOR = 0.03**2  # C2 of SSIM, for a peak of 1
_LUMINANCE = (0.2126, 0.7152, 0.0722)
_SCALE = 250.0


class VggPerceptual(nn.Module):
    """Sum over layers of VGG-16 of the mean absolute difference of features (Johnson et al. 2016)."""

    def __init__(self, network: Vgg16) -> None:
        """A network that no longer learns."""
        super().__init__()
        self.network = network

    def forward(self, picture: torch.Tensor, reference: torch.Tensor) -> torch.Tensor:
        """A number; gradients flow to both pictures."""
        both = torch.cat([picture, reference])
        mean, spread = (both.new_tensor(values).view(1, 3, 1, 1) for values in (_MEAN, _SPREAD))
        total = picture.new_zeros(())
        for features in self.network((both - mean) / spread):
            first, second = features.float().chunk(2)
            total = total + (first - second).abs().mean()
        return _EIGHT_BIT * total


def laplacian_perceptual(picture: torch.Tensor, reference: torch.Tensor) -> torch.Tensor:
    """The weight-free mismatch of [1, 3, H, W]; gradients flow to both, but not through the normalisation."""
    both = torch.cat([picture, reference])
    detail = structure = picture.new_zeros(())
    for scale in range(BANDS):
        coarser = _halved(both)
        bands = both - _doubled(coarser, both)
        first, second = bands.chunk(2)
        amplitude = _blurred(second.detach().abs())
        detail = detail + ((first - second).abs() / (amplitude + _FLOOR)).mean()
        if scale < _STRUCTURE_SCALES:
            structure = structure + _structure_difference(bands)
        both = coarser
    return _SCALE * (detail / BANDS + structure / _STRUCTURE_SCALES)


def _structure_difference(bands: torch.Tensor) -> torch.Tensor:
    """1 - the mean contrast-structure similarity of the luminance of two bands [2, 3, H, W], in 0..2."""
    weights = bands.new_tensor(_LUMINANCE).view(1, 3, 1, 1)
    first, second = (bands * weights).sum(dim=1, keepdim=True).chunk(2)
    window = min(_WINDOW_PX, *bands.shape[2:])
    moments = torch.nn.functional.avg_pool2d(
        torch.cat([first * first, second * second, first * second]), window, max(1, window // 2)
    )
    power_1, power_2, product = moments.split(1)  # a band's mean is next to nothing
    return 1.0 - ((2.0 * product + _STRUCTURE_FLOOR) / (power_1 + power_2 + _STRUCTURE_FLOOR)).mean()


def _blurred(image: torch.Tensor) -> torch.Tensor:
    """[B, C, H, W] under the binomial 1 4 6 4 1 in both directions, edges repeated.

    Sums of shifted images: on a processor a quarter of the time of a convolution by channel.
    """
    x = torch.nn.functional.pad(image, (2, 2, 2, 2), mode="replicate")
    x = x[..., :-4, :] + x[..., 4:, :] + 4.0 * (x[..., 1:-3, :] + x[..., 3:-1, :]) + 6.0 * x[..., 2:-2, :]
    x = x[..., :-4] + x[..., 4:] + 4.0 * (x[..., 1:-3] + x[..., 3:-1]) + 6.0 * x[..., 2:-2]
    return x / 256.0


def _halved(image: torch.Tensor) -> torch.Tensor:
    """Every other pixel of the blurred image."""
    taps = image.new_tensor([1.0, 4.0, 6.0, 4.0, 1.0]) / 16.0
    kernel = torch.outer(taps, taps).expand(image.shape[1], 1, 5, 5)
    padded = torch.nn.functional.pad(image, (2, 2, 2, 2), mode="replicate")
    return torch.nn.functional.conv2d(padded, kernel, stride=2, groups=image.shape[1])


def _doubled(image: torch.Tensor, like: torch.Tensor) -> torch.Tensor:
    return torch.nn.functional.interpolate(image, like.shape[2:], mode="bilinear", align_corners=False)
