"""What a capture is asked to be."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

from capture.devices.camera import CameraProfile
from capture.devices.flash import LONGEST_ON_S, MOST_PULSES, SHORTEST_PERIOD_S

_ROUNDING = 1e-6  # of frames


@dataclass(frozen=True, kw_only=True)
class CaptureConfig:
    """Settings of a capture; the defaults are the usual one of twenty seconds.

    Attributes:
        duration_s: From the first frame that is recorded to the last.
        period_s: From one flash to the next, before `phase_step`.
        phase_step: Share of a frame period by which each flash begins later in its frame than the one before.
            A camera of 30 frames and a lamp of one flash a second are in step for minutes: all flashes would
            begin at the same row, most rows would never tell an edge, and the shutter could not be fitted.
            0 = the period is as it is.
        on_s: Length of a flash.
        level: Of the flash, 0 (exclusive) .. 1.
        profile: Of the camera.
        kept_rate_hz: Unlit frames that keep their picture, each second; lit ones all do.
        keep_all: Whether every frame keeps its picture.
        reserve_bytes: Free space on the disk at which the capture stops.
        restore: Whether the camera's controls are put back afterwards.
        calibration: calibration.json of camera and flash, that the session shall carry.
    """

    duration_s: float = 20.0
    period_s: float = 1.0
    phase_step: float = 0.382
    on_s: float = 0.1
    level: float = 1.0
    profile: CameraProfile = field(default_factory=CameraProfile)
    kept_rate_hz: float = 6.0
    keep_all: bool = False
    reserve_bytes: int = 300 << 20
    restore: bool = False
    calibration: Path | None = None

    def __post_init__(self) -> None:
        """Checks the numbers."""
        if not SHORTEST_PERIOD_S <= self.period_s <= 2.0:
            raise ValueError(
                f"period_s is {self.period_s}; it must be {SHORTEST_PERIOD_S} (three flashes a second) to 2 s"
            )
        if not 0 < self.on_s <= min(LONGEST_ON_S, 0.5 * self.period_s):
            raise ValueError(
                f"on_s is {self.on_s}; it must be positive, at most {LONGEST_ON_S} s and half of the period"
            )
        if not 0 <= self.phase_step < 1:
            raise ValueError(f"phase_step is {self.phase_step}; it must be 0 or more and below 1")
        if not 0 < self.level <= 1:
            raise ValueError(f"level is {self.level}; it must be above 0 and at most 1")
        if not 3 * self.period_s <= self.duration_s < math.inf:
            raise ValueError(
                f"duration_s is {self.duration_s}; three flashes, {3 * self.period_s:g} s, are the least"
            )
        if self.duration_s > MOST_PULSES * self.period_s:
            raise ValueError(
                f"duration_s is {self.duration_s}; {MOST_PULSES} flashes, {MOST_PULSES * self.period_s:g} s, "
                "are the most"
            )
        if not self.kept_rate_hz > 0 or not math.isfinite(self.kept_rate_hz):
            raise ValueError(f"kept_rate_hz is {self.kept_rate_hz}; it must be a positive number")

    def train_period_s(self, fps: float) -> float:
        """From flash to flash on a camera of so many frames a second: at most a frame period longer."""
        if self.phase_step == 0:
            return self.period_s
        whole = math.ceil(self.period_s * fps - self.phase_step - _ROUNDING)
        return (whole + self.phase_step) / fps
