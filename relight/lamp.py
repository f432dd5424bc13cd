"""How the flash shines, as a calibration knows it: where to, how narrowly, how strongly.

Without a calibration it shines the same in every direction, and its strength is the fit's to find.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from calib.calibration import Calibration
from relight.errors import PortraitError

_LEAST_COSINE = 0.05
"""To the side of a lamp the model says nothing any more, and a division by it would make noise of it."""


@dataclass(frozen=True, eq=False)
class Lamp:
    """A flash.

    Attributes:
        axis_cam: [3] unit, where it is strongest, camera axes.
        falloff: mu of cos(angle to the axis)^mu (Quéau et al. 2018); 0 = the same everywhere.
        strength: [3] radiance of a white surface that faces it at 1 m on its axis; None = not known.
    """

    axis_cam: NDArray[np.float64] = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    falloff: float = 0.0
    strength: NDArray[np.float64] | None = None

    def axis_world(self, cam_from_world: NDArray[np.float64]) -> NDArray[np.float64]:
        """[3] unit, where it shines when the camera has a pose [4, 4]."""
        axis: NDArray[np.float64] = cam_from_world[:3, :3].T @ self.axis_cam
        return axis


def lamp_of(calibration: Calibration) -> Lamp:
    """The flash of a calibration; what it does not know is as without one.

    The strength is that of radiance as it is read: through the colour matrix, where one is known.
    """

    def known(name: str) -> NDArray[np.float64]:
        value = calibration.value(name)
        assert value is not None  # these have fallbacks
        return value

    strength = calibration.value("flash_strength")
    if strength is not None:
        strength = known("colour") @ strength
        strength = strength if (strength > 0).all() else None
    return Lamp(known("flash_axis"), float(known("flash_falloff").item()), strength)


def beam_as_json(lamp: Lamp) -> dict[str, Any] | None:
    """The beam for a portrait's `info`; None where it is even."""
    if lamp.falloff == 0:
        return None
    return {"axis_cam": lamp.axis_cam.tolist(), "falloff": lamp.falloff}


def lamp_of_portrait(info: Mapping[str, Any]) -> Lamp:
    """The beam that a portrait was solved with; its strength is the portrait's own.

    Raises:
        PortraitError: it is no beam.
    """
    said = info.get("flash_beam")
    if said is None:
        return Lamp()
    try:
        axis, falloff = np.array(said["axis_cam"], dtype=np.float64), float(said["falloff"])
    except (KeyError, TypeError, ValueError) as cause:
        raise PortraitError(f"The portrait's flash_beam is {said!r}; fit it again.") from cause
    if axis.shape != (3,) or not np.isfinite(axis).all() or not 0 <= falloff < np.inf:
        raise PortraitError(f"The portrait's flash_beam is {said!r}; fit it again.")
    return Lamp(axis, falloff)


def beam(to_light: torch.Tensor, axis_world: torch.Tensor, falloff: float) -> torch.Tensor:
    """Share [...] of the strength on the axis that a flash sends to points: cos(angle to its axis)^mu.

    Args:
        to_light: [..., 3] unit, from the points to the flash.
        axis_world: [..., 3] unit, of the flash.
        falloff: mu.
    """
    return (-(to_light * axis_world).sum(dim=-1)).clamp(min=_LEAST_COSINE) ** falloff
