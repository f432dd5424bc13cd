"""VGG-16's convolutions (Simonyan and Zisserman 2014), for weights that a user has.

The layers bear torchvision's names (`features.N.weight`, `features.N.bias`), so that its checkpoint loads as
it is, or a safetensors file of the same names. Of a file only tensors are read, never code.
"""

from __future__ import annotations

import pickle
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import nn

from relight.errors import RefineError

# Channels of the convolutions, block by block; each block ends in a 2 x 2 maximum.
_BLOCKS = ((64, 64), (128, 128), (256, 256, 256), (512, 512, 512), (512, 512, 512))

LAYERS = ("relu1_2", "relu2_2", "relu3_3", "relu4_3")
"""Those of the perceptual loss of Johnson et al. 2016, which the paper measures with."""


class Vgg16(nn.Module):
    """The convolutions up to the last layer that is asked for."""

    def __init__(self, layers: Sequence[str] = LAYERS) -> None:
        """Random weights.

        Args:
            layers: Which to give, `relu<block>_<convolution>`.

        Raises:
            ValueError: There is no such layer.
        """
        super().__init__()
        places, modules = _architecture()
        if unknown := set(layers) - places.keys():
            raise ValueError(f"VGG-16 has no layer {sorted(unknown)[0]!r}")
        self._wanted = sorted(places[name] for name in layers)
        self.features = nn.Sequential(*modules[: self._wanted[-1] + 1])

    def forward(self, x: torch.Tensor) -> list[torch.Tensor]:
        """Features of the layers, shallowest first, of normalised pictures [B, 3, H, W]."""
        found = []
        for place, module in enumerate(self.features):
            x = module(x)
            if place in self._wanted:
                found.append(x)
        return found


def load_vgg16(path: Path, layers: Sequence[str] = LAYERS) -> Vgg16:
    """The network with the weights of a file, which no longer learns.

    Raises:
        RefineError: The file is not there, cannot be read, or holds other weights.
    """
    network = Vgg16(layers)
    named = _tensors(path)
    own = {name: named[name] for name in network.state_dict() if name in named}
    try:
        network.load_state_dict({name: values.float() for name, values in own.items()})
    except RuntimeError as error:
        wrong = str(error).splitlines()[-1].strip()
        raise RefineError(
            f"{path} does not hold the weights of VGG-16 as torchvision names them: {wrong}"
        ) from error
    if not all(values.isfinite().all() for values in network.state_dict().values()):
        raise RefineError(f"Weights in {path} are not finite; get the file again.")
    return network.eval().requires_grad_(False)


def _architecture() -> tuple[dict[str, int], list[nn.Module]]:
    """Where each activation is among the modules, and the modules, in torchvision's order."""
    places: dict[str, int] = {}
    modules: list[nn.Module] = []
    channels = 3
    for block, widths in enumerate(_BLOCKS, start=1):
        for number, width in enumerate(widths, start=1):
            modules += [nn.Conv2d(channels, width, 3, padding=1), nn.ReLU()]
            places[f"relu{block}_{number}"] = len(modules) - 1
            channels = width
        modules.append(nn.MaxPool2d(2))
    return places, modules


def _tensors(path: Path) -> Mapping[str, torch.Tensor]:
    if not path.is_file():
        raise RefineError(f"There is no file {path}; name one with VGG-16's weights, or leave --vgg out.")
    try:
        if path.suffix == ".safetensors":
            return load_file(path)
        content = torch.load(path, map_location="cpu", weights_only=True)
    except (SafetensorError, OSError, RuntimeError, EOFError, ValueError, pickle.UnpicklingError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise RefineError(f"{path} cannot be read as weights ({reason}); get the file again.") from error
    if not isinstance(content, Mapping) or not all(isinstance(v, torch.Tensor) for v in content.values()):
        raise RefineError(f"{path} holds no table of weights; save the network's state_dict.")
    return content
