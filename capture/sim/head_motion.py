"""The sitter moves in the room: a chair that turns, a nod, a slow swaying. The bust stays one rigid piece.

The world of poses and truth is the head's: at rest it is the room's, and where the head moves a camera's
`cam_from_world` is cam_from_head = cam_from_room @ room_from_head, while the room moves behind it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

_NECK = np.array([0.0, -0.12, -0.02])  # what nods and sways turn about, metres
_NOD_PART = 0.01  # half of the time that the nod takes, over the recording's
_SWAY_HZ = (0.11, 0.23)
_KEY_STEP_DEG = 15.0  # of the chair, between which the room's shadows on the sitter are interpolated


@dataclass(frozen=True)
class HeadMotion:
    """How the sitter moves while being filmed; the default sits still.

    Attributes:
        turn_deg: of the chair about the vertical over the recording, from the subject's left to the right: to
            a camera that stands still it looks like one that walks so far around the head.
        nod_deg: the head tips forward by this in the middle of the recording, and stays.
        shift_m: [3] and moves by this along the room's axes.
        sway_deg: size of a slow turning about all axes.
        sway_m: size of a slow moving along all axes.
        seed: of the swaying.
    """

    turn_deg: float = 0.0
    nod_deg: float = 0.0
    shift_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sway_deg: float = 0.0
    sway_m: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        if not abs(self.turn_deg) <= 360 or not abs(self.nod_deg) <= 45 or not abs(self.sway_deg) <= 45:
            raise ValueError(
                f"turn_deg {self.turn_deg}, nod_deg {self.nod_deg} and sway_deg {self.sway_deg} must lie in"
                " 360, 45 and 45 degrees"
            )

    @property
    def still(self) -> bool:
        """Whether nothing moves."""
        moving = (self.turn_deg, self.nod_deg, *self.shift_m, self.sway_deg, self.sway_m)
        return not any(moving)

    def room_from_head(self, part: float) -> np.ndarray:
        """[4, 4] rigid, metres, at a part 0..1 of the recording."""
        after = float(np.clip((part - 0.5) / (2 * _NOD_PART) + 0.5, 0.0, 1.0))
        after = after * after * (3.0 - 2.0 * after)
        sway = self._sway(part)
        tip = Rotation.from_euler("x", after * self.nod_deg, degrees=True)
        tip = Rotation.from_rotvec(np.radians(self.sway_deg) * sway[:3]) * tip
        chair = np.eye(4)
        chair[:3, :3] = self.chair(self.turned_deg(part))
        moved = np.eye(4)
        moved[:3, :3] = tip.as_matrix()
        moved[:3, 3] = _NECK - moved[:3, :3] @ _NECK + after * np.array(self.shift_m) + self.sway_m * sway[3:]
        return moved @ chair

    def turned_deg(self, part: float) -> float:
        """Angle of the chair at a part of the recording."""
        return self.turn_deg * (0.5 - float(np.clip(part, 0.0, 1.0)))

    @staticmethod
    def chair(angle_deg: float) -> np.ndarray:
        """[3, 3] rotation room_from_head of a chair turned by an angle."""
        return np.asarray(Rotation.from_euler("y", angle_deg, degrees=True).as_matrix())

    def key_angles_deg(self) -> np.ndarray:
        """Angles of the chair for which the room's shadows are traced, rising; one when it does not turn."""
        half = 0.5 * abs(self.turn_deg)
        return np.linspace(-half, half, int(np.ceil(2 * half / _KEY_STEP_DEG)) + 1)

    def _sway(self, part: float) -> np.ndarray:
        """Six smooth signals of about unit size; a recording is taken to last 16 s."""
        rng = np.random.default_rng([self.seed, 23])
        phases = rng.uniform(0.0, 2 * np.pi, (len(_SWAY_HZ), 6))
        waves = np.sin(2 * np.pi * 16.0 * part * np.array(_SWAY_HZ)[:, None] + phases)
        return np.asarray(waves.sum(axis=0) / np.sqrt(len(_SWAY_HZ)))
