"""Linear radiance to display values, as perceptual terms compare them; differentiable everywhere.

Inside 0..1 it is the sRGB curve (IEC 61966-2-1), whose slope is at most 12.92. It goes on beyond both ends,
so that a picture that is too bright or negative still has a gradient that leads back.
"""

from __future__ import annotations

import torch

_KNEE = 0.0031308


def display_values(radiance: torch.Tensor) -> torch.Tensor:
    """Values by sRGB of linear radiance [...]; a straight line below 0, the power law above 1."""
    power = 1.055 * radiance.clamp(min=_KNEE) ** (1.0 / 2.4) - 0.055
    return torch.where(radiance <= _KNEE, 12.92 * radiance, power)
