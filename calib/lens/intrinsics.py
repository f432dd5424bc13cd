"""A camera's geometry from views of a board: the whole way from corners to a lens with its uncertainty.

start        focal length by trial, poses by IPPE
outliers     corners and pictures that no lens explains are left out
model        distortion terms (and the board's bend) with the smallest held-out error
fit          each picture weighted by its own noise
uncertainty  covariance, halves against each other
checks       `calib.lens.checks`: refused where the pictures do not tell
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calib.board.charuco import Board
from calib.board.detection import BoardView
from calib.errors import IntrinsicsError
from calib.lens.bundle import (
    BEND,
    LENS_SIZE,
    SHARED_SIZE,
    Observations,
    Solution,
    minimise,
    observations_of,
    start_at,
)
from calib.lens.checks import (
    FEWEST_VIEWS,
    check_determined,
    check_fit,
    check_poses,
    covered_share,
    warnings_of,
)
from calib.lens.cross_validation import HalvesCheck, compare_halves
from calib.lens.models import RICHEST, Trial, choose_model, free_of, with_only
from calib.lens.uncertainty import Uncertainty, pixel_grid, uncertainty_of

Floats = NDArray[np.float64]
Progress = Callable[[str, float], None]

# Focal lengths tried, of the longer side: from a fisheye's middle to a long telephoto.
_FOCALS = (0.4, 0.6, 0.85, 1.2, 1.8, 3.0, 6.0)
# Of a thousand corners with Gaussian noise one in twenty fits loses one: exp(-4.5^2 / 2) a corner.
_OUTLIER_SIGMAS = 4.5
_OUTLIER_ROUNDS = 4
# Views of which more corners are outliers are left out whole: something else is wrong with them.
_BAD_VIEW_SHARE = 0.3
# A view's own variance is known from its hundred residuals and trusted as much as this many common ones.
_PRIOR_COORDINATES = 3


@dataclass(frozen=True, eq=False)
class IntrinsicsResult:
    """A calibrated lens.

    Attributes:
        board: what was seen; its layout is the one that was found.
        size: (width, height) of the pictures.
        model: a name of `LENS_MODELS`.
        lens: [9] fx, fy, cx, cy, k1, k2, p1, p2, k3; pixel centres at 0.5.
        covariance: [9, 9] of it; zero for terms that the model does not have, unless they are in doubt.
        bend_m: [2] bend of the board along its width and height; None = taken as flat.
        views: names of the pictures used, in the order in which they came.
        observations: their corners; outliers have no weight.
        solution: poses and residuals.
        uncertainty: of all.
        trials: what the model was chosen from.
        halves: how the halves agree.
        left_out: number of corners and of views left out as outliers.
        warnings: sentences for people.
    """

    board: Board
    size: tuple[int, int]
    model: str
    lens: Floats
    covariance: Floats
    bend_m: Floats | None
    views: list[str]
    observations: Observations
    solution: Solution
    uncertainty: Uncertainty
    trials: list[Trial]
    halves: list[HalvesCheck]
    left_out: tuple[int, int]
    warnings: list[str]

    @property
    def sigma(self) -> Floats:
        """[9] standard deviations of the lens."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def rms_px(self) -> float:
        """Root mean square of a residual's coordinate."""
        seen = int(self.observations.seen.sum())
        return float(np.sqrt((self.solution.residuals**2).sum() / (2 * seen)))

    @property
    def distances_m(self) -> Floats:
        """[V] from the camera to the middle of the board."""
        return np.linalg.norm(self.solution.translations_m, axis=1)

    @property
    def covered_share(self) -> float:
        """Share of the picture that the corners span."""
        return covered_share(self.observations)


def calibrate_intrinsics(
    views: Sequence[BoardView],
    board: Board,
    model: str | None = None,
    progress: Progress = lambda stage, fraction: None,
) -> IntrinsicsResult:
    """The lens of views of a board.

    Args:
        views: in the order in which they were taken, of one picture size.
        board: what they show.
        model: a name of `LENS_MODELS`; None = the one with the smallest held-out error.
        progress: called with a stage and how much of it is done.

    Raises:
        IntrinsicsError: the views do not tell the lens; the message says why and what to do.
    """
    views, board = _one_layout(views, board)
    if len(views) < FEWEST_VIEWS:
        raise IntrinsicsError(
            f"Only {len(views)} different views of the board can be used; at least {FEWEST_VIEWS} are "
            "needed, "
            "and 20 or more, near and far, tilted to all sides and in all parts of the picture, are good."
        )
    if sizes := sorted({view.size for view in views} - {views[0].size}):
        raise IntrinsicsError(
            f"The pictures are of different sizes ({_size(views[0].size)} and {_size(sizes[0])}); a "
            "calibration holds for one: use pictures of one recording mode."
        )
    observations = observations_of(views, board)
    progress("fit the lens", 0.0)
    with np.errstate(all="ignore"):  # a degenerate set runs off to infinity and is refused below
        solution = _first_solution(observations)
        check_poses(observations, solution)
        kept, observations, solution = _without_outliers(observations, solution)
        dropped = len(views) - len(kept)
        views = [views[view] for view in kept]
        if len(views) < FEWEST_VIEWS:
            raise IntrinsicsError(
                f"{dropped} of {dropped + len(views)} pictures fit no lens; the board bends or moves, or the "
                "camera focuses, zooms or stabilises: fix the board to a plate and lock the lens."
            )
        check_poses(observations, solution)
        check_fit(observations, solution)
        progress("choose the distortion model", 0.0)
        trials: list[Trial] = []
        bent = False
        if model is None:
            best, trials = choose_model(observations, solution)
            model, bent = best.model, best.bent
        progress("uncertainty", 0.0)
        free = free_of(model, bent)
        observations, solution = _weighted_fit(observations, with_only(solution, free), free)
        uncertainty = uncertainty_of(observations, solution, free)
        if trials and uncertainty.correlation_factor > 1.0:
            uncertainty = _with_doubt_of_model(observations, solution, uncertainty, bent)
        check_determined(observations, solution, uncertainty)
        grid, _ = pixel_grid(observations.size)
        halves = compare_halves(observations, solution, free, grid)
    # Halves that differ too much disprove the uncertainty; it grows to what they show.
    worst = max((c.rms_px / c.expected_px for c in halves if not c.agrees), default=1.0)
    uncertainty = uncertainty.scaled(max(worst, 1.0) ** 2)
    corners_left_out = int(sum(len(view.ids) for view in views)) - int(observations.seen.sum())
    result = IntrinsicsResult(
        board=board,
        size=observations.size,
        model=model,
        lens=solution.lens.copy(),
        covariance=uncertainty.covariance[:LENS_SIZE, :LENS_SIZE],
        bend_m=solution.shared[list(BEND)].copy() if bent else None,
        views=[view.name for view in views],
        observations=observations,
        solution=solution,
        uncertainty=uncertainty,
        trials=trials,
        halves=halves,
        left_out=(corners_left_out, dropped),
        warnings=[],
    )
    progress("uncertainty", 1.0)
    warnings = warnings_of(observations, solution, uncertainty, halves, dropped)
    return replace(result, warnings=warnings)


