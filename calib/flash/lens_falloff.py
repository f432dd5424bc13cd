"""The lens's fall-off to the corners from the flash's own light on boards, found together with the flash.

A flash's beam and a lens's fall-off both make the picture darker away from its middle. They are told apart
as far as the flash is beside the lens, points elsewhere, or boards are near: then places at one distance from
the picture's centre lie at different angles to the flash's axis. How far that goes is in the joint
covariance, and where it does not go far, nothing is claimed.

Measured is  lens(r) light(x),  with  lens(r) = 1 + a1 r^2 + a2 r^4  and the light of `calib.flash.model`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calib.calibration import Intrinsics, Quantity
from calib.errors import FlatFieldError
from calib.flash.boards import (
    LitBoard,
    Stack,
    light_slopes,
    merged_stills,
    relative_residuals,
    stacked,
)
from calib.flash.checks import check_poses
from calib.flash.fit import LightFit, error_roots, fit_light, prior_slopes
from calib.flash.model import FALLOFF, LIGHT_SIZE, Light
from calib.flash.samples import CollectedBoards, lens_vector
from calib.flash.strangers import find_strangers
from calib.lens.projection import project
from capture.controls import Controls

Floats = NDArray[np.float64]

TERMS = 2
_ROUNDS, _STEPS, _LONGEST_STEP = 3, 12, 0.3
_LARGEST_SIGMA = 0.03  # of what the lens passes to the corner: more is not worth a correction
# What lenses do: half of the light is lost in the corner, or none, and mostly with r^2.
_USUAL, _SCATTER = np.array([-0.25, 0.0]), np.array([0.35, 0.2])
_LEAST_PASSED = 0.1


@dataclass(frozen=True, eq=False)
class LensFalloff:
    """A flat field that was found along with a flash.

    Attributes:
        terms: [2] a1, a2, as in `calib.calibration`.
        covariance: [10, 10] of the flash's eight numbers and the two terms.
        reach: how far from the centre squares were measured, 1 = corner.
    """

    terms: Floats
    covariance: Floats
    reach: float

    @property
    def sigma(self) -> Floats:
        """[2] standard deviations of the terms, which go together."""
        return np.asarray(np.sqrt(np.diag(self.covariance)[LIGHT_SIZE:]))

    @property
    def corner(self) -> tuple[float, float]:
        """What the lens passes to the corner, and its standard deviation."""
        both = self.covariance[LIGHT_SIZE:, LIGHT_SIZE:]
        return 1.0 + float(self.terms.sum()), float(np.sqrt(both.sum()))


def fit_lens_falloff(measured: Sequence[LitBoard], lens: Floats, size: tuple[int, int]) -> LensFalloff:
    """The fall-off of the lens, from boards; squares that do not belong are left out.

    Args:
        measured: their light as the camera saw it, without a flat field.
        lens: [9] of `calib.lens.projection`.
        size: (width, height) of the pictures, pixels.

    Raises:
        FlatFieldError: the boards do not tell lens and flash apart.
    """
    every = np.arange(LIGHT_SIZE)
    terms, covariance = _USUAL.copy(), np.eye(LIGHT_SIZE + TERMS)
    # With a usual lens taken off, squares in the corners are no strangers.
    light, even, _ = find_strangers(merged_stills(evened(measured, lens, size, terms)), every)
    r2 = [_squared_radius(board, lens, size) for board in even]
    boards = [
        replace(board, radiance=board.radiance * _passed(squared, terms)[:, None])
        for board, squared in zip(even, r2, strict=True)
    ]
    for _ in range(_ROUNDS):
        fit = fit_light(stacked(evened(boards, lens, size, terms), light), light, every)
        light, terms, covariance = _joint(stacked(boards, fit.light), fit, terms, r2)
    found = LensFalloff(terms, covariance, float(np.sqrt(max(float(one.max()) for one in r2))))
    passed, sigma = found.corner
    if sigma > _LARGEST_SIGMA or not _LEAST_PASSED < passed < 1.0 + 3 * _LARGEST_SIGMA:
        raise FlatFieldError(
            "These boards do not tell the lens's fall-off from the flash's beam: the corner gets "
            f"{passed:.2f} ± {sigma:.2f} (at most ± {_LARGEST_SIGMA:g}; squares reach {found.reach:.0%} of "
            "the way to it). Hold the board nearer and into the corners, or use `relight calibrate flat`."
        )
    return found


@dataclass(frozen=True, eq=False)
class FlatOfFlash:
    """A flat field found in a flash's light.

    Attributes:
        found: the fall-off.
        evened: the boards with it taken off.
    """

    found: LensFalloff
    evened: CollectedBoards

    def entry(self, source: str, controls: Controls) -> Quantity:
        """The entry of calibration.json.

        Args:
            source: what was filmed, for the provenance.
            controls: settings of the camera.
        """
        passed, sigma = self.found.corner
        about = f"{source}, from the flash's light on the board; the corner gets {passed:.3f} ± {sigma:.3f}"
        made_with = controls.mattering("flat_field")
        return Quantity.of(self.found.terms, "1", about, self.found.sigma, made_with)


def find_flat(collected: CollectedBoards, intrinsics: Intrinsics) -> FlatOfFlash:
    """The flat field of collected boards.

    Raises:
        FlatFieldError: the boards do not tell lens and flash apart.
        FlashGeometryError: they are too few, or too alike.
    """
    check_poses(collected.boards, collected.describe())
    lens, size = lens_vector(intrinsics), (intrinsics.width, intrinsics.height)
    found = fit_lens_falloff(collected.boards, lens, size)
    even = evened(collected.boards, lens, size, found.terms)
    return FlatOfFlash(found, replace(collected, boards=even))


def evened(boards: Sequence[LitBoard], lens: Floats, size: tuple[int, int], terms: Floats) -> list[LitBoard]:
    """Boards with the lens's fall-off taken off their light."""
    result = []
    for board in boards:
        passed = _passed(_squared_radius(board, lens, size), terms)
        result.append(replace(board, radiance=board.radiance / passed[:, None]))
    return result


