"""Finds the corners of a ChArUco board in one picture, in either layout, or says why there are none.

Markers are found once; for each layout the arrangement of the markers decides whether it is that board
(OpenCV interpolates corners from a few markers without asking), and OpenCV's CharucoDetector then finds the
corners. They are refined once more, each in the largest window that no marker reaches into: OpenCV's own
window lets the corner of a marker in on large squares, which pulls by up to a quarter of a pixel. Large
pictures are searched for markers at reduced size and refined at full size.

OpenCV's pixel centres are integers; the half pixel is added here, where its numbers enter, and nowhere else.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.board.charuco import LAYOUTS, Board, marker_dictionary

Grey = NDArray[np.uint8]

# Markers are searched for in pictures of at most this length (pixels): the time goes with the area, and
# markers of a board that is near enough to calibrate with are tens of pixels even then.
_SEARCHED_SIDE = 1280
_FEWEST_MARKERS, _FEWEST_CORNERS = 4, 8
# Neighbouring markers (up to this many squares apart) lie where one says the other should be, to within this
# share of a square; of a board that is recognised nearly all do, of one with rows shifted about half.
_NEIGHBOUR_SQUARES, _IN_PLACE_SHARE = 2.1, 0.5
_AGREEING_PAIRS = 0.75
# An edge over this share of a square (and this many pixels) is no corner's any more: the refinement then sees
# the markers' edges. A sharp edge is 1.5 to 2.5 px wide.
_BLURRED_SHARE, _BLURRED_PX = 0.2, 3.0
_BLURRED_PICTURE_PX = 5.0
_WINDOW_PX = (2, 15)  # half a side of the refinement's window
_REFINEMENT = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 40, 1e-3)
_SAMPLES_A_PX = 4.0  # of an edge's profile
# One family of each kind; the smaller ones of a kind are its first markers.
_FAMILIES = (
    "DICT_4X4_250",
    "DICT_5X5_250",
    "DICT_6X6_250",
    "DICT_7X7_250",
    "DICT_ARUCO_ORIGINAL",
    "DICT_ARUCO_MIP_36H12",
    "DICT_APRILTAG_36H11",
    "DICT_APRILTAG_25H9",
)


class Problem(Enum):
    """Why a picture gives no view; the value is said to people."""

    NO_BOARD = "no board was found"
    PARTIAL = "too little of the board was seen"
    BLURRED = "the picture is blurred"
    MIRRORED = "the picture is mirrored"
    OTHER_BOARD = "the markers are not arranged as on this board"
    OTHER_MARKERS = "the markers are of another dictionary"


@dataclass(frozen=True, eq=False)
class BoardView:
    """A board as one picture shows it.

    Attributes:
        name: of the picture.
        size: (width, height) of the picture.
        ids: [n] numbers of the corners, ascending.
        corners_px: [n, 2] where they are; pixel centres at 0.5.
        edge_width_px: contrast over steepest slope of the squares' edges, of the blurrier direction.
        layout: "current", "legacy", or "both" where these are the same.
    """

    name: str
    size: tuple[int, int]
    ids: NDArray[np.int64]
    corners_px: NDArray[np.float64]
    edge_width_px: float
    layout: str


@dataclass(frozen=True, eq=False)
class Failure:
    """A picture that gives no view.

    Attributes:
        problem: what is wrong, as far as a quick look tells.
        candidates: number of four-sided shapes that could have been markers.
    """

    problem: Problem
    candidates: int


class BoardDetector:
    """Looks for one board in pictures."""

    def __init__(self, board: Board) -> None:
        self.board = board
        same = np.array_equal(
            board.with_layout("current").black_squares, board.with_layout("legacy").black_squares
        )
        self._layouts = ("both",) if same else LAYOUTS
        self._boards = {name: board if same else board.with_layout(name) for name in self._layouts}
        self._charuco = {
            name: cv2.aruco.CharucoDetector(made.to_opencv()) for name, made in self._boards.items()
        }
        self._markers = cv2.aruco.ArucoDetector(marker_dictionary(board.dictionary))

    def look(self, grey: Grey, name: str) -> BoardView | Failure:
        """The board in a picture, [H, W]."""
        markers, ids, rejected = _find_markers(self._markers, grey)
        candidates = len(ids) + rejected
        if len(ids) < _FEWEST_MARKERS:
            return Failure(Problem.PARTIAL if len(ids) else Problem.NO_BOARD, candidates)
        layout, in_place = self._layout_of(markers, ids)
        if layout is None:
            return Failure(Problem.OTHER_BOARD, candidates)
        corners, corner_ids, _, _ = self._charuco[layout].detectBoard(
            grey, None, None, [marker[None] for marker in markers[in_place]], ids[in_place][:, None]
        )
        if corner_ids is None or len(corner_ids) < _FEWEST_CORNERS:
            return Failure(Problem.PARTIAL, candidates)
        order = np.argsort(corner_ids.ravel())
        found = corner_ids.ravel()[order].astype(np.int64)
        places = self.board.corners_m[found, :2]
        # Corners along one line fix no pose: the second extent must be most of a square.
        if np.linalg.svd(places - places.mean(0), compute_uv=False)[1] < self.board.square_m:
            return Failure(Problem.PARTIAL, candidates)
        opencv_px = _refined(
            grey,
            self._boards[layout],
            found,
            np.asarray(corners, np.float32).reshape(-1, 2)[order],
            (markers[in_place], ids[in_place]),
        )
        width_px, square_px = _edge_width(grey, self.board, found, opencv_px)
        if width_px > max(_BLURRED_PX, _BLURRED_SHARE * square_px):
            return Failure(Problem.BLURRED, candidates)
        height, width = grey.shape
        return BoardView(name, (width, height), found, opencv_px + 0.5, width_px, layout)

    def diagnose(self, grey: Grey) -> tuple[Problem, str]:
        """What is wrong with a picture that `look` refuses, at leisure; with a detail for people or ''."""
        result = self.look(grey, "")
        problem = result.problem if isinstance(result, Failure) else Problem.NO_BOARD
        if problem is Problem.BLURRED:
            return problem, ""
        mirrored = np.ascontiguousarray(grey[:, ::-1])
        markers, ids, _ = _find_markers(self._markers, mirrored)
        if len(ids) >= _FEWEST_MARKERS and self._layout_of(markers, ids)[0] is not None:
            return Problem.MIRRORED, ""
        if problem is Problem.OTHER_BOARD:
            _, ids, _ = _find_markers(self._markers, grey)
            largest = int(ids.max())
            beyond = f": marker {largest} was seen, and it has only {self.board.marker_count}"
            return problem, beyond if largest >= self.board.marker_count else ""
        counts = {name: self._count_markers(grey, name) for name in _FAMILIES}
        best = max(counts, key=lambda name: counts[name])
        kind = self.board.dictionary.rsplit("_", 1)[0]
        if counts[best] >= 2 * _FEWEST_MARKERS and not best.startswith(kind):
            return Problem.OTHER_MARKERS, f": {counts[best]} of the family {best} were seen"
        if _picture_edge_width(grey) > _BLURRED_PICTURE_PX:
            return Problem.BLURRED, ""
        return problem, ""

    def _count_markers(self, grey: Grey, dictionary: str) -> int:
        detector = cv2.aruco.ArucoDetector(marker_dictionary(dictionary))
        return len(set(_find_markers(detector, grey)[1].tolist()))

    def _layout_of(
        self, markers: NDArray[np.float32], ids: NDArray[np.int32]
    ) -> tuple[str | None, NDArray[np.bool_]]:
        """The layout in which the markers lie where they should, and which of them do."""
        best, best_share, best_in_place = None, 0.0, np.zeros(len(ids), bool)
        for name, board in self._boards.items():
            share, in_place = _in_place(board, markers, ids)
            if share > best_share:
                best, best_share, best_in_place = name, share, in_place
        enough = best_share >= _AGREEING_PAIRS and best_in_place.sum() >= _FEWEST_MARKERS
        return (best if enough else None), best_in_place


def _find_markers(detector: Any, grey: Grey) -> tuple[NDArray[np.float32], NDArray[np.int32], int]:
    """[m, 4, 2] corners of markers in OpenCV's pixels, [m] ids, and the number of other candidates."""
    factor = _SEARCHED_SIDE / max(grey.shape)
    searched = (
        cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA) if factor < 1 else grey
    )
    corners, ids, rejected = detector.detectMarkers(searched)
    if ids is None or len(ids) == 0:
        return np.zeros((0, 4, 2), np.float32), np.zeros(0, np.int32), len(rejected)
    stacked = np.concatenate([corner.reshape(1, 4, 2) for corner in corners])
    if factor < 1:
        scale = np.array(grey.shape[::-1]) / np.array(searched.shape[::-1])
        stacked = ((stacked + 0.5) * scale - 0.5).astype(np.float32)
    return stacked, ids.ravel(), len(rejected)


