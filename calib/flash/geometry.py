"""Where a flash is, where it points to, how it falls off, and how strong it is: from lit boards to an answer.

The fit itself is `calib.flash.fit`; here it is started, refused where the boards cannot tell, freed of what
they do not tell, checked on boards left out, and completed with the strength of each channel.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calib.calibration import Calibration
from calib.errors import FlashGeometryError
from calib.flash.boards import LitBoard, merged_stills, stacked
from calib.flash.checks import (
    HeldOut,
    axis_sigma,
    check_fit,
    check_poses,
    distinct_poses,
    falloff_sigma,
    hold_out,
    weak_directions,
)
from calib.flash.fit import LightFit, fit_light, light_exponent, pulse_gains
from calib.flash.model import AXIS, DROOP, FALLOFF, LIGHT_SIZE, LOG_STRENGTH, Light
from calib.flash.samples import CollectedBoards
from calib.flash.strangers import find_strangers

Floats = NDArray[np.float64]
Progress = Callable[[str, float], None]

# More squares or pulses than this that do not belong are no exception any more.
_MOST_STRANGE_SQUARES, _MOST_STRANGE_PULSES = 0.2, 0.34
# An axis in more doubt than this is not stated (radians).
_DOUBTFUL_AXIS = np.radians(15.0)
_SURE = 3.0  # standard deviations from which a droop is one
_UNSTEADY = 0.03
# A light that grows with another power than 1 moves the flash: by some 3 to 9 mm for each 0.01.
_DOUBTFUL_EXPONENT, _WRONG_EXPONENT = 0.01, 0.03


@dataclass(frozen=True, eq=False)
class FlashGeometry:
    """What was found of a flash.

    Attributes:
        fit: position, axis, falloff, mean strength of the channels and droop, with their covariance.
        strength: [3] radiance of a white surface at 1 m on the axis, in units of the white clip.
        strength_covariance: [3, 3].
        paper_albedo: what the board's white was taken for.
        boards: those that were fitted.
        gains: [V] how much brighter each pulse was than the trend, relative; and `gain_sigma` [V].
        gain_sigma: [V].
        held_out: how boards left out are predicted.
        exponent: power of the predicted light with which the measured one grows, and its standard deviation.
        left_out: (squares, pulses) that do not belong.
        axis_known: whether the axis was determined; else it is taken along the optical axis.
        notes: what a user must know, one sentence each.
        pairs: what became of the pairs, for people.
    """

    fit: LightFit
    strength: Floats
    strength_covariance: Floats
    paper_albedo: float
    boards: list[LitBoard]
    gains: Floats
    gain_sigma: Floats
    held_out: HeldOut
    exponent: tuple[float, float]
    left_out: tuple[int, int]
    axis_known: bool
    notes: list[str]
    pairs: str

    @property
    def droop(self) -> tuple[float, float]:
        """Relative change of the light from the first to the last pulse, and its standard deviation."""
        change = float(np.exp(self.fit.light.vector[DROOP]))
        return change - 1.0, change * float(np.sqrt(self.fit.covariance[DROOP, DROOP]))

    @property
    def position_sigma_m(self) -> Floats:
        """[3] standard deviation of the position."""
        sigma: Floats = np.sqrt(np.diag(self.fit.covariance)[:3])
        return sigma

    @property
    def axis_covariance(self) -> Floats:
        """[3, 3] of the unit axis."""
        slopes = self.fit.light.axis_slopes
        covariance: Floats = slopes @ self.fit.covariance[AXIS, AXIS] @ slopes.T
        return covariance


def calibrate_flash(
    collected: CollectedBoards,
    calibration: Calibration,
    paper_albedo: float = 1.0,
    progress: Progress = lambda stage, fraction: None,
    joint: Floats | None = None,
) -> FlashGeometry:
    """The flash that lit the boards.

    Args:
        collected: the light of the pairs.
        calibration: what else is known of the camera: its uncertainty enters the strength.
        paper_albedo: of the board's white; the strength is that of a surface of albedo 1.
        progress: told ("fit the flash", fraction).
        joint: [8, 8] covariance of the light where the flat field was found along with it; None = the flat
            field is known.

    Raises:
        FlashGeometryError: the boards cannot tell, for the reason said.
    """
    if not 0 < paper_albedo <= 1:
        raise FlashGeometryError(f"The paper's albedo is {paper_albedo:g}; it lies above 0 and at most at 1.")
    pairs = collected.describe()
    check_poses(collected.boards, pairs)
    everything = np.arange(LIGHT_SIZE)
    measured = merged_stills(collected.boards)
    start, boards, lost = find_strangers(measured, everything)
    _check_strangers(measured, boards, lost)
    check_poses(boards, pairs)
    progress("fit the flash", 0.3)
    stack = stacked(boards, start)
    fit = fit_light(stack, start, everything)
    axis_known = axis_sigma(fit) < _DOUBTFUL_AXIS and fit.light.vector[FALLOFF] > 2 * falloff_sigma(fit)
    if not axis_known:
        vector = fit.light.vector.copy()
        vector[AXIS] = 0.0
        fit = fit_light(stack, Light(vector), np.setdiff1d(everything, np.arange(AXIS.start, AXIS.stop)))
    check_fit(fit, boards)
    exponent, exponent_sigma = light_exponent(stack, fit)
    if abs(exponent - 1.0) > max(_SURE * exponent_sigma, _WRONG_EXPONENT):
        raise FlashGeometryError(
            f"The light on the board grows with the power {exponent:.2f} ± {exponent_sigma:.2f} of what a "
            "small flash sends onto matte paper, not with its first: place and falloff would be wrong. "
            "Calibrate the response (or name the transfer function), keep other light constant, and "
            "use a matte board."
        )
    progress("fit the flash", 0.6)
    held_out = hold_out(boards, fit)
    if joint is not None:
        known = np.isin(everything, fit.free)
        fit = replace(fit, covariance=np.where(known[:, None] & known, joint, 0.0))
    progress("fit the flash", 1.0)
    strength, covariance = _channels(boards, fit, calibration, paper_albedo)
    gains, gain_sigma = pulse_gains(stack, fit)
    found = FlashGeometry(
        fit=fit,
        strength=strength,
        strength_covariance=covariance,
        paper_albedo=paper_albedo,
        boards=boards,
        gains=gains,
        gain_sigma=gain_sigma,
        held_out=held_out,
        exponent=(exponent, exponent_sigma),
        left_out=(lost, len(measured) - len(boards)),
        axis_known=axis_known,
        notes=[],
        pairs=pairs,
    )
    return replace(found, notes=_notes(found, calibration))


def _check_strangers(all_boards: list[LitBoard], boards: list[LitBoard], lost: int) -> None:
    """Refuses light that is no near light's."""
    squares = sum(len(board.points_cam) for board in boards) + lost
    pulses = len(all_boards) - len(boards)
    if pulses > _MOST_STRANGE_PULSES * len(all_boards) or lost > _MOST_STRANGE_SQUARES * max(squares, 1):
        raise FlashGeometryError(
            f"The light is not that of one small flash on matte paper: {lost} of {squares} squares and "
            f"{pulses} of {len(all_boards)} pulses do not belong to the others. Keep shadows and hands off "
            "the board, use a matte print, lock the exposure, and calibrate the response."
        )