def _size(size: tuple[int, int]) -> str:
    return f"{size[0]} x {size[1]} pixels"


def _one_layout(views: Sequence[BoardView], board: Board) -> tuple[list[BoardView], Board]:
    """Views of the layout that most have, and the board in it."""
    layouts = [view.layout for view in views]
    if not layouts:
        return [], board
    layout = max(layouts, key=layouts.count)
    found = board if layout == "both" else board.with_layout(layout)
    return [view for view in views if view.layout == layout], found


def _first_solution(observations: Observations) -> Solution:
    """A lens with k1 that explains the corners roughly, from the best of several focal lengths."""
    width, height = observations.size
    starts = []
    for focal in _FOCALS:
        shared = np.zeros(SHARED_SIZE)
        shared[:4] = [focal * max(width, height)] * 2 + [width / 2, height / 2]
        starts.append(start_at(observations, shared))
    finite = [start for start in starts if np.isfinite(start.cost)]
    if not finite:
        raise IntrinsicsError("The corners fit no board at all; check the board's description.")
    pinhole = minimise(observations, min(finite, key=lambda start: start.cost), free_of("none", False))
    return minimise(observations, pinhole, free_of("k1", False))


def _without_outliers(
    observations: Observations, solution: Solution
) -> tuple[NDArray[np.int64], Observations, Solution]:
    """Numbers of the views that stay, their observations with outliers at weight 0, and the richest fit."""
    kept = np.arange(len(observations.pixels))
    free = free_of(RICHEST, True)
    before = observations.seen.sum(1)
    for _ in range(_OUTLIER_ROUNDS):
        solution = minimise(observations, solution, free)
        off = np.linalg.norm(solution.residuals, axis=2)
        seen = observations.seen
        # The median of a Rayleigh distribution is 1.1774 times the sigma of a coordinate.
        common = float(np.median(off[seen])) / 1.1774
        own = np.array(
            [np.median(o[s]) / 1.1774 if s.any() else np.inf for o, s in zip(off, seen, strict=True)]
        )
        limit = _OUTLIER_SIGMAS * np.clip(own, common, 3.0 * common)
        outlying = seen & (off > limit[:, None])
        if not outlying.any():
            break
        observations = replace(observations, weights=np.where(outlying, 0.0, observations.weights))
        good = observations.seen.sum(1) >= np.maximum((1.0 - _BAD_VIEW_SHARE) * before, 6)
        kept, before = kept[good], before[good]
        observations, solution = observations.part(np.nonzero(good)[0]), solution.part(np.nonzero(good)[0])
        if len(kept) < FEWEST_VIEWS:
            break
    return kept, observations, solution


def _weighted_fit(
    observations: Observations, solution: Solution, free: Sequence[int]
) -> tuple[Observations, Solution]:
    """The fit with each view's corners weighted by the view's own noise."""
    solution = minimise(observations, solution, free)
    for _ in range(2):
        seen = observations.seen
        counts = 2 * seen.sum(1)
        squares = (solution.residuals**2).sum((1, 2))
        common = squares.sum() / counts.sum()
        # A pose takes 6 of a view's coordinates: what is left over is that much smaller.
        own = (squares * counts / np.maximum(counts - 6, 1) + _PRIOR_COORDINATES * common) / (
            counts + _PRIOR_COORDINATES
        )
        weights = np.where(seen, (1.0 / np.maximum(own, 1e-12))[:, None], 0.0)
        observations = replace(observations, weights=weights)
        solution = minimise(observations, solution, free)
    return observations, solution


def _with_doubt_of_model(
    observations: Observations, solution: Solution, uncertainty: Uncertainty, bent: bool
) -> Uncertainty:
    """The uncertainty with the difference to the richest lens in it.

    Where the errors of a picture hang together they hide small terms from the held-out error: the centre of
    the picture and the tangential terms can then be off together by much more than a model without the
    latter admits.
    """
    free = free_of(RICHEST, bent)
    richest = minimise(observations, solution, free)
    difference = richest.shared - solution.shared
    return replace(
        uncertainty,
        covariance=uncertainty.covariance + np.outer(difference, difference),
        mean_motion=uncertainty_of(observations, richest, free).mean_motion,
    )
