"""One clock in terms of another, from round trips: host = offset + (1 + slope) · device.

A round trip tells that the device's clock showed `ticks` somewhere between two moments of the host's. The fit
is a straight line through the middles of the last minute or so, with weights that

- fade with age (`MEMORY_S`), because a crystal warms up and a ceramic resonator wanders;
- fall with the excess of a round trip over the quickest one: the quickest was hardly held up anywhere, a slow
  one may have been held up on either way (Cristian, "Probabilistic clock synchronization", Distributed
  Computing 3, 1989). The quickest is forgotten slowly, as lines get slower too.

What the middle cannot tell is how the quickest round trip divides into there and back: that error is the same
for every time, at most half that round trip, and is part of every sigma that is claimed. A sample whose two
moments exclude what the fit says is an outlier, and until another agrees every sigma is as large as that
contradiction; three in a row are a clock that has been set, and the fit begins again with them.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Weights fall to 1/e in this time.
MEMORY_S = 15.0
#: How fast a clock's rate may change, 1/s: a ceramic resonator of 30 ppm/K that warms by 1 K a minute.
WANDER_PER_S = 0.5e-6
#: What a clock's rate may be off by, before anything is known: ceramic resonators are good to 0.5 %.
RATE_SIGMA = 5e-3
#: How fast the quickest round trip is forgotten, in seconds per second.
QUICKEST_AGES = 2e-6
#: What no fit of user-space stamps is better than.
FLOOR_S = 2e-6
#: A sample that the fit misses by so many sigmas, beyond its own two moments, contradicts it.
CONTRADICTION_SIGMAS = 6.0
#: So many in a row are right, and the fit is wrong.
CONTRADICTIONS = 3
_WINDOW = 160
_WRAP = 1 << 64


@dataclass(frozen=True)
class _Sample:
    ticks: int
    middle_s: float
    half_s: float


class ClockFit:
    """A device's counter of ticks in seconds of the host's clock.

    Attributes:
        samples: How many round trips it has been given.
        outliers: How many of them contradicted the fit and were dropped.
        restarts: How often it began again because a clock had been set.
    """

    def __init__(self, device_hz: float) -> None:
        """Knows nothing yet.

        Args:
            device_hz: What the device says of its rate, ticks a second.

        Raises:
            ValueError: A rate that is none.
        """
        if not (math.isfinite(device_hz) and device_hz > 0):
            raise ValueError(f"device_hz is {device_hz}; a clock has a positive rate")
        self.device_hz = float(device_hz)
        self.samples = self.outliers = self.restarts = 0
        self._window: deque[_Sample] = deque(maxlen=_WINDOW)
        self._doubts: list[_Sample] = []
        self._doubt_s = 0.0
        self._quickest_s = math.inf
        # host - origin = x + offset + slope x, x in nominal seconds of the device since its origin
        self._origin = _Sample(0, 0.0, 0.0)
        self._line = np.zeros(2)
        self._covariance = np.diag([math.inf, RATE_SIGMA**2])
        self._residuals: NDArray[np.float64] = np.zeros(0)

    @property
    def ready(self) -> bool:
        """Whether it has been given anything."""
        return bool(self._window)

    @property
    def drift_ppm(self) -> float:
        """How much faster the device's clock runs than it says, parts per million of host time."""
        return (1 / (1 + float(self._line[1])) - 1) * 1e6

    @property
    def drift_sigma_ppm(self) -> float:
        """Standard deviation of `drift_ppm`."""
        return math.sqrt(float(self._covariance[1, 1])) * 1e6

    @property
    def residuals_s(self) -> NDArray[np.float64]:
        """[N] middles of the round trips in memory minus the fit, oldest first, seconds."""
        return self._residuals

    def add(self, ticks: int, host_before_s: float, host_after_s: float) -> bool:
        """Takes a round trip: the device's clock showed `ticks` between two moments of the host's.

        Args:
            ticks: 64 bits that may wrap.
            host_before_s: Certainly before it.
            host_after_s: Certainly after it.

        Returns:
            Whether it agreed with the fit; an outlier is dropped.

        Raises:
            ValueError: The second moment is before the first, or one is no time.
        """
        if not (math.isfinite(host_before_s) and math.isfinite(host_after_s)):
            raise ValueError(f"a round trip from {host_before_s} to {host_after_s} s is no time")
        if host_after_s < host_before_s:
            raise ValueError(f"a round trip ends {host_before_s - host_after_s:.6f} s before it begins")
        sample = _Sample(int(ticks), (host_before_s + host_after_s) / 2, (host_after_s - host_before_s) / 2)
        self.samples += 1
        if self._contradicts(sample):
            self._doubts.append(sample)
            if len(self._doubts) < CONTRADICTIONS:
                self.outliers += 1
                return False
            self.outliers -= CONTRADICTIONS - 1
            self.restarts += 1
            self._window.clear()
            self._quickest_s = math.inf
            self._window.extend(self._doubts[:-1])
        self._doubts.clear()
        self._doubt_s = 0.0
        self._remember(sample)
        self._fit()
        return True

    def host_s(self, ticks: int) -> tuple[float, float]:
        """When the device's clock shows `ticks`.

        Returns:
            (host clock in seconds, standard deviation of that), which grows with the distance to the samples.

        Raises:
            ValueError: No round trip has been added.
        """
        self._need_samples()
        x = self._since_origin(ticks)
        offset, slope = (float(value) for value in self._line)
        return self._origin.middle_s + x + offset + slope * x, math.hypot(
            self._sigma_of_fit(x), self._asymmetry_s(), self._doubt_s
        )

    def device(self, host_s: float) -> int:
        """What the device's clock shows then, to the nearest tick, modulo 2^64."""
        self._need_samples()
        offset, slope = (float(value) for value in self._line)
        x = (host_s - self._origin.middle_s - offset) / (1 + slope)
        return (self._origin.ticks + round(x * self.device_hz)) % _WRAP

    def report(self) -> dict[str, Any]:
        """Plain values for session.json."""
        known = self.ready
        return {
            "samples": self.samples,
            "outliers": self.outliers,
            "restarts": self.restarts,
            "drift_ppm": round(self.drift_ppm, 3) if known else None,
            "drift_sigma_ppm": round(self.drift_sigma_ppm, 3) if known else None,
            "residual_rms_s": float(np.sqrt(np.mean(self._residuals**2))) if known else None,
            "residual_max_s": float(np.max(np.abs(self._residuals))) if known else None,
            "quickest_round_trip_s": 2 * self._quickest_s if known else None,
            "sigma_s": self.host_s(self._origin.ticks)[1] if known else None,
        }

    def _need_samples(self) -> None:
        if not self.ready:
            raise ValueError("no round trip has been added; the device's clock is not known")

    def _since_origin(self, ticks: int) -> float:
        """Nominal seconds; exact however large the counter, and across its wrap."""
        return ((int(ticks) - self._origin.ticks + _WRAP // 2) % _WRAP - _WRAP // 2) / self.device_hz

    def _sigma_of_fit(self, x: float) -> float:
        """Standard deviation of the line at `x`, without what is the same for all times."""
        variance = self._covariance[0, 0] + 2 * x * self._covariance[0, 1] + x * x * self._covariance[1, 1]
        return math.hypot(math.sqrt(max(0.0, float(variance))), 0.5 * WANDER_PER_S * x * x)

    def _asymmetry_s(self) -> float:
        """Of the quickest round trip in memory nobody knows where in it the device looked at its clock."""
        return min(sample.half_s for sample in self._window) / math.sqrt(3)

    def _contradicts(self, sample: _Sample) -> bool:
        if not self.ready:
            return False
        said, _ = self.host_s(sample.ticks)
        sigma = max(self._sigma_of_fit(self._since_origin(sample.ticks)), FLOOR_S)
        beyond = abs(sample.middle_s - said) - sample.half_s
        if beyond <= CONTRADICTION_SIGMAS * sigma:
            return False
        self._doubt_s = max(self._doubt_s, beyond)
        return True

    def _remember(self, sample: _Sample) -> None:
        if self._window:
            self._quickest_s += QUICKEST_AGES * max(0.0, sample.middle_s - self._window[-1].middle_s)
        self._window.append(sample)
        latest = list(self._window)[-CONTRADICTIONS:]  # all of them after a new beginning
        self._quickest_s = min(self._quickest_s, *(each.half_s for each in latest))
        while self._window[0].middle_s < sample.middle_s - 5 * MEMORY_S:
            self._window.popleft()

    def _fit(self) -> None:
        """Weighted least squares over what is remembered; its covariance by the sandwich formula."""
        self._origin = self._window[-1]
        x = np.array([self._since_origin(sample.ticks) for sample in self._window])
        y = np.array([sample.middle_s - self._origin.middle_s for sample in self._window]) - x
        half = np.array([sample.half_s for sample in self._window])
        # What held up the one way or the other moves the middle by all of its half.
        excess = np.maximum(half - self._quickest_s, 0) ** 2
        fade = np.exp(np.minimum(x, 0) / MEMORY_S)
        design = np.stack([np.ones_like(x), x], axis=1)
        known = np.diag([0.0, RATE_SIGMA**-2])
        # The quickest of a few is not yet quick, and two points make any line perfect.
        few = math.hypot(max(FLOOR_S, 0.5 / self.device_hz), self._quickest_s / float(np.sum(fade)))
        freedom = math.sqrt(len(x) / max(len(x) - 2, 0.5))
        noise = few
        for _ in range(3):
            variance = noise**2 + excess
            weights = fade / variance
            normal = design.T @ (weights[:, None] * design) + known
            inverse = np.linalg.inv(normal)
            self._line = inverse @ (design.T @ (weights * y))
            residuals = y - design @ self._line
            noise = math.hypot(few, freedom * _spread(residuals, weights))
        meat = design.T @ ((weights * fade)[:, None] * design) + known
        # Residuals that hang together are no noise that averages out: the clock wanders, or the line changes.
        ratio = np.clip(_correlation(residuals, weights), 0, 0.95)
        misfit = max(1.0, float(np.sum(weights * residuals**2) / np.sum(fade)))
        self._covariance = inverse @ meat @ inverse * (1 + ratio) / (1 - ratio) * misfit
        self._residuals = residuals


def _spread(residuals: NDArray[np.float64], weights: NDArray[np.float64]) -> float:
    """Standard deviation of the better half of the weight, by the median of the absolute values."""
    order = np.argsort(np.abs(residuals))
    total = np.cumsum(weights[order])
    middle = int(np.searchsorted(total, total[-1] / 2))
    return 1.4826 * float(np.abs(residuals)[order][middle])


def _correlation(residuals: NDArray[np.float64], weights: NDArray[np.float64]) -> float:
    """Of each residual with the next one."""
    if len(residuals) < 8:
        return 0.0
    scaled = residuals * np.sqrt(weights)
    power = float(np.sum(scaled**2))
    return float(np.sum(scaled[1:] * scaled[:-1])) / power if power > 0 else 0.0
