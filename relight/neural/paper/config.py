"""What can be set of the preset `paper`; the usual values are the paper's, or chosen where it names none."""

from __future__ import annotations

from dataclasses import dataclass

from relight.errors import PlanError
from relight.neural.losses.mismatch import BETA
from relight.neural.precision import PRECISIONS

DESCRIPTOR_LENGTH = 8
"""L of the paper."""

WIDTHS = (16, 32, 64, 128, 256)
"""Of the network's features, by scale: those of neural point-based graphics; T = 4."""


@dataclass(frozen=True)
class PaperConfig:
    """Of the paper's fit.

    Attributes:
        steps: Of the optimiser.
        crop: Side of a patch, pixels; a multiple of 16.
        zoom_out: Least zoom; below 1.
        zoom_in: Most zoom.
        rate: Of Adam for the network and the descriptors.
        rate_room: For the logarithm of C_room.
        rate_flash: For the logarithm of C_flash.
        rate_texture: For the half-texture T_A.
        beta: Weight of the L1 of pooled pictures in Delta.
        weight_normal: alpha of the face's normals.
        weight_symmetry: alpha of the albedo's symmetry.
        weight_colour: alpha of the albedo's colour.
        weight_shading: alpha of the room shading's total variation.
        weight_mask: alpha of the mask.
        vgg: File with VGG-16's weights; empty = the weight-free perceptual term.
        precision: In which the networks compute: float32, or bfloat16 where the machine has it.
        validate_every: Steps from one look at the held-out frames to the next.
        baked_views: Frames from whose maps the points get their values in the end.
    """

    steps: int = 80_000
    crop: int = 512
    zoom_out: float = 0.5
    zoom_in: float = 2.0
    rate: float = 1e-3
    rate_room: float = 1e-3
    rate_flash: float = 1e-3
    rate_texture: float = 1e-3
    beta: float = BETA
    weight_normal: float = 0.1
    weight_symmetry: float = 0.02
    weight_colour: float = 100.0
    weight_shading: float = 50.0
    weight_mask: float = 1000.0
    vgg: str = ""
    precision: str = "float32"
    validate_every: int = 1000
    baked_views: int = 16

    def __post_init__(self) -> None:
        if self.crop < 16 or self.crop % 2 ** (len(WIDTHS) - 1):
            raise PlanError(f"crop is {self.crop}; a patch has a multiple of 16 pixels a side.")
        if self.precision not in PRECISIONS:
            raise PlanError(f"precision is {self.precision!r}; it is one of {', '.join(PRECISIONS)}.")
        if not 0.0 < self.zoom_out <= self.zoom_in:
            raise PlanError(
                f"zoom_out {self.zoom_out} and zoom_in {self.zoom_in} must be above 0, in this order."
            )
        if self.steps < 1 or self.validate_every < 1 or self.baked_views < 1:
            raise PlanError("steps, validate_every and baked_views are at least 1.")