def _in_place(
    board: Board, markers: NDArray[np.float32], ids: NDArray[np.int32]
) -> tuple[float, NDArray[np.bool_]]:
    """Share of neighbouring markers that lie to each other as on the board, and [m] which markers do.

    Each marker's own corners say where its neighbours should be. Over so short a way neither the lens nor
    perspective bend much, and a marker of another arrangement is a whole square off.
    """
    expected_m = board.marker_corners_m
    in_place = np.zeros(len(ids), bool)
    known = np.nonzero(ids < len(expected_m))[0]
    if len(known) < _FEWEST_MARKERS:
        return 0.0, in_place
    plan, seen = expected_m[ids[known]], markers[known].astype(np.float64)
    plan_middle, seen_middle = plan.mean(1), seen.mean(1)
    # Affine map of each marker, by least squares over its corners: those of a square are orthogonal.
    offsets = plan - plan_middle[:, None]
    px_per_m = np.einsum("mci,mcj->mij", seen - seen_middle[:, None], offsets) / board.marker_m**2
    way_m = plan_middle[None] - plan_middle[:, None]
    predicted = seen_middle[:, None] + np.einsum("aij,abj->abi", px_per_m, way_m)
    off_px = np.linalg.norm(predicted - seen_middle[None], axis=2)
    side_px = np.sqrt(np.abs(np.linalg.det(px_per_m))) * board.square_m
    agrees = off_px < _IN_PLACE_SHARE * side_px[:, None]
    agrees |= agrees.T
    near = np.linalg.norm(way_m, axis=2) < _NEIGHBOUR_SQUARES * board.square_m
    np.fill_diagonal(near, False)
    if not near.any():
        return 0.0, in_place
    votes = (agrees & near).sum(1) / np.maximum(near.sum(1), 1)
    in_place[known] = votes > 0.5
    # A false marker among true ones disagrees with all; it should not cost the board its name.
    sound = near & in_place[known][:, None] & in_place[known]
    share = float((agrees & sound).sum() / max(sound.sum(), 1)) * float(in_place.sum() / len(ids))
    return share, in_place


