"""From radiance to the numbers in the file: noise, black level, conversion, drift, transfer, clipping."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from capture.transfer import to_display

_ADC_STEPS = 4095  # 12 bits
_BLACK_STEPS = 256


@dataclass(frozen=True)
class SensorConfig:
    """The sensor and what its automatics do wrong.

    Attributes:
        readout_s: time from the first row's start to the last row's; 0 = global shutter.
        exposure_s: exposure of each row.
        full_well_e: electrons at white; the shot noise of a signal x (0..1) is sqrt(x / full_well).
        read_noise_e: standard deviation of the dark signal, electrons.
        noise: switch of both noises.
        timestamp_jitter_s: standard deviation of the frames' start times (and stamps).
        dropped: probability that a frame is lost.
        exposure_drift: relative change of exposure from the beginning to the end of a recording.
        white_balance_drift: relative change of red against green, and the opposite of blue, over a recording.
        mains_hz: frequency of the room light's flicker, 100 or 120; 0 = daylight.
        flicker: modulation depth of the room light, 0 .. 1.
        transfer: curve of the stored values (see `capture.transfer`).
        seed: of noise, jitter and drops.
    """

    readout_s: float = 0.020
    exposure_s: float = 0.008
    full_well_e: float = 6000.0
    read_noise_e: float = 3.0
    noise: bool = True
    timestamp_jitter_s: float = 0.0004
    dropped: float = 0.0
    exposure_drift: float = 0.0
    white_balance_drift: float = 0.0
    mains_hz: float = 0.0
    flicker: float = 0.0
    transfer: str = "srgb"
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.exposure_s > 0 or self.readout_s < 0:
            raise ValueError(
                f"exposure_s {self.exposure_s} must be positive and readout_s {self.readout_s} not negative"
            )
        if not 0 <= self.flicker <= 1 or not 0 <= self.dropped < 1:
            raise ValueError(f"flicker {self.flicker} and dropped {self.dropped} must lie in 0..1")

    def row_flicker(self, start_s: float, rows: int) -> np.ndarray:
        """Mean level [rows] of the room's light over each row's exposure: 1 + depth * sine, integrated."""
        if self.mains_hz == 0 or self.flicker == 0:
            return np.ones(rows)
        begin = start_s + (np.arange(rows) + 0.5) / rows * self.readout_s
        omega = 2 * np.pi * self.mains_hz
        wave = (np.cos(omega * begin) - np.cos(omega * (begin + self.exposure_s))) / (omega * self.exposure_s)
        return 1.0 + self.flicker * wave

    def gains(self, part: float) -> np.ndarray:
        """[3] gain of the channels at a part 0..1 of the recording."""
        balance = self.white_balance_drift * part
        return (1.0 + self.exposure_drift * part) * np.array([1.0 + balance, 1.0, 1.0 - balance])

    def noise_sigma(self, radiance: np.ndarray) -> np.ndarray:
        """Standard deviation of the linear signal, shot and read noise together (without quantisation)."""
        return np.sqrt(
            np.clip(radiance, 0, None) / self.full_well_e + (self.read_noise_e / self.full_well_e) ** 2
        )

    def linear(self, radiance: np.ndarray, index: int) -> np.ndarray:
        """Noisy, converted, clipped linear signal [H, W, 3]; its noise depends on seed and index alone."""
        signal = radiance.astype(np.float32)
        if self.noise:
            rng = np.random.default_rng([self.seed, 3, index])
            signal = signal + self.noise_sigma(signal).astype(np.float32) * rng.standard_normal(
                signal.shape, dtype=np.float32
            )
        steps = np.round(signal * (_ADC_STEPS - _BLACK_STEPS) + _BLACK_STEPS)
        return (np.clip(steps, _BLACK_STEPS, _ADC_STEPS) - _BLACK_STEPS) / np.float32(
            _ADC_STEPS - _BLACK_STEPS
        )

    def develop(self, radiance: np.ndarray, index: int) -> np.ndarray:
        """The stored picture [H, W, 3] uint8 of a frame's radiance."""
        stored = to_display(self.linear(radiance, index), self.transfer)
        return np.round(255.0 * stored).astype(np.uint8)

    def encode(self, radiance: np.ndarray) -> np.ndarray:
        """The picture [H, W, 3] uint8 that a noise-free sensor would store."""
        return np.round(255.0 * to_display(np.clip(radiance, 0.0, 1.0), self.transfer)).astype(np.uint8)
