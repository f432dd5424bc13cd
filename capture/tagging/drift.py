"""Drift of exposure and white balance, measured on the frames without flash.

A camera that walks changes what it sees, so levels say little. But from one unlit frame to the next the
*median* block keeps its light whatever moves, unless exposure or gain change: those move all blocks by one
factor at once. The running sum of these medians is the exposure's course; its noise is a random walk of
known step.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

#: Changes below the first share of the light are passed over, beyond the second a frame is left out.
WARN_SHARE, FAIL_SHARE = 0.01, 0.03
# A slow drift must exceed its noise so far: a camera that pans to a brighter side looks like one.
_DRIFT_SIGMAS = 5.0
# Frames on each side of a suspected step: a switch takes one, an automatic exposure a few.
_STEP_REACHES = (1, 3, 6)
# A step must stand out of the noise of such differences by so much, and most blocks must take part in it.
_STEP_SIGMAS, _STEP_AGREEMENT = 6.0, 0.8
# Pairs of frames farther apart than this say nothing of exposure.
_LONGEST_GAP_S = 0.6


@dataclass(frozen=True)
class DriftStep:
    """A sudden change.

    Attributes:
        time_s: of the first frame after it.
        share: change of the light, +0.05 = 5 % more.
        channel: "exposure", "red/green" or "blue/green".
    """

    time_s: float
    share: float
    channel: str


@dataclass(frozen=True)
class Drift:
    """What changed over the unlit frames of a sequence.

    Attributes:
        exposure_share: change of exposure from the first to the last unlit frame, steps included.
        exposure_sigma: its standard deviation.
        balance_share: largest change of red/green and blue/green over the sequence; None for luma only.
        balance_sigma: its standard deviation.
        steps: sudden changes.
        affected: [K] bool, frames whose exposure or white balance is not that of most frames.
    """

    exposure_share: float
    exposure_sigma: float
    balance_share: float | None
    balance_sigma: float | None
    steps: tuple[DriftStep, ...]
    affected: NDArray[np.bool_]

    def warnings(self) -> list[str]:
        """Sentences for the user."""
        out = []
        for step in self.steps:
            out.append(
                f"The {_WORDS[step.channel]} jumps by {100 * step.share:+.1f} % at {step.time_s:.2f} s; "
                "lock exposure and white balance of the camera."
            )
        for name, share, sigma in (
            ("exposure", self.exposure_share, self.exposure_sigma),
            ("balance", self.balance_share, self.balance_sigma),
        ):
            if (
                share is not None
                and sigma is not None
                and abs(share) > max(WARN_SHARE, _DRIFT_SIGMAS * sigma)
                and not self.steps
            ):
                # Pictures alone cannot tell the two apart: only the camera knows its exposure.
                out.append(
                    f"The {_WORDS[name]} of the frames without flash changes slowly, by {100 * share:+.1f} % "
                    f"(± {100 * sigma:.1f} %) in all: as it does on a walk around a head that is lit from "
                    "one side, or when the camera is not locked; check that it was."
                )
        return out


_WORDS = {
    "exposure": "exposure",
    "balance": "white balance",
    "red/green": "white balance (red against green)",
    "blue/green": "white balance (blue against green)",
}


def measure_drift(
    pts_s: Floats, blocks: NDArray[np.float32], color: NDArray[np.float32] | None, unlit: NDArray[np.bool_]
) -> Drift:
    """Drift over the unlit frames.

    Args:
        pts_s: [K].
        blocks: [K, n, n] linear luma of blocks.
        color: [K, m, m, 3] linear RGB of blocks; None = luma only.
        unlit: [K] bool, frames that surely have no flash.
    """
    index = np.flatnonzero(unlit)
    affected = np.zeros(len(pts_s), bool)
    if len(index) < 2 * _STEP_REACHES[-1] + 2:
        return Drift(0.0, float("inf"), None, None, (), affected)
    log = np.log(blocks[index].reshape(len(index), -1))
    tracks = {"exposure": log}
    if color is not None:
        channels = np.log(np.maximum(color[index], 1e-4)).reshape(len(index), -1, 3)
        tracks["red/green"] = channels[..., 0] - channels[..., 1]
        tracks["blue/green"] = channels[..., 2] - channels[..., 1]
    steps: list[DriftStep] = []
    change: dict[str, tuple[float, float]] = {}
    for name, values in tracks.items():
        course, sigma = _course(pts_s[index], values)
        change[name] = (float(course[-1] - course[0]), sigma)
        at = _steps(course, values)
        steps += [DriftStep(float(pts_s[index[k]]), float(np.expm1(size)), name) for k, size in at]
        affected |= _off_level(len(pts_s), index, at)
    exposure, exposure_sigma = change["exposure"]
    balance = max((change[n] for n in change if n != "exposure"), key=lambda c: abs(c[0]), default=None)
    return Drift(
        exposure_share=float(np.expm1(exposure)),
        exposure_sigma=exposure_sigma,
        balance_share=None if balance is None else float(np.expm1(balance[0])),
        balance_sigma=None if balance is None else balance[1],
        steps=tuple(sorted(steps, key=lambda step: step.time_s)),
        affected=affected,
    )


def _course(time_s: Floats, values: Floats) -> tuple[Floats, float]:
    """Running sum of the median change, and the standard deviation of its end.

    Hands sway for a second at a time, so the sums over whole seconds are the independent draws.
    """
    change = np.median(np.diff(values, axis=0), axis=1)
    change[np.diff(time_s) > _LONGEST_GAP_S] = 0.0
    course = np.concatenate([[0.0], np.cumsum(change)])
    seconds = np.diff(np.interp(np.arange(time_s[0], time_s[-1] + 0.5, 1.0), time_s, course))
    if len(seconds) < 3:
        return course, float("inf")
    return course, float(np.std(seconds, ddof=1) * np.sqrt(len(seconds)) + 1e-4)


def _steps(course: Floats, values: Floats) -> list[tuple[int, float]]:
    """(first index after it, size) of each step of a course: fast ones and those that take a few frames."""
    found: list[tuple[int, float]] = []
    for reach in _STEP_REACHES:
        sums = np.concatenate([[0.0], np.cumsum(course)])
        k = np.arange(reach, len(course) - reach + 1)
        size = (sums[k + reach] - 2 * sums[k] + sums[k - reach]) / reach
        strength = np.abs(size - np.median(size))
        limit = max(_STEP_SIGMAS * 1.4826 * float(np.median(strength)), WARN_SHARE)
        while strength.size and strength.max() > limit:
            best = int(np.argmax(strength))
            at = int(k[best])
            here = slice(max(best - 2 * reach, 0), best + 2 * reach + 1)
            if all(abs(at - other) > 2 * _STEP_REACHES[-1] for other, _ in found) and _agree(
                values, at, reach, size[best]
            ):
                found.append((at, float(size[best])))
            strength[here] = 0
    return sorted(found)


def _agree(values: Floats, at: int, reach: int, size: float) -> bool:
    """Whether most blocks take part in a step: motion moves some up and some down."""
    change = np.median(values[at : at + reach], axis=0) - np.median(values[at - reach : at], axis=0)
    return float(np.mean(change * np.sign(size) > 0.3 * abs(size))) >= _STEP_AGREEMENT


def _off_level(count: int, index: NDArray[np.int_], steps: list[tuple[int, float]]) -> NDArray[np.bool_]:
    """[count] frames whose level, by the steps, differs from the longest level by more than may be."""
    off = np.zeros(count, bool)
    if not steps:
        return off
    borders = [0, *(int(index[at]) for at, _ in steps), count]
    level = np.concatenate([[0.0], np.cumsum([size for _, size in steps])])
    main = level[int(np.argmax(np.diff(borders)))]
    for part, value in enumerate(level):
        if abs(value - main) > FAIL_SHARE:
            off[borders[part] : borders[part + 1]] = True
    return off