def _joint(stack: Stack, fit: LightFit, terms: Floats, r2: Sequence[Floats]) -> tuple[Light, Floats, Floats]:
    """Light and terms by Gauss and Newton, and their joint covariance."""
    every = np.arange(LIGHT_SIZE)
    radius = np.zeros(stack.there.shape)
    for number, one in enumerate(r2):
        radius[number, : len(one)] = one
    light = fit.light
    prior = np.zeros((2 + TERMS, LIGHT_SIZE + TERMS))
    prior[:2, :LIGHT_SIZE] = prior_slopes(every)
    prior[2:, LIGHT_SIZE:] = np.diag(1.0 / _SCATTER)
    information = np.eye(LIGHT_SIZE + TERMS)
    for _ in range(_STEPS):
        passed = _passed(radius, terms)
        even = replace(stack, light=stack.light / passed)
        roots = error_roots(even, light, fit.spread)
        by_terms = np.stack([radius / passed, radius**2 / passed], axis=-1) * stack.there[..., None]
        slopes = np.concatenate([light_slopes(even, light, every), by_terms], axis=2)
        weighted = (roots @ slopes).reshape(-1, LIGHT_SIZE + TERMS)
        off = (roots @ relative_residuals(even, light)[..., None]).ravel()
        usual = np.concatenate([-prior[:2, :LIGHT_SIZE] @ light.vector, (_USUAL - terms) / _SCATTER])
        information = weighted.T @ weighted + prior.T @ prior
        step = np.linalg.solve(information, weighted.T @ off + prior.T @ usual)
        step *= min(1.0, _LONGEST_STEP / max(float(np.abs(step).max()), 1e-12))
        vector = light.vector + step[:LIGHT_SIZE]
        vector[FALLOFF] = max(vector[FALLOFF], 0.0)
        light, terms = Light(vector), terms + step[LIGHT_SIZE:]
        if np.abs(step).max() < 1e-7:
            break
    # As of the light alone, the pulses' spread is known from few pulses only.
    pulses = max(len(stack.boards), 6)
    return light, terms, np.linalg.inv(information) * (pulses - 2) / (pulses - 4)


def _passed(r2: Floats, terms: Floats) -> Floats:
    passed: Floats = np.maximum(1.0 + terms[0] * r2 + terms[1] * r2**2, _LEAST_PASSED)
    return passed


def _squared_radius(board: LitBoard, lens: Floats, size: tuple[int, int]) -> Floats:
    """[n] squared distance of the squares from the picture's centre, 1 = corner."""
    off = project(lens, board.points_cam) - np.array(size) / 2
    squared: Floats = 4.0 * (off**2).sum(axis=1) / (size[0] ** 2 + size[1] ** 2)
    return squared
