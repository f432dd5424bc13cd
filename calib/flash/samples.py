"""The light of a flash on a board's white squares, from a pair of pictures and the board's pose in each.

Measured is the white of a square between its marker and its edges, as far from both as edges are blurred. The
unlit picture is sampled at the same points of the board, with the board's own pose in it where it is seen, so
a hand that moves a little does no harm. Points that clip, and those that would show the flash's mirror image
on a glossy board, are left out.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from enum import Enum

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.board.charuco import Board
from calib.board.detection import BoardDetector, BoardView, Problem
from calib.calibration import Calibration, Intrinsics
from calib.errors import FlashGeometryError
from calib.flash.boards import LitBoard
from calib.flash.model import Light, log_light
from calib.flash.pairs import FlashPair, LinearPicture
from calib.lens.projection import LENS_SIZE, project, project_with_slopes

Floats = NDArray[np.float64]
Progress = Callable[[str, float], None]

# Blur (contrast over steepest slope, 2.5 sigma of a Gaussian) and half a pixel stay between a point and the
# nearest black.
_EDGE_WIDTHS, _EDGE_PX = 1.0, 0.5
_POINTS_A_SIDE = (12, 48)  # of the grid of points over a square
_FEWEST_POINTS, _FEWEST_SQUARES = 8, 8
# Light that comes and leaves within this of a mirror's angle may be a highlight, and beyond this angle of
# incidence paper is not matte (radians).
_HIGHLIGHT, _GRAZING = np.radians(8.0), np.radians(65.0)
# Less than this share of white, or of what the room sends, is no flash; pixels say no more.
_LEAST_LIGHT = 0.005
# The room's light may change by a little while the board moves by this share of a square between the two.
_LARGEST_MOVE = 0.5
# A board that is not found in the unlit picture must be dark there, else it has moved out of it.
_DARK_SHARE = 0.1
_LEAST_CORNER_NOISE_PX = 0.02
_LARGEST_MISFIT_PX = 2.0


class Refusal(Enum):
    """Why a pair is not used beyond the reasons for which a board is not found; the value is for people."""

    CLIPPED = "the white of the board is overexposed"
    NO_LIGHT = "the flash adds no light to the board"
    DARKER = "the picture with the flash is the darker one"
    SMALL = "the white around the markers is too narrow, or too blurred"
    MOVED = "the board moved between the two pictures"
    MISFIT = "the board does not lie where the lens would show a flat board"


@dataclass
class CollectedBoards:
    """What came of the pairs.

    Attributes:
        boards: the light of those used.
        pairs: their number.
        refused: how many were refused for what.
        closer_look: what is wrong with one of them, at leisure; "" where enough were used.
    """

    boards: list[LitBoard]
    pairs: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    closer_look: str = ""

    def describe(self) -> str:
        """One line for people."""
        parts = [f"{self.pairs} pairs", f"{len(self.boards)} used"]
        parts += [f"{count} where {why}" for why, count in self.refused.most_common()]
        return ", ".join(parts) + self.closer_look


@dataclass(frozen=True, eq=False)
class _Pose:
    """cam_from_board with the covariance of turn and place."""

    rotation: Floats
    translation: Floats
    covariance: Floats

    def points(self, points_m: Floats) -> Floats:
        moved: Floats = points_m @ self.rotation.T + self.translation
        return moved


def collect_boards(
    pairs: Iterable[FlashPair],
    count: int,
    board: Board,
    calibration: Calibration,
    progress: Progress = lambda stage, fraction: None,
) -> CollectedBoards:
    """The lit boards of all pairs, one pair at a time.

    Raises:
        FlashGeometryError: no intrinsics are known, or they are of another picture size.
    """
    lens = lens_vector(calibration.intrinsics)
    detector = BoardDetector(board)
    collected = CollectedBoards([])
    puzzle: LinearPicture | None = None
    for pair in pairs:
        _check_size(pair.lit, calibration)
        result = lit_board(pair, detector, lens, calibration.value("flat_field"))
        collected.pairs += 1
        if isinstance(result, LitBoard):
            collected.boards.append(result)
        else:
            collected.refused[result.value] += 1
            if puzzle is None and isinstance(result, Problem):
                puzzle = pair.lit
        progress("look for the board", collected.pairs / max(count, 1))
    if puzzle is not None and len(collected.boards) < collected.pairs / 2:
        problem, detail = detector.diagnose(_grey(puzzle))
        collected.closer_look = f"; in {puzzle.name} {problem.value}{detail}"
    return collected


def lens_vector(intrinsics: Intrinsics | None) -> Floats:
    """[9] of `calib.lens.projection`.

    Raises:
        FlashGeometryError: unknown, or with distortion terms that it does not have.
    """
    if intrinsics is None:
        raise FlashGeometryError(
            "The calibration has no intrinsics, without which the board's place is not known; run "
            "`relight calibrate intrinsics` first."
        )
    distortion = np.zeros(0) if intrinsics.distortion is None else intrinsics.distortion.value
    if distortion[LENS_SIZE - 4 :].any():
        raise FlashGeometryError(
            f"The intrinsics have {len(distortion)} distortion terms; a flash is found with lenses of at "
            f"most {LENS_SIZE - 4} (k1, k2, p1, p2, k3): use `relight calibrate intrinsics`."
        )
    lens = np.zeros(LENS_SIZE)
    lens[:4] = intrinsics.pinhole.value
    lens[4 : 4 + len(distortion)] = distortion[: LENS_SIZE - 4]
    return lens


def lit_board(
    pair: FlashPair, detector: BoardDetector, lens: Floats, flat_field: Floats | None = None
) -> LitBoard | Refusal | Problem:
    """The light of a pair's flash on the board, or why it is not told.

    Args:
        pair: the pictures.
        detector: of the board.
        lens: [9].
        flat_field: [n] a1, a2, ... as in `calib.calibration`; None or empty = none.
    """
    view = detector.look(_grey(pair.lit), pair.lit.name)
    if not isinstance(view, BoardView):
        # An overexposed board has no edges to be found by.
        return Refusal.CLIPPED if pair.lit.clipped.mean() > 0.2 else view.problem
    board = detector.board if view.layout == "both" else detector.board.with_layout(view.layout)
    pose = _pose_of(view, board, lens)
    if pose is None:
        return Refusal.MISFIT
    before = detector.look(_grey(pair.unlit), pair.unlit.name)
    unlit_pose = pose
    if isinstance(before, BoardView):
        unlit_pose = _pose_of(before, board, lens) or pose
        moved = np.abs(unlit_pose.points(board.corners_m) - pose.points(board.corners_m)).max()
        if moved > _LARGEST_MOVE * board.square_m:
            return Refusal.MOVED
    squares, points = _white_points(board, pose, lens, view)
    if len(np.unique(squares)) < _FEWEST_SQUARES:
        return Refusal.SMALL
    lit, lit_fine, pixels = _sampled(pair.lit, project(lens, pose.points(points)))
    unlit, unlit_fine, _ = _sampled(pair.unlit, project(lens, unlit_pose.points(points)))
    inside = pixels >= 0
    clipped = inside & ~(lit_fine & unlit_fine)
    if clipped.sum() > 0.5 * inside.sum():
        return Refusal.CLIPPED
    fine = lit_fine & unlit_fine & _matte(pose, points)
    if fine.sum() < _FEWEST_POINTS * _FEWEST_SQUARES:
        return Refusal.SMALL
    light = (lit - unlit) / _passed(flat_field, pixels, pair.lit.radiance.shape)[:, None]
    middle, room = float(np.median(light[fine].mean(1))), float(np.median(unlit[fine].mean(1)))
    if abs(middle) < max(_LEAST_LIGHT, 0.02 * room):
        return Refusal.NO_LIGHT
    if middle < 0:
        return Refusal.DARKER
    if not isinstance(before, BoardView) and room > _DARK_SHARE * middle:
        return Refusal.MOVED
    return _by_square(pair, pose, squares[fine], points[fine], light[fine], pixels[fine])


def _by_square(
    pair: FlashPair,
    pose: _Pose,
    squares: NDArray[np.int64],
    points: Floats,
    light: Floats,
    pixels: NDArray[np.int64],
) -> LitBoard | Refusal:
    """Means over each square."""
    normal = -pose.rotation[:, 2]
    usual, time = Light(), np.zeros(())
    numbers, middles, reaches, means, noises = [], [], [], [], []
    for square in np.unique(squares):
        chosen = squares == square
        distinct = len(np.unique(pixels[chosen]))
        mean = float(light[chosen].mean())
        if distinct < _FEWEST_POINTS or mean <= 0:
            continue
        places = pose.points(points[chosen])
        expected = np.exp(log_light(usual, places, normal, time))
        evened = light[chosen].mean(1) * expected.mean() / expected
        numbers.append(int(square))
        middles.append(places.mean(0))
        reaches.append(_reach(places))
        means.append(light[chosen].mean(0))
        noises.append(float(evened.std(ddof=1)) / np.sqrt(distinct) / mean)
    if len(numbers) < _FEWEST_SQUARES:
        return Refusal.SMALL
    return LitBoard(
        name=pair.lit.name,
        time_s=pair.time_s,
        points_cam=np.array(middles),
        reach_cam=np.array(reaches),
        normal_cam=normal,
        radiance=np.array(means),
        noise=np.maximum(np.array(noises), 1e-5),
        pose_covariance=pose.covariance,
        origin_cam=pose.translation,
        squares=np.array(numbers, dtype=np.int64),
    )


def _reach(places: Floats) -> Floats:
    """[4, 3] points in a plane with the mean and the second moments of places [n, 3] in it."""
    middle = places.mean(0)
    _, lengths, directions = np.linalg.svd(places - middle, full_matrices=False)
    arms = directions[:2] * (np.sqrt(2.0 / len(places)) * lengths[:2, None])
    reach: Floats = middle + np.concatenate([arms, -arms])
    return reach


def _pose_of(view: BoardView, board: Board, lens: Floats) -> _Pose | None:
    """The pose of a board; None where its corners do not lie on a plane seen through the lens."""
    corners = board.corners_m[view.ids]
    K = np.array([[lens[0], 0, lens[2] - 0.5], [0, lens[1], lens[3] - 0.5], [0, 0, 1]])  # integer centres
    seen = (view.corners_px - 0.5)[:, None]
    found, turns, places, errors = cv2.solvePnPGeneric(corners, seen, K, lens[4:], flags=cv2.SOLVEPNP_IPPE)
    if not found:
        return None
    best = int(np.argmin(np.ravel(errors)))
    turn, place = cv2.solvePnPRefineLM(corners, seen, K, lens[4:], turns[best], places[best])
    rotation = np.asarray(cv2.Rodrigues(turn)[0], np.float64)
    translation = np.ravel(place).astype(np.float64)
    arms = corners @ rotation.T
    if not np.isfinite(translation).all() or (arms[:, 2] + translation[2]).min() <= 0:
        return None
    pixels, _, by_point = project_with_slopes(lens, arms + translation)
    slopes = np.concatenate([np.cross(arms[:, None], by_point), by_point], axis=-1).reshape(-1, 6)
    off = (view.corners_px - pixels).ravel()
    noise_px = max(float(np.sqrt(off @ off / max(len(off) - 6, 1))), _LEAST_CORNER_NOISE_PX)
    if noise_px > _LARGEST_MISFIT_PX:
        return None
    return _Pose(rotation, translation, np.linalg.inv(slopes.T @ slopes) * noise_px**2)


def _white_points(
    board: Board, pose: _Pose, lens: Floats, view: BoardView
) -> tuple[NDArray[np.int64], Floats]:
    """[n] squares and [n, 3] points on their white, board axes, far enough from all black."""
    across, down = board.squares
    rows, columns = np.nonzero(~board.black_squares)
    numbers, points = [], []
    for row, column in zip(rows, columns, strict=True):
        middle = np.array([column + 0.5 - across / 2, row + 0.5 - down / 2, 0.0]) * board.square_m
        ends = middle + board.square_m / 2 * np.array([[-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0]])
        px = project(lens, pose.points(ends))
        # The narrowest that the square is seen.
        side_px = float(np.linalg.svd(np.stack([px[1] - px[0], px[3] - px[2]]), compute_uv=False)[1])
        margin = (_EDGE_WIDTHS * view.edge_width_px + _EDGE_PX) / max(side_px, 1e-6)
        low, high = board.marker_m / board.square_m / 2 + margin, 0.5 - margin
        if high <= low:
            continue
        count = int(np.clip(side_px, *_POINTS_A_SIDE))
        place = (np.arange(count) + 0.5) / count - 0.5
        # Where the strip is thin, points of an even grid may all miss it: some are put along its middle.
        ring = (low + high) / 2
        grid = np.stack(np.meshgrid(place, place), axis=-1).reshape(-1, 2)
        along = np.linspace(-ring, ring, count)
        sides = [(along, np.full(count, s)) for s in (-ring, ring)]
        sides += [(np.full(count, s), along) for s in (-ring, ring)]
        grid = np.concatenate([grid, *(np.stack(side, axis=-1) for side in sides)])
        reach = np.abs(grid).max(1)
        grid = grid[(reach >= low) & (reach <= high)]
        numbers.append(np.full(len(grid), row * across + column))
        points.append(middle + np.column_stack([grid, np.zeros(len(grid))]) * board.square_m)
    if not points:
        return np.zeros(0, np.int64), np.zeros((0, 3))
    return np.concatenate(numbers).astype(np.int64), np.concatenate(points)


def _matte(pose: _Pose, points: Floats) -> NDArray[np.bool_]:
    """[n] where neither a highlight of a flash near the lens nor grazing light is to be feared."""
    places = pose.points(points)
    cosine = np.abs(places @ pose.rotation[:, 2]) / np.linalg.norm(places, axis=1)
    matte: NDArray[np.bool_] = (cosine < np.cos(_HIGHLIGHT)) & (cosine > np.cos(_GRAZING))
    return matte


def _sampled(picture: LinearPicture, px: Floats) -> tuple[Floats, NDArray[np.bool_], NDArray[np.int64]]:
    """[n, 3] radiance of the pixels that points fall into, [n] whether these are good, and [n] which they
    are, row by row; -1 outside."""
    height, width = picture.clipped.shape
    column, row = np.floor(px).astype(np.int64).T
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    place = np.where(inside, row * width + column, 0)
    radiance = picture.radiance.reshape(-1, 3)[place].astype(np.float64)
    fine = inside & ~picture.clipped.reshape(-1)[place]
    return radiance, fine, np.where(inside, place, -1)


def _passed(flat_field: Floats | None, pixels: NDArray[np.int64], shape: tuple[int, ...]) -> Floats:
    """[n] share of the light that the lens passes to pixels."""
    if flat_field is None or not len(flat_field):
        return np.ones(len(pixels))
    height, width = shape[:2]
    x, y = pixels % width + 0.5 - width / 2, pixels // width + 0.5 - height / 2
    r2 = 4.0 * (x * x + y * y) / (width**2 + height**2)
    passed: Floats = 1.0 + sum(term * r2 ** (power + 1) for power, term in enumerate(flat_field))
    return np.maximum(passed, 0.05)


def _grey(picture: LinearPicture) -> NDArray[np.uint8]:
    """[H, W] of 8 bits to find a board in; what is dark is brought up, what is linear gets a curve."""
    stored = picture.stored
    if stored.dtype == np.float32:
        value = np.clip(np.nan_to_num(stored), 0.0, None)
        value = (value / max(float(np.percentile(value, 99.5)), 1e-6)).clip(0, 1) ** (1 / 2.2)
        stored = np.rint(255 * value).astype(np.uint8)
    elif stored.dtype == np.uint16:
        stored = (stored >> 8).astype(np.uint8)
    return np.ascontiguousarray(cv2.cvtColor(stored, cv2.COLOR_RGB2GRAY), dtype=np.uint8)


def _check_size(picture: LinearPicture, calibration: Calibration) -> None:
    known = calibration.intrinsics
    height, width = picture.clipped.shape
    if known is not None and (known.width, known.height) != (width, height):
        raise FlashGeometryError(
            f"{picture.name} is {width} x {height} pixels and the intrinsics are for {known.width} x "
            f"{known.height}; calibrate the lens in the mode in which the flash was filmed."
        )
