"""What can be set about the masks, and what finding them gives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class MaskConfig:
    """Settings of `find_masks`.

    Attributes:
        working_px: Longest side of the small pictures in which the evidence is gathered.
        rounds: How often masks and cloud are made consistent with each other, at least 1.
        flash: Whether the ratio of lit to unlit frames is evidence.
        parallax: Whether the match with neighbouring frames, at the subject's depth and behind it, is
            evidence.
        hull: Whether the masks of the other frames are evidence, by their visual hull.
        outside_share: Of the frames that have a point of the cloud in the picture, the share with the point
            off the mask from which on it is not the subject's.
        u2net: Checkpoint of a U2-Net (published state dict, .pth or .safetensors); empty = no network.
        tune_steps: Steps of tuning the network's weights for agreement between the views; 0 = none.
        tune_rate: Learning rate of these steps.
    """

    working_px: int = 192
    rounds: int = 2
    flash: bool = True
    parallax: bool = True
    hull: bool = True
    outside_share: float = 0.2
    u2net: str = ""
    tune_steps: int = 0
    tune_rate: float = 1e-5

    def __post_init__(self) -> None:
        """Checks the values.

        Raises:
            ValueError: out of range.
        """
        if self.working_px < 48:
            raise ValueError(f"working_px is {self.working_px}; below 48 a head has no outline")
        if self.rounds < 1:
            raise ValueError(f"rounds is {self.rounds}; there is at least one")
        if not 0.0 < self.outside_share <= 1.0:
            raise ValueError(f"outside_share is {self.outside_share}, not in (0, 1]")
        if self.tune_steps < 0 or not self.tune_rate > 0:
            raise ValueError("tune_steps must not be negative, and tune_rate positive")


@dataclass(frozen=True, eq=False)
class MaskResult:
    """What `find_masks` gives; the masks themselves are in the folder that it was told.

    Attributes:
        keep: [P] bool, the points of the cloud that are the subject in nearly all frames.
        report: Plain numbers and sentences: seconds, what was used, how far the evidence agrees.
        warnings: One sentence each.
    """

    keep: NDArray[np.bool_]
    report: dict[str, Any]
    warnings: tuple[str, ...]