def _refined(
    grey: Grey,
    board: Board,
    ids: NDArray[np.int64],
    opencv_px: NDArray[np.float32],
    markers: tuple[NDArray[np.float32], NDArray[np.int32]],
) -> NDArray[np.float64]:
    """[n, 2] corners to where the edges around them meet, in the largest window without a marker in it."""
    px_from_board, _ = cv2.findHomography(board.corners_m[ids, :2], opencv_px.astype(np.float64), 0)
    flat_m = board.marker_corners_m.reshape(-1, 2)
    # Where they were not found, markers are where a homography puts them.
    marker_px = cv2.perspectiveTransform(flat_m[:, None], px_from_board).reshape(-1, 4, 2)
    marker_px[markers[1]] = markers[0]
    off_m = np.linalg.norm(flat_m - board.corners_m[ids, None, :2], axis=2)
    nearest = np.argsort(off_m, axis=1, kind="stable")[:, :2]  # two markers touch a corner, or one
    there = marker_px.reshape(-1, 2)[nearest]
    # The window is a square: its own corners are what comes nearest. An edge's blur is another pixel.
    distance = np.linalg.norm(there - opencv_px[:, None], axis=2).min(1)
    reach = np.clip(((distance - 1.0) / np.sqrt(2.0)).astype(int), *_WINDOW_PX)
    refined = opencv_px.astype(np.float64)
    for window in np.unique(reach):
        part = np.ascontiguousarray(opencv_px[reach == window], dtype=np.float32)[:, None]
        moved = cv2.cornerSubPix(grey, part.copy(), (int(window), int(window)), (-1, -1), _REFINEMENT)
        close = np.linalg.norm(moved - part, axis=2) < window
        refined[reach == window] = np.where(close, moved[:, 0], part[:, 0])
    return refined