def _channels(
    boards: list[LitBoard], fit: LightFit, calibration: Calibration, paper_albedo: float
) -> tuple[Floats, Floats]:
    """[3] strength of the channels of albedo 1, and its [3, 3] covariance.

    All channels have the same geometry; the ratio of each to their mean comes from the boards' means, whose
    scatter gives its uncertainty. An error of the focal length is one of all distances.
    """
    ratios = np.array([(board.radiance / board.radiance.mean(1)[:, None]).mean(0) for board in boards])
    mean = float(np.exp(fit.light.vector[LOG_STRENGTH])) / paper_albedo
    strength = mean * ratios.mean(0)
    variance = float(fit.covariance[LOG_STRENGTH, LOG_STRENGTH])
    if (known := calibration.intrinsics) is not None and known.pinhole.sigma is not None:
        focal = np.broadcast_to(known.pinhole.sigma, (4,))[:2] / known.pinhole.value[:2]
        variance += (2.0 * float(focal.max())) ** 2
    covariance = variance * np.outer(strength, strength)
    covariance += np.diag(mean**2 * ratios.var(0, ddof=1) / len(boards))
    return strength, covariance


def _notes(found: FlashGeometry, calibration: Calibration) -> list[str]:
    notes = []
    if calibration.flat_field is None:
        notes.append(
            "No flat field is known: the falloff holds the lens's own falloff towards the picture's corners "
            "too."
        )
    if found.paper_albedo == 1.0:
        notes.append(
            "The board's white is taken for albedo 1; with paper of albedo 0.9 the strength is 1 / 0.9 of "
            "that stated (--paper-albedo)."
        )
    if not found.axis_known:
        notes.append(
            "The falloff is too weak for the axis to be told; it is taken along the optical axis, and the "
            "falloff holds for that."
        )
    notes += weak_directions(found.fit)
    check = found.held_out
    if not check.agrees:
        notes.append(
            f"Boards left out are predicted to {100 * check.rms:.2f} %, and {100 * check.expected:.2f} % "
            "were expected: the uncertainties are too small. Is the paper matte and flat, and the response "
            "right?"
        )
    exponent, sigma = found.exponent
    if abs(exponent - 1.0) > max(_SURE * sigma, _DOUBTFUL_EXPONENT):
        notes.append(
            f"The light grows with the power {exponent:.3f} ± {sigma:.3f} of that predicted: place and "
            "falloff are off by more than is stated. Calibrate the response, and use a matte board."
        )
    droop, sigma = found.droop
    if abs(droop) > _SURE * sigma and abs(droop) > 0.01:
        notes.append(
            f"The flash {'loses' if droop < 0 else 'gains'} {100 * abs(droop):.1f} ± {100 * sigma:.2g} % "
            "over the capture; the strength is that of its middle."
        )
    if found.fit.spread.pulse > _UNSTEADY:
        notes.append(
            f"Pulses differ by {100 * found.fit.spread.pulse:.1f} % from each other: lock exposure and gain, "
            "and let every pulse cover the whole exposure."
        )
    return notes


def poses_of(found: FlashGeometry) -> int:
    """Number of different poses that were fitted."""
    return len(set(distinct_poses(found.boards).tolist()))
