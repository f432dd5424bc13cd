"""All that the paper's fit learns: network, descriptors, the lights' colours, and the half-texture T_A."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import nn

from relight.neural.gated_unet import GatedUNet
from relight.neural.paper.config import DESCRIPTOR_LENGTH, WIDTHS, PaperConfig
from relight.neural.paper.heads import CHANNELS, NeuralMaps, neural_maps
from relight.neural.precision import products_in
from relight.neural.raw_images import raw_images

LEVELS = len(WIDTHS)
"""T + 1: raw images of a view."""

_FIRST_DESCRIPTOR = 0.5
_GAIN = 2.0  # gates halve their features: with it these neither fade nor grow from layer to layer
_FLAT = 0.1  # of the last layer, so that the first pictures are nearly flat


class PaperModel(nn.Module):
    """Network phi, descriptors D, C_room, C_flash and T_A (Sevastopolsky et al. 2020, section 3)."""

    def __init__(
        self,
        points: int,
        c_room: torch.Tensor,
        c_flash: torch.Tensor,
        half_texture: torch.Tensor | None,
        generator: torch.Generator,
    ) -> None:
        """A random network, from the generator alone, and descriptors that are all alike.

        Args:
            points: How many.
            c_room: [3] to begin with, above 0.
            c_flash: [3] to begin with, above 0.
            half_texture: [3, 256, 128] display values to begin with; None = no face is known.
            generator: Of chance, on the CPU.
        """
        super().__init__()
        self.network = rendering_network(generator)
        # All alike: where there are points can be seen from the first step, and no noise has to be unlearned.
        self.descriptors = nn.Parameter(torch.full((points, DESCRIPTOR_LENGTH), _FIRST_DESCRIPTOR))
        # Logarithms: a colour of a light is positive, and its range is not known beforehand.
        self.log_c_room = nn.Parameter(c_room.detach().cpu().float().log())
        self.log_c_flash = nn.Parameter(c_flash.detach().cpu().float().log())
        self.half_texture = (
            None if half_texture is None else nn.Parameter(half_texture.detach().cpu().clone())
        )

    @property
    def c_room(self) -> torch.Tensor:
        """[3], above 0."""
        return self.log_c_room.exp()

    @property
    def c_flash(self) -> torch.Tensor:
        """[3], above 0."""
        return self.log_c_flash.exp()

    def maps(self, ids: Sequence[torch.Tensor], precision: str) -> NeuralMaps:
        """Maps of a view whose sides are multiples of 16, from the ids of its points."""
        return rendered_maps(self.network, self.descriptors, ids, precision)

    def groups(self, config: PaperConfig) -> list[dict[str, object]]:
        """Parameters with their learning rates, for an optimiser."""
        groups: list[dict[str, object]] = [
            {"params": [*self.network.parameters(), self.descriptors], "lr": config.rate},
            {"params": [self.log_c_room], "lr": config.rate_room},
            {"params": [self.log_c_flash], "lr": config.rate_flash},
        ]
        if self.half_texture is not None:
            groups.append({"params": [self.half_texture], "lr": config.rate_texture})
        return groups


def rendering_network(generator: torch.Generator | None = None) -> GatedUNet:
    """The paper's network; its weights come from the generator, or are anything where they will be loaded."""
    network = GatedUNet([DESCRIPTOR_LENGTH] * LEVELS, CHANNELS, WIDTHS)
    if generator is not None:
        for name, parameter in network.named_parameters():
            if parameter.ndim == 4:
                gain = _FLAT if name.startswith("last") else _GAIN if ".conv." in name else 1.0
                nn.init.normal_(parameter, std=gain * parameter[0].numel() ** -0.5, generator=generator)
            elif not name.endswith("norm.weight"):  # that is 1
                nn.init.zeros_(parameter)
    return network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]


def rendered_maps(
    network: GatedUNet, descriptors: torch.Tensor, ids: Sequence[torch.Tensor], precision: str
) -> NeuralMaps:
    """Maps of a view from the ids of its points, whose sides are multiples of 16."""
    images = raw_images(descriptors, ids)
    with products_in(precision, descriptors.device):
        channels = network(images)
    return neural_maps(channels)
