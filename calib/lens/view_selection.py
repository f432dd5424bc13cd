"""Which views of a board a calibration is made of: different poses, all of the picture, the sharpest of each.

Views come one at a time and a fixed number is kept, so a long film takes no more memory than a short one.
When one too many is there, the two most similar are found and the worse of them goes, unless a part of the
picture would be left that only it covers.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.board.charuco import Board
from calib.board.detection import BoardView

# Poses nearer than this are one pose seen twice: 4 % of the picture's diagonal, 2 degrees, 4 % of the
# distance.
_SAME_POSE = 0.04
_ROLL_WEIGHT = 0.2  # turning the board in its own plane tells less than tilting it
_GRID = (8, 6)
_ROUGH_FOCAL = 1.2  # of the longer side: only to compare poses with each other


@dataclass(frozen=True, eq=False)
class _Kept:
    view: BoardView
    pose: NDArray[np.float64]
    cells: frozenset[int]
    worth: float


class ViewShelf:
    """Keeps the best views.

    Args:
        board: what they show.
        capacity: how many are kept at most.
    """

    def __init__(self, board: Board, capacity: int = 60) -> None:
        self._board = board
        self._capacity = capacity
        self._kept: list[_Kept] = []
        self.repeated = 0

    def add(self, view: BoardView) -> None:
        """Takes a view in; it, or one that it makes needless, may go."""
        new = _Kept(view, _rough_pose(view, self._board), _cells(view), _worth(view))
        if self._kept:
            distances = [float(np.linalg.norm(new.pose - kept.pose)) for kept in self._kept]
            nearest = int(np.argmin(distances))
            if distances[nearest] < _SAME_POSE:
                self.repeated += 1
                if new.worth > self._kept[nearest].worth:
                    self._kept[nearest] = new
                return
        self._kept.append(new)
        if len(self._kept) > self._capacity:
            self._drop_one()

    @property
    def views(self) -> list[BoardView]:
        """Those kept, in the order in which they came."""
        return [kept.view for kept in self._kept]

    def _drop_one(self) -> None:
        poses = np.array([kept.pose for kept in self._kept])
        distances = np.linalg.norm(poses[:, None] - poses, axis=2)
        distances[np.tril_indices(len(poses))] = np.inf
        for pair in np.argsort(distances, axis=None, kind="stable")[: len(poses)]:
            couple = sorted(np.unravel_index(pair, distances.shape), key=lambda at: self._kept[at].worth)
            for worse in couple:
                others = frozenset().union(*(k.cells for i, k in enumerate(self._kept) if i != worse))
                if self._kept[worse].cells <= others:
                    del self._kept[worse]
                    return
        worst = min(range(len(self._kept)), key=lambda at: self._kept[at].worth)
        del self._kept[worst]


def _worth(view: BoardView) -> float:
    """Information, relative: corners over the variance of each, which goes with the width of the edges."""
    return len(view.ids) / view.edge_width_px**2


def _cells(view: BoardView) -> frozenset[int]:
    """Numbers of the parts of the picture that the corners lie in."""
    column, row = np.floor(view.corners_px / view.size * _GRID).astype(int).T
    inside = np.clip(row, 0, _GRID[1] - 1) * _GRID[0] + np.clip(column, 0, _GRID[0] - 1)
    return frozenset(inside.tolist())


def _rough_pose(view: BoardView, board: Board) -> NDArray[np.float64]:
    """[7] place in the picture, log distance, normal and turn, of a camera with an ordinary focal length."""
    width, height = view.size
    focal = _ROUGH_FOCAL * max(width, height)
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    _, rotation_vector, translation = cv2.solvePnP(
        board.corners_m[view.ids], view.corners_px, K, None, flags=cv2.SOLVEPNP_IPPE
    )
    rotation = cv2.Rodrigues(rotation_vector)[0]
    place = view.corners_px.mean(0) / np.hypot(width, height)
    turn = np.arctan2(rotation[1, 0], rotation[0, 0])
    return np.array(
        [
            *place,
            np.log(max(float(np.linalg.norm(translation)), 1e-9)),
            rotation[0, 2],
            rotation[1, 2],
            _ROLL_WEIGHT * np.cos(turn),
            _ROLL_WEIGHT * np.sin(turn),
        ]
    )
