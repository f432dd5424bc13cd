"""When the flash is on, and how much of it each row of a rolling-shutter frame catches.

The lamp is switched as Open Camera's "flash while recording" does: a timer of fixed DELAY fires every period
or a little later, the torch goes on, and off again after a sleep. Its light rises and falls in a few
milliseconds and droops as the LED warms. Row r of H, of a frame that starts at s, exposes during [s + r/H *
readout, the same + exposure].
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

FULLY_LIT = 0.98  # of the lamp's lowest level within the pulse: every row at least
UNLIT = 0.02  # every row at most


@dataclass(frozen=True)
class LampConfig:
    """The lamp and its timer.

    Attributes:
        first_s: when the first pulse begins.
        period_s: delay from one start to the next.
        wander_s: each delay is longer by a random 0..this (timers of fixed delay only ever come late).
        on_s: length of a pulse.
        on_jitter_s: standard deviation of that length.
        rise_s: time from dark to full.
        fall_s: time from full to dark.
        droop: share of light lost from the beginning to the end of a pulse.
        missed: probability that a pulse does not happen; 1 = the lamp never lights.
        always_on: the lamp burns from before the recording to after it.
        seed: of wander, jitter and misses.
    """

    first_s: float = 0.3
    period_s: float = 1.0
    wander_s: float = 0.012
    on_s: float = 0.1
    on_jitter_s: float = 0.004
    rise_s: float = 0.0015
    fall_s: float = 0.001
    droop: float = 0.01
    missed: float = 0.0
    always_on: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.rise_s > 0 or not self.fall_s > 0:
            raise ValueError(f"rise_s {self.rise_s} and fall_s {self.fall_s} must be positive seconds")
        if not self.on_s > self.rise_s + 5 * self.on_jitter_s:
            raise ValueError(f"on_s {self.on_s} must exceed rise_s + 5 on_jitter_s; lengthen the pulse")
        if not self.period_s > self.on_s + self.fall_s + 5 * self.on_jitter_s:
            raise ValueError(
                f"period_s {self.period_s} must exceed the pulse of {self.on_s} s; lengthen the period"
            )


@dataclass(frozen=True)
class Pulse:
    """One pulse: the light begins to rise at `on_s` and to fall at `off_s` (seconds of the recording)."""

    on_s: float
    off_s: float


@dataclass(frozen=True, eq=False)
class PulseTrain:
    """All pulses of a recording and their light over time, piecewise linear."""

    config: LampConfig
    pulses: tuple[Pulse, ...]

    @classmethod
    def schedule(cls, config: LampConfig, duration_s: float) -> PulseTrain:
        """The pulses that begin before `duration_s`."""
        if config.always_on:
            return cls(replace(config, droop=0.0), (Pulse(-1.0, duration_s + 1.0),))
        rng = np.random.default_rng([config.seed, 77])
        pulses, at = [], config.first_s
        while at < duration_s:
            length = config.on_s + config.on_jitter_s * float(np.clip(rng.normal(), -4, 4))
            if rng.random() >= config.missed:
                pulses.append(Pulse(at, at + length))
            at += config.period_s + config.wander_s * float(rng.random())
        return cls(config, tuple(pulses))

    def _knots(self) -> tuple[np.ndarray, np.ndarray]:
        c = self.config
        times = [t for p in self.pulses for t in (p.on_s, p.on_s + c.rise_s, p.off_s, p.off_s + c.fall_s)]
        levels = [0.0, 1.0, 1.0 - c.droop, 0.0] * len(self.pulses)
        return np.array([-1e9, *times, 1e9]), np.array([0.0, *levels, 0.0])

    def level(self, time_s: np.ndarray) -> np.ndarray:
        """Light of the lamp, 0 .. 1, at any times."""
        return np.interp(time_s, *self._knots())

    def light_until(self, time_s: np.ndarray) -> np.ndarray:
        """Integral of the light from the beginning to each time, seconds of full light; exact."""
        knots, levels = self._knots()
        before = np.concatenate([[0.0], np.cumsum(0.5 * np.diff(knots) * (levels[1:] + levels[:-1]))])
        piece = np.clip(np.searchsorted(knots, time_s, side="right") - 1, 0, len(knots) - 2)
        since = time_s - knots[piece]
        slope = np.diff(levels)[piece] / np.diff(knots)[piece]
        return before[piece] + since * (levels[piece] + 0.5 * slope * since)

    def lit_fraction(self, start_s: float, rows: int, readout_s: float, exposure_s: float) -> np.ndarray:
        """Mean light [rows] that each row of a frame catches, relative to a lamp that is on all along."""
        begin = start_s + (np.arange(rows) + 0.5) / rows * readout_s
        return (self.light_until(begin + exposure_s) - self.light_until(begin)) / exposure_s

    def flag(self, fraction: np.ndarray) -> int | None:
        """F of a frame with this lit fraction [rows]: 1 = fully lit, 0 = not at all, None = in part."""
        if fraction.min() >= FULLY_LIT * (1.0 - self.config.droop):
            return 1
        return 0 if fraction.max() <= UNLIT else None
