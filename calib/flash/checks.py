"""Whether boards can tell a flash, what they tell only weakly, and whether boards left out are predicted.

Boards that are all parallel at one distance tell the product of strength and distance only; such sets are
refused before anything is fitted. What remains weak is found from the covariance, by direction and not number
by number: nearer-and-weaker is a direction, and may be unknown when both of its ends look known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.errors import FlashGeometryError
from calib.flash.boards import LitBoard, error_covariance, light_slopes, relative_residuals, stacked
from calib.flash.fit import LightFit, fit_light
from calib.flash.model import AXIS, FALLOFF, LIGHT_NAMES, LOG_STRENGTH, POSITION

Floats = NDArray[np.float64]

#: Boards in places of their own that are needed.
FEWEST_POSES = 6
# Poses are different when turned or moved by this much (radians; share of the distance).
_TURNED, _MOVED = np.radians(5.0), 0.05
# All boards within this of each other are parallel; within this ratio, at one distance.
_PARALLEL, _ONE_DISTANCE = np.radians(10.0), 1.2
# What is weak: standard deviations from here on are named (metres, slope, falloff, relative, relative).
_WEAK = np.array([0.005, 0.005, 0.005, 0.1, 0.1, 0.4, 0.04, 0.1])
# What is no answer any more: share of the boards' distance, and of the strength.
_USELESS_PLACE, _USELESS_STRENGTH = 0.2, 0.3
_FOLDS = 8
_WORDS = {
    "x_m": "the flash's place to the right",
    "y_m": "its place downwards",
    "z_m": "its place forwards",
    "axis_x": "its axis to the right",
    "axis_y": "its axis downwards",
    "falloff": "its falloff",
    "log_strength": "its strength",
    "droop": "the droop",
}
_DEGREES = (180 / np.pi, "degrees")
_MM = (1e3, "mm")
_UNITS = {"x_m": _MM, "y_m": _MM, "z_m": _MM, "axis_x": _DEGREES, "axis_y": _DEGREES}
_UNITS |= {"falloff": (1.0, ""), "log_strength": (100.0, "%"), "droop": (100.0, "%")}
_NAMED_SHARE = 0.35  # of a direction's length: smaller parts are not named


@dataclass(frozen=True, eq=False)
class HeldOut:
    """How boards that were left out are predicted by the others.

    Attributes:
        rms: root mean square of measured over predicted light minus one, over all squares.
        expected: what it should be, by the claimed uncertainties.
        shape_rms: the same with each board's own mean taken out.
        boards: [V] mean of each board.
    """

    rms: float
    expected: float
    shape_rms: float
    boards: Floats

    @property
    def agrees(self) -> bool:
        """Whether it is nothing strange."""
        return self.rms < 1.5 * self.expected


def check_poses(boards: Sequence[LitBoard], refused: str) -> None:
    """Refuses boards that cannot tell a flash.

    Args:
        boards: all that were measured.
        refused: what became of the pairs, for the message.

    Raises:
        FlashGeometryError: too few poses, or all alike.
    """
    poses = distinct_poses(boards)
    count = len(set(poses.tolist()))
    if count < FEWEST_POSES:
        alike = f"; {len(boards) - count} show it where it was seen already" if len(boards) > count else ""
        raise FlashGeometryError(
            f"The light is known for {count} poses of the board, and at least {FEWEST_POSES} are needed"
            f"{alike} ({refused}). Take more: near and far, tilted to all sides."
        )
    normals = np.array([board.normal_cam for board in boards])
    mean = normals.mean(0) / np.linalg.norm(normals.mean(0))
    tilt = float(np.arccos(np.clip(normals @ mean, -1, 1)).max())
    distances = np.array([np.linalg.norm(board.points_cam, axis=1).mean() for board in boards])
    ratio = float(distances.max() / distances.min())
    if tilt < _PARALLEL and ratio < _ONE_DISTANCE:
        raise FlashGeometryError(
            f"All {count} poses are parallel (within {np.degrees(tilt):.1f} degrees) at one distance "
            f"({distances.min():.2f} to {distances.max():.2f} m): a near weak flash and a far strong one "
            f"look the same. Tilt the board by {np.degrees(2 * _PARALLEL):.0f} degrees and more to all "
            "sides, and take it to twice the distance."
        )


def check_fit(fit: LightFit, boards: Sequence[LitBoard]) -> None:
    """Refuses an answer that is none.

    Raises:
        FlashGeometryError: place or strength are not determined; the direction is named.
    """
    distance_m = float(np.median([np.linalg.norm(board.origin_cam) for board in boards]))
    values, vectors = np.linalg.eigh(fit.covariance[POSITION, POSITION])
    worst_m, direction = float(np.sqrt(max(values[-1], 0.0))), vectors[:, -1]
    strength = float(np.sqrt(fit.covariance[LOG_STRENGTH, LOG_STRENGTH]))
    if worst_m > _USELESS_PLACE * distance_m:
        raise FlashGeometryError(
            f"The flash's place is known only to {worst_m * 1e3:.0f} mm along "
            f"({', '.join(f'{part:.2f}' for part in direction)}) in camera axes, with boards at "
            f"{distance_m:.2f} m; add boards that are tilted more, nearer and farther, and to the sides."
        )
    if strength > _USELESS_STRENGTH:
        raise FlashGeometryError(
            f"The flash's strength is known only to {100 * strength:.0f} %: it cannot be told from its "
            "place; add boards nearer and farther."
        )


def distinct_poses(boards: Sequence[LitBoard]) -> NDArray[np.int64]:
    """[V] number of each board's pose; boards that stand where one stood before have its number."""
    firsts: list[LitBoard] = []
    numbers = []
    for board in boards:
        for number, first in enumerate(firsts):
            turned = np.arccos(np.clip(board.normal_cam @ first.normal_cam, -1, 1))
            moved = np.linalg.norm(board.origin_cam - first.origin_cam) / np.linalg.norm(first.origin_cam)
            if turned < _TURNED and moved < _MOVED:
                numbers.append(number)
                break
        else:
            numbers.append(len(firsts))
            firsts.append(board)
    return np.array(numbers, dtype=np.int64)


