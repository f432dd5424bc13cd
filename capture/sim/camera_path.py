"""A hand-held half circle around the head, as a person walks it with a phone: arc, sway, tremor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class CameraPath:
    """Where the phone is over time.

    Attributes:
        duration_s: time of the whole sweep.
        sweep_deg: azimuth goes from minus to plus half of this (0 = in front of the face, positive =
            subject's left).
        distance_m: mean distance from the head's centre; it wanders by about 8 %.
        elevation_deg: mean height of the camera above the head's centre, as an angle.
        sway: factor on the slow wandering of distance, height, aim and roll; 0 = an exact arc.
        tremor: factor on the shaking of the hands; 0 = a rail.
        target: [3] what it is pointed at, metres, world.
        seed: of sway and tremor.
    """

    duration_s: float = 16.0
    sweep_deg: float = 165.0
    distance_m: float = 0.58
    elevation_deg: float = 2.0
    sway: float = 1.0
    tremor: float = 1.0
    target: tuple[float, float, float] = (0.0, -0.035, 0.0)
    seed: int = 0

    def cam_from_world(self, time_s: float) -> np.ndarray:
        """[4, 4] pose at a time; before 0 and after the end the sweep stands still."""
        part = float(np.clip(time_s / self.duration_s, 0.0, 1.0))
        eased = part - 0.35 * np.sin(2 * np.pi * part) / (2 * np.pi)  # slow at both ends
        azimuth = np.radians(self.sweep_deg) * (eased - 0.5)
        sway = self.sway * self._wander(time_s, 0, (0.11, 0.23, 0.41))
        tremor = self.tremor * self._wander(time_s, 10, (1.1, 2.7, 5.3, 8.9))
        elevation = np.radians(self.elevation_deg + 2.5 * sway[0])
        distance = self.distance_m * (1.0 + 0.05 * sway[1])
        target = np.array(self.target) + 0.008 * sway[2:5] + 0.0012 * tremor[0:3]
        direction = np.array(
            [np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)]
        )
        centre = np.array(self.target) + distance * direction + 0.0015 * tremor[3:6]
        forward = target - centre
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 1.0, 0.0])
        right /= np.linalg.norm(right)
        roll = np.radians(1.5 * sway[5] + 0.15 * tremor[6])
        down = np.cross(forward, right)
        rotation = np.stack(
            [np.cos(roll) * right + np.sin(roll) * down, np.cos(roll) * down - np.sin(roll) * right, forward]
        )
        pose = np.eye(4)
        pose[:3, :3] = rotation
        pose[:3, 3] = -rotation @ centre
        return pose

    def _wander(self, time_s: float, stream: int, rates_hz: tuple[float, ...]) -> np.ndarray:
        """Seven smooth random signals of about unit size at a time."""
        rng = np.random.default_rng([self.seed, stream])
        phases = rng.uniform(0.0, 2 * np.pi, (len(rates_hz), 7))
        gains = 1.0 / np.arange(1, len(rates_hz) + 1)[:, None]
        waves = gains * np.sin(2 * np.pi * np.array(rates_hz)[:, None] * time_s + phases)
        return waves.sum(axis=0) / np.sqrt((gains**2).sum())
