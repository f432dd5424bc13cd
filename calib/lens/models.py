"""Which distortion terms a lens needs, by the error on pictures that the fit has not seen.

The views are dealt out into parts. For each part the lens is fitted to the others, then only the poses of the
part are, and what is left is the held-out error. Terms that only follow the noise make it larger.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.lens.bundle import BEND, Observations, Solution, minimise
from calib.lens.projection import free_entries
from calib.lens.terms import LENS_MODELS

RICHEST = "k1k2p1p2k3"
_PARTS = 5


@dataclass(frozen=True)
class Trial:
    """A model and how well it did.

    Attributes:
        model: a name of `LENS_MODELS`.
        bent: whether the board's bend was sought too.
        held_out_px: root mean square of a coordinate's error on pictures that were not used.
    """

    model: str
    bent: bool
    held_out_px: float


def free_of(model: str, bent: bool) -> list[int]:
    """Places of a model's parameters among the shared ones of `calib.lens.bundle`."""
    return [*free_entries(LENS_MODELS[model]), *(BEND if bent else ())]


def with_only(solution: Solution, free: Sequence[int]) -> Solution:
    """The solution with zero for distortion and bend that are not sought: a start for a smaller model."""
    shared = solution.shared.copy()
    fixed = sorted(set(range(4, len(shared))) - set(free))
    shared[fixed] = 0.0
    return Solution(shared, solution.rotations, solution.translations_m, solution.residuals, solution.cost)


def choose_model(
    observations: Observations, solution: Solution, models: Sequence[str] = tuple(LENS_MODELS)
) -> tuple[Trial, list[Trial]]:
    """The model with the smallest held-out error, and all that were tried.

    The bend of the board is tried with the best lens on a flat board and with the richest (a bend that is
    left out looks like distortion).
    """
    trials = [Trial(model, False, held_out_error(observations, solution, model, False)) for model in models]
    flat = min(trials, key=lambda trial: trial.held_out_px)
    for model in dict.fromkeys([flat.model, models[-1]]):
        trials.append(Trial(model, True, held_out_error(observations, solution, model, True)))
    best = min(trials, key=lambda trial: trial.held_out_px)
    return best, trials


def held_out_error(observations: Observations, solution: Solution, model: str, bent: bool) -> float:
    """Root mean square error of a coordinate in pictures that the lens was not fitted to, pixels."""
    free = free_of(model, bent)
    start = with_only(solution, free)
    views = np.arange(len(observations.pixels))
    total, count = 0.0, 0
    for part in range(min(_PARTS, len(views))):
        held = views % _PARTS == part
        kept: NDArray[np.int64] = views[~held]
        fitted = minimise(observations.part(kept), start.part(kept), free)
        posed = start.part(views[held])
        seen = observations.part(views[held])
        only_poses = minimise(
            seen,
            Solution(fitted.shared, posed.rotations, posed.translations_m, posed.residuals, posed.cost),
            [],
        )
        total += float((only_poses.residuals**2).sum())
        count += 2 * int(seen.seen.sum())
    return float(np.sqrt(total / max(count, 1)))