def weak_directions(fit: LightFit) -> list[str]:
    """What is only weakly determined, one sentence each, the weakest first."""
    free = np.array([number for number in fit.free if LIGHT_NAMES[number] != "droop"])
    scaled = fit.covariance[np.ix_(free, free)] / np.outer(_WEAK[free], _WEAK[free])
    values, vectors = np.linalg.eigh(scaled)
    sentences = []
    for value, direction in zip(values[::-1], vectors.T[::-1], strict=True):
        if value <= 1.0:
            break
        direction = direction * np.sign(direction[np.argmax(np.abs(direction))])
        parts = []
        for part, number in sorted(zip(direction, free, strict=True), key=lambda pair: -abs(pair[0])):
            if abs(part) < _NAMED_SHARE:
                continue
            name = LIGHT_NAMES[number]
            scale, unit = _UNITS[name]
            size = np.sqrt(value) * part * _WEAK[number] * scale
            parts.append(f"{_WORDS[name]} by {size:+.2g} {unit}".rstrip())
        sentences.append(f"Weakly determined (one standard deviation): {' with '.join(parts)}.")
    return sentences


def hold_out(boards: Sequence[LitBoard], fit: LightFit) -> HeldOut:
    """Fits without some poses in turn, and predicts their light.

    Args:
        boards: without strangers, as they were fitted.
        fit: to all of them.
    """
    stack = stacked(boards, fit.light)
    poses = distinct_poses(boards)
    off = np.zeros(stack.there.shape)
    variance = np.zeros(stack.there.shape)
    for fold in range(min(_FOLDS, int(poses.max()) + 1)):
        out = poses % _FOLDS == fold
        other = fit_light(stack.part(~out), fit.light, fit.free, fit.spread)
        tested = stack.part(out)
        slopes = light_slopes(tested, other.light, fit.free)
        by_fit = other.covariance[np.ix_(fit.free, fit.free)]
        off[out] = relative_residuals(tested, other.light)
        total = error_covariance(tested, other.light, fit.spread)
        variance[out] = np.diagonal(total, axis1=1, axis2=2)
        variance[out] += np.einsum("vni,ij,vnj->vn", slopes, by_fit, slopes)
    there = stack.there
    means = np.where(there, off, 0.0).sum(1) / there.sum(1)
    return HeldOut(
        rms=float(np.sqrt((off[there] ** 2).mean())),
        expected=float(np.sqrt(variance[there].mean())),
        shape_rms=float(np.sqrt(((off - means[:, None])[there] ** 2).mean())),
        boards=means,
    )


def axis_sigma(fit: LightFit) -> float:
    """Standard deviation of the axis, radians, in its worse direction."""
    slopes = fit.light.axis_slopes
    covariance = slopes @ fit.covariance[AXIS, AXIS] @ slopes.T
    return float(np.sqrt(max(np.linalg.eigvalsh(covariance)[-1], 0.0)))


def falloff_sigma(fit: LightFit) -> float:
    """Standard deviation of the falloff."""
    return float(np.sqrt(fit.covariance[FALLOFF, FALLOFF]))
