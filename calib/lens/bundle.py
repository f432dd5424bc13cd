"""The least squares behind a calibration: one lens, one pose a view, and the bend of the board.

Minimises the weighted squared distance of found and projected corners over the lens, the poses and, if asked
for, a bend of the board (a parabola along each side, as a printed sheet on a plate has it; mrcal calls it
`calobject_warp`). Levenberg-Marquardt; the poses are eliminated (Schur complement), so that its time goes
with the number of views.

The parameters `shared` by all views are a vector [11]: the lens of `calib.lens.projection` and the bend of
the board at its middle, from its ends, along its width and its height, metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib.board.charuco import Board
from calib.board.detection import BoardView
from calib.lens.projection import LENS_SIZE, project, project_with_slopes

Floats = NDArray[np.float64]

SHARED_SIZE = LENS_SIZE + 2
BEND = (LENS_SIZE, LENS_SIZE + 1)
_MOST_STEPS = 60
_DONE = 1e-8  # relative change of the cost: a few thousandths of a standard deviation of any parameter
_FIRST_DAMPING, _LARGEST_DAMPING = 1e-5, 1e12


@dataclass(frozen=True, eq=False)
class Observations:
    """Where the corners were seen.

    Attributes:
        corners_m: [N, 3] on a flat board, board axes.
        pixels: [V, N, 2]; zero where a corner was not seen.
        weights: [V, N] 1/variance of a coordinate, relative; 0 = not seen or left out.
        size: (width, height) of the pictures.
    """

    corners_m: Floats
    pixels: Floats
    weights: Floats
    size: tuple[int, int]

    @property
    def seen(self) -> NDArray[np.bool_]:
        """[V, N] which corners count."""
        return self.weights > 0

    def part(self, views: NDArray[np.int64] | Sequence[int]) -> Observations:
        """Those of some views."""
        chosen = np.asarray(views, dtype=np.int64)
        return replace(self, pixels=self.pixels[chosen], weights=self.weights[chosen])


def observations_of(views: Sequence[BoardView], board: Board) -> Observations:
    """The corners of views as arrays, all of the same weight."""
    corners_m = board.corners_m
    pixels = np.zeros((len(views), len(corners_m), 2))
    weights = np.zeros((len(views), len(corners_m)))
    for number, view in enumerate(views):
        pixels[number, view.ids] = view.corners_px
        weights[number, view.ids] = 1.0
    return Observations(corners_m, pixels, weights, views[0].size)


@dataclass(frozen=True, eq=False)
class Solution:
    """Where the least squares ended.

    Attributes:
        shared: [11].
        rotations: [V, 3, 3] camera axes from board axes.
        translations_m: [V, 3] the board's middle in camera axes.
        residuals: [V, N, 2] found minus projected, pixels; zero where not seen.
        cost: weighted sum of their squares.
    """

    shared: Floats
    rotations: Floats
    translations_m: Floats
    residuals: Floats
    cost: float

    @property
    def lens(self) -> Floats:
        """[9]; see `calib.lens.projection`."""
        return self.shared[:LENS_SIZE]

    def part(self, views: NDArray[np.int64] | Sequence[int]) -> Solution:
        """The poses of some views with the same lens; the cost is not of these."""
        chosen = np.asarray(views, dtype=np.int64)
        return replace(
            self,
            rotations=self.rotations[chosen],
            translations_m=self.translations_m[chosen],
            residuals=self.residuals[chosen],
        )


@dataclass(frozen=True, eq=False)
class Normals:
    """The normal equations at a solution: everything that the uncertainty is made of.

    Attributes:
        shared: [p, p] curvature of half the cost by the free shared parameters.
        view_shared: [V, p, p] what each view adds to it.
        mixed: [V, p, 6] by them and by each pose.
        poses: [V, 6, 6] by each pose.
        shared_slope: [p] of half the cost, negative.
        view_slopes: [V, p] what each view adds to it.
        pose_slopes: [V, 6] likewise by the poses.
    """

    shared: Floats
    view_shared: Floats
    mixed: Floats
    poses: Floats
    shared_slope: Floats
    view_slopes: Floats
    pose_slopes: Floats


def bent_corners(shared: Floats, corners_m: Floats) -> tuple[Floats, Floats]:
    """[N, 3] corners of the bent board and [N, 2] how their z changes with the two bends."""
    half = np.maximum(np.abs(corners_m[:, :2]).max(0), 1e-12)
    shape = 1.0 - (corners_m[:, :2] / half) ** 2
    bent = corners_m.copy()
    bent[:, 2] += shape @ shared[list(BEND)]
    return bent, shape


def residuals_at(observations: Observations, solution: Solution) -> tuple[Floats, float]:
    """[V, N, 2] found minus projected, and the weighted sum of squares."""
    corners, _ = bent_corners(solution.shared, observations.corners_m)
    points = corners @ np.swapaxes(solution.rotations, 1, 2) + solution.translations_m[:, None]
    pixels = project(solution.lens, points)
    off = np.where(observations.seen[..., None], observations.pixels - pixels, 0.0)
    return off, float((observations.weights[..., None] * off**2).sum())


def normals_at(observations: Observations, solution: Solution, free: Sequence[int]) -> Normals:
    """The normal equations by the free shared parameters and the poses (left: rotation, translation)."""
    corners, bend_shape = bent_corners(solution.shared, observations.corners_m)
    turned = corners @ np.swapaxes(solution.rotations, 1, 2)
    pixels, by_lens, by_point = project_with_slopes(solution.lens, turned + solution.translations_m[:, None])
    seen = observations.seen[..., None]
    off = np.where(seen, observations.pixels - pixels, 0.0)
    out_of_board = by_point @ solution.rotations[:, None, :, 2:]
    by_bend = out_of_board * bend_shape[:, None, :]
    shared = np.concatenate([by_lens, by_bend], axis=-1)[..., list(free)]
    by_rotation = np.cross(turned[:, :, None], by_point)  # d(w x p) . g = w . (p x g)
    poses = np.concatenate([by_rotation, by_point], axis=-1)
    root = np.sqrt(observations.weights)[..., None, None]
    views, count = off.shape[:2]
    shared = (shared * root).reshape(views, 2 * count, len(free))
    poses = (poses * root).reshape(views, 2 * count, 6)
    off = (off * root[..., 0]).reshape(views, 2 * count, 1)
    shared_t, poses_t = np.swapaxes(shared, 1, 2), np.swapaxes(poses, 1, 2)
    view_shared = shared_t @ shared
    view_slopes = (shared_t @ off)[..., 0]
    return Normals(
        shared=view_shared.sum(0),
        view_shared=view_shared,
        mixed=shared_t @ poses,
        poses=poses_t @ poses,
        shared_slope=view_slopes.sum(0),
        view_slopes=view_slopes,
        pose_slopes=(poses_t @ off)[..., 0],
    )


def minimise(observations: Observations, start: Solution, free: Sequence[int]) -> Solution:
    """The least squares from a start.

    Args:
        observations: what was seen.
        start: lens and poses; parameters that are not free keep their value.
        free: places in `shared` of those that are sought; none = only the poses are.

    Returns:
        Where no step makes the cost smaller. It is finite if the start's is.
    """
    solution = _with_residuals(observations, start)
    damping = _FIRST_DAMPING
    for _ in range(_MOST_STEPS):
        normals = normals_at(observations, solution, free)
        while damping < _LARGEST_DAMPING:
            step = _step(normals, damping)
            tried = None if step is None else _with_residuals(observations, _moved(solution, *step, free))
            if tried is not None and np.isfinite(tried.cost) and tried.cost <= solution.cost:
                break
            damping *= 20.0
        else:
            return solution
        assert tried is not None
        settled = solution.cost - tried.cost <= _DONE * solution.cost
        solution = tried
        damping = max(damping / 10.0, 1e-12)
        if settled:
            return solution
    return solution


def starting_poses(observations: Observations, lens: Floats) -> tuple[Floats, Floats]:
    """Rotations [V, 3, 3] and translations [V, 3] of the views for a lens (Collins & Bartoli 2014, IPPE)."""
    K = np.array([[lens[0], 0, lens[2]], [0, lens[1], lens[3]], [0, 0, 1.0]])
    rotations = np.zeros((len(observations.pixels), 3, 3))
    translations = np.zeros((len(observations.pixels), 3))
    for number, seen in enumerate(observations.seen):
        _, turn, translation = cv2.solvePnP(
            observations.corners_m[seen],
            observations.pixels[number, seen],
            K,
            lens[4:],
            flags=cv2.SOLVEPNP_IPPE,
        )
        rotations[number] = cv2.Rodrigues(turn)[0]
        translations[number] = translation.ravel()
    return rotations, translations


def start_at(observations: Observations, shared: Floats) -> Solution:
    """A solution with given shared parameters and the poses that these suggest."""
    rotations, translations = starting_poses(observations, shared[:LENS_SIZE])
    empty = Solution(shared, rotations, translations, np.zeros_like(observations.pixels), np.inf)
    return _with_residuals(observations, empty)


def _with_residuals(observations: Observations, solution: Solution) -> Solution:
    residuals, cost = residuals_at(observations, solution)
    return replace(solution, residuals=residuals, cost=cost)


def _step(normals: Normals, damping: float) -> tuple[Floats, Floats] | None:
    """Damped Gauss-Newton step of shared parameters [p] and poses [V, 6]; None where it cannot be solved."""
    poses = normals.poses.copy()
    diagonal = np.arange(6)
    poses[:, diagonal, diagonal] *= 1.0 + damping
    shared = normals.shared.copy()
    along = np.arange(len(shared))
    shared[along, along] *= 1.0 + damping
    try:
        inverse = np.linalg.inv(poses)
        by_pose = normals.mixed @ inverse
        reduced = shared - (by_pose @ np.swapaxes(normals.mixed, 1, 2)).sum(0)
        slope = normals.shared_slope - (by_pose @ normals.pose_slopes[..., None])[..., 0].sum(0)
        scale = 1.0 / np.sqrt(np.maximum(np.diag(normals.shared), 1e-300))
        shared_step = scale * np.linalg.solve(reduced * np.outer(scale, scale), slope * scale)
    except np.linalg.LinAlgError:
        return None
    rest = normals.pose_slopes - np.einsum("vpk,p->vk", normals.mixed, shared_step)
    return shared_step, (inverse @ rest[..., None])[..., 0]


def _moved(solution: Solution, shared_step: Floats, pose_steps: Floats, free: Sequence[int]) -> Solution:
    shared = solution.shared.copy()
    shared[list(free)] += shared_step
    turns = Rotation.from_rotvec(pose_steps[:, :3]).as_matrix()
    return replace(
        solution,
        shared=shared,
        rotations=turns @ solution.rotations,
        translations_m=solution.translations_m + pose_steps[:, 3:],
    )
