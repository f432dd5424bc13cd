"""What can be set of the presets `fast` and `balanced`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from relight.errors import PlanError
from relight.neural.precision import PRECISIONS


@dataclass(frozen=True)
class RefinedConfig:
    """Settings of the refinement.

    Attributes:
        steps: Of Adam at most; it ends before when the held-out frames get no better.
        patch: Side of the square patches, pixels; a multiple of eight.
        rate: Of Adam for the network, falling to nothing by a cosine.
        descriptor_rate: Of Adam for the points' descriptors.
        descriptors: Learned values a point; 0 = none.
        widths: Features of the network at each scale.
        check_every: Steps between looks at the held-out frames.
        patience: Looks without gain after which it ends.
        precision: "float32" of the network's products, or "bfloat16" where the machine has instructions for
            it.
        exposures: Whether each frame has a small exposure and white-balance residual of its own.
    """

    steps: int = 200
    patch: int = 256
    rate: float = 2e-3
    descriptor_rate: float = 1e-2
    descriptors: int = 4
    widths: tuple[int, ...] = (16, 24, 32, 48)
    check_every: int = 50
    patience: int = 3
    precision: str = "float32"
    exposures: bool = True

    def __post_init__(self) -> None:
        if min(self.widths, default=0) <= self.descriptors:
            raise PlanError(
                f"widths are {self.widths}; each is more than the {self.descriptors} descriptors."
            )
        multiple = 1 << (len(self.widths) - 1)
        if self.patch < multiple or self.patch % multiple:
            raise PlanError(
                f"patch is {self.patch}; with {len(self.widths)} scales it is a multiple of {multiple}."
            )
        if self.precision not in PRECISIONS:
            raise PlanError(f"precision is {self.precision!r}; it is one of {', '.join(PRECISIONS)}.")
        if self.steps < 1 or self.check_every < 1 or self.patience < 1 or self.descriptors < 0:
            raise PlanError("steps, check_every and patience are at least 1, and descriptors at least 0.")
        if not (self.rate > 0 and self.descriptor_rate > 0):
            raise PlanError("rate and descriptor_rate are above 0.")


def fast_config(**settings: Any) -> RefinedConfig:
    """Of the preset `fast`."""
    return replace(RefinedConfig(precision="bfloat16"), **settings)


def balanced_config(**settings: Any) -> RefinedConfig:
    """Of the preset `balanced`: more steps of a wider network."""
    usual = RefinedConfig(
        steps=1200, widths=(24, 32, 48, 64), descriptors=8, check_every=250, precision="bfloat16"
    )
    return replace(usual, **settings)
