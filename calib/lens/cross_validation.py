"""Two calibrations from two halves of the pictures: do they differ by more than they say they may?

If they do, something is wrong that no residual shows: a lens that the model cannot follow, a zoom, focus or
stabiliser that moved, pictures that hang together. The difference is that of the pixels to which the same
rays are projected, after the small turn of the camera that makes it least (a turn of the camera is no
property of a lens).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.errors import IntrinsicsError
from calib.lens.bundle import Observations, Solution, minimise
from calib.lens.projection import LENS_SIZE, project, project_with_slopes, rays_of
from calib.lens.uncertainty import uncertainty_of

Floats = NDArray[np.float64]

# Halves that belong together differ more than this once in a hundred times.
_DOUBTFUL = 0.01
_DRAWS = 4000


@dataclass(frozen=True, eq=False)
class HalvesCheck:
    """How two halves of the pictures agree.

    Attributes:
        split: how they were dealt out, for people.
        difference_px: [n] per place of the grid; NaN outside of what the board covered.
        rms_px: root mean square of it.
        expected_px: what it should be by the claimed uncertainties of the halves.
        chance: probability of so large a difference if the uncertainties are right.
    """

    split: str
    difference_px: Floats
    rms_px: float
    expected_px: float
    chance: float

    @property
    def agrees(self) -> bool:
        """Whether the difference is nothing strange."""
        return self.chance >= _DOUBTFUL


def compare_halves(
    observations: Observations, solution: Solution, free: Sequence[int], grid: Floats
) -> list[HalvesCheck]:
    """The checks that the number of views allows: every other picture, and the first half with the second.

    Args:
        observations: in the order in which the pictures were taken.
        solution: fitted to all of them.
        free: what was sought.
        grid: [n, 2] pixels at which to compare.
    """
    views = np.arange(len(observations.pixels))
    inside = covered(observations, grid)
    checks = []
    for split, first in (
        ("every other picture", views % 2 == 0),
        ("first and second half", views < len(views) // 2),
    ):
        check = _compare(observations, solution, free, grid, inside, (views[first], views[~first]), split)
        if check is not None:
            checks.append(check)
    return checks


def covered(observations: Observations, pixels: Floats) -> NDArray[np.bool_]:
    """[n] which pixels lie within the convex hull of all corners seen."""
    hull = cv2.convexHull(observations.pixels[observations.seen].astype(np.float32))
    return np.array([cv2.pointPolygonTest(hull, (float(x), float(y)), False) >= 0 for x, y in pixels])


def _compare(
    observations: Observations,
    solution: Solution,
    free: Sequence[int],
    grid: Floats,
    inside: NDArray[np.bool_],
    halves: tuple[NDArray[np.int64], NDArray[np.int64]],
    split: str,
) -> HalvesCheck | None:
    """None where a half is too little for a calibration of its own."""
    lenses, covariance = [], np.zeros((LENS_SIZE, LENS_SIZE))
    for half in halves:
        seen = observations.part(half)
        fitted = minimise(seen, solution.part(half), free)
        try:
            covariance += uncertainty_of(seen, fitted, free).covariance[:LENS_SIZE, :LENS_SIZE]
        except IntrinsicsError:
            return None
        lenses.append(fitted.lens)
    rays = rays_of(solution.lens, grid)
    inside = inside & np.isfinite(rays).all(1)
    if inside.sum() < LENS_SIZE:
        return None
    rays = rays[inside]
    _, by_lens, by_point = project_with_slopes(solution.lens, rays)
    by_turn = np.cross(rays[:, None], by_point).reshape(-1, 3)
    basis, _ = np.linalg.qr(by_turn)

    def without_turn(change: Floats) -> Floats:
        return change - basis @ (basis.T @ change)

    difference = without_turn((project(lenses[0], rays) - project(lenses[1], rays)).reshape(-1))
    spread = without_turn(by_lens.reshape(-1, LENS_SIZE))
    values, vectors = np.linalg.eigh(covariance)
    root = spread @ (vectors * np.sqrt(np.maximum(values, 0.0)))
    weights = np.maximum(np.linalg.eigvalsh(root.T @ root), 0.0)
    draws = np.random.default_rng(0).chisquare(1, (_DRAWS, len(weights))) @ weights
    squared = float(difference @ difference)
    everywhere = np.full(len(grid), np.nan)
    everywhere[inside] = np.linalg.norm(difference.reshape(-1, 2), axis=1)
    return HalvesCheck(
        split=split,
        difference_px=everywhere,
        rms_px=float(np.sqrt(squared / inside.sum())),
        expected_px=float(np.sqrt(weights.sum() / inside.sum())),
        chance=float((draws >= squared).mean()),
    )