def _edge_width(
    grey: Grey, board: Board, ids: NDArray[np.int64], opencv_px: NDArray[np.float64]
) -> tuple[float, float]:
    """Width of the squares' edges (of the blurrier direction), and the side of a square, in pixels.

    Across the middle of the side between two neighbouring corners the picture goes from the black of one
    square to the white around the marker of the other; contrast over the steepest slope is the width.
    """
    across = board.squares[0] - 1
    place = {int(number): position for position, number in enumerate(ids)}
    reach = 0.9 * (board.square_m - board.marker_m) / board.square_m / 2  # share of a square that is white
    widths, sides = [], []
    for step in (1, across):
        pairs = [
            (position, place[number + step])
            for number, position in place.items()
            if number + step in place and (step > 1 or number % across < across - 1)
        ]
        if not pairs:
            continue
        first, second = opencv_px[np.array(pairs).T]
        along = second - first
        sides.append(np.linalg.norm(along, axis=1))
        samples = 2 * int(np.clip(reach * sides[-1].max() * _SAMPLES_A_PX, 8, 500)) + 1
        offsets = np.linspace(-reach, reach, samples)
        normal = np.stack([-along[:, 1], along[:, 0]], axis=1)
        points = ((first + second) / 2)[:, None] + normal[:, None] * offsets[:, None]
        x, y = np.moveaxis(points.astype(np.float32), -1, 0)
        profiles = cv2.remap(grey, x, y, cv2.INTER_LINEAR).astype(np.float64)
        spacing_px = sides[-1] * (offsets[1] - offsets[0])
        slope = np.abs(np.diff(profiles, axis=1)).max(1) / spacing_px
        contrast = np.ptp(profiles, axis=1)
        seen = contrast > 10
        if seen.any():
            widths.append(float(np.median(contrast[seen] / slope[seen])))
    if not widths:
        return float("inf"), 1.0
    return max(widths), float(np.median(np.concatenate(sides)))


def _picture_edge_width(grey: Grey) -> float:
    """Contrast of a whole picture over its steepest slopes, pixels: how wide its sharpest edges are."""
    small = cv2.GaussianBlur(grey, (0, 0), 0.7).astype(np.float32)
    slope = np.hypot(np.diff(small, axis=1)[:-1], np.diff(small, axis=0)[:, :-1])
    steepest = float(np.percentile(slope, 99.9))
    low, high = np.percentile(small, [1, 99])
    return float((high - low) / steepest) if steepest > 0 else float("inf")


def most_common(problems: Sequence[Problem]) -> Problem:
    """The problem that most pictures have; of equally common ones that of the earlier picture."""
    return max(problems, key=problems.count)
