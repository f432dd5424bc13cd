"""A smooth inverse response: ln(radiance) as a cubic spline of ln(stored value), zero at white.

In these coordinates every camera curve is gentle: a gamma is a straight line, sRGB bends from slope 1 to 2.4,
a log profile from 1 to its strength. The spline's knots lie evenly in the root of the stored value.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

Floats = NDArray[np.float64]

_INTERVALS = 20


class CurveBasis:
    """The functions that a curve is made of.

    Attributes:
        count: Q, how many.
        penalty: [Q, Q] c P c = integral of the square of the curve's second derivative by ln(stored).
    """

    def __init__(self, low: float) -> None:
        """Spans stored values from `low` to 1.

        Args:
            low: the least stored value that was measured, 0..1.
        """
        self._low = float(np.log(low))
        inner = 2.0 * np.log(np.linspace(np.sqrt(low), 1.0, _INTERVALS + 1))
        self._knots = np.concatenate([[inner[0]] * 3, inner, [inner[-1]] * 3])
        self.count = len(self._knots) - 4 - 1  # the last is 1 at white, where the curve is 0
        middles = np.concatenate([inner[:-1] + share * np.diff(inner) for share in (0.2113, 0.7887)])
        weights = np.concatenate([np.diff(inner) / 2] * 2)
        bend = self._design(middles, 2)
        self.penalty = bend.T @ (weights[:, None] * bend)

    def values(self, stored: Floats) -> Floats:
        """[n, Q] the functions at stored values; below the least measured one, straight on with slope 1."""
        at = np.log(np.maximum(stored, 1e-12))
        inside = np.clip(at, self._low, 0.0)
        return self._design(inside, 0)

    def below(self, stored: Floats) -> Floats:
        """[n] what is added to the curve below the least measured value: there radiance goes as stored."""
        return np.minimum(np.log(np.maximum(stored, 1e-12)) - self._low, 0.0)

    def slopes(self, stored: Floats) -> Floats:
        """[n, Q] derivatives by ln(stored)."""
        return self._design(np.clip(np.log(np.maximum(stored, 1e-12)), self._low, 0.0), 1)

    def inverse(self, curve: Floats, level: Floats) -> Floats:
        """[n] stored values, at most 1, at which a curve that never falls has these ln(radiance)."""
        grid = np.concatenate(
            [np.geomspace(1e-5, np.exp(self._low), 9)[:-1], np.exp(np.linspace(self._low, 0, 800))]
        )
        heights = np.maximum.accumulate(self.values(grid) @ curve + self.below(grid))
        return np.exp(np.interp(level, heights, np.log(grid)))

    def straight(self, slope: float) -> Floats:
        """[Q] the coefficients of a gamma curve."""
        knots = self._knots
        greville = (knots[1:-3] + knots[2:-2] + knots[3:-1]) / 3.0
        return np.asarray(slope * greville[:-1])

    def increments(self) -> Floats:
        """[Q, Q] matrix from coefficients to their steps; none negative = the curve never falls."""
        return np.eye(self.count, k=1) - np.eye(self.count)

    def _design(self, at: Floats, order: int) -> Floats:
        every = np.eye(self.count + 1)[:, : self.count]
        spline = BSpline(self._knots, every, 3)
        return np.asarray(spline(at, nu=order))
