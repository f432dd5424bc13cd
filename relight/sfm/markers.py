"""Printed markers: corners that match in every light, and a length that is known.

ArUco and AprilTag markers (Garrido-Jurado et al. 2014; Wang & Olson 2016) and ChArUco boards. Each corner has
a label, the same in every frame, so that corners match without descriptors.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from relight.errors import GeometryError
from relight.sfm.pictures import marker_picture

logger = logging.getLogger(__name__)

# The larger dictionary of a family holds the smaller one; 16h5 is left out: it finds markers in any texture.
DICTIONARIES = ("DICT_4X4_250", "DICT_5X5_250", "DICT_6X6_250", "DICT_ARUCO_ORIGINAL", "DICT_APRILTAG_36h11")

_LEAST_SIGHTINGS = 2  # of the same marker, in the frames that are tried, before a dictionary is believed
_LEAST_SIDE_PX = 12.0
_CORNER_LABELS = 4
_LEAST_LENGTHS = 2  # known lengths that must agree before they give the unit
_AGREEMENT = 0.03  # median deviation of the lengths' ratios
_NO_PLACES = np.zeros((0, 2))
_NO_LABELS = np.zeros(0, np.int64)


@dataclass(frozen=True)
class Board:
    """A ChArUco board.

    Attributes:
        columns, rows: Squares.
        square_m, marker_m: Sides, metres.
        dictionary: OpenCV's name.
    """

    columns: int
    rows: int
    square_m: float
    marker_m: float
    dictionary: str

    @classmethod
    def parse(cls, text: str) -> Board:
        """From "COLUMNSxROWS:SQUARE_M:MARKER_M:DICTIONARY".

        Raises:
            ValueError: of another form, or impossible.
        """
        match = re.fullmatch(r"(\d+)x(\d+):([\d.]+):([\d.]+):(DICT_\w+)", text)
        if match is None:
            raise ValueError(f"The board {text!r} is not of the form 7x10:0.025:0.018:DICT_5X5_250.")
        board = cls(int(match[1]), int(match[2]), float(match[3]), float(match[4]), match[5])
        if not hasattr(cv2.aruco, board.dictionary):
            raise ValueError(
                f"The dictionary {board.dictionary!r} is unknown; try {', '.join(DICTIONARIES)}."
            )
        if min(board.columns, board.rows) < 2 or not 0.0 < board.marker_m < board.square_m:
            raise ValueError(f"The board {text!r} needs 2 x 2 squares, and markers smaller than its squares.")
        return board

    @property
    def corners_m(self) -> NDArray[np.float64]:
        """[C, 2] places of the inner corners on the board, metres, by corner number."""
        j, i = np.mgrid[1 : self.rows, 1 : self.columns]
        return np.stack([i.ravel(), j.ravel()], axis=1) * self.square_m


@dataclass(eq=False)
class MarkerFinder:
    """Finds printed corners in frames; which markers there are is found out once, by `choose`.

    Attributes:
        board: The board to look for; None = single markers of any common dictionary.
        dictionaries: Names of those that were seen.
    """

    board: Board | None = None
    dictionaries: tuple[str, ...] = ()
    _charuco: cv2.aruco.CharucoDetector | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        if self.board is not None:
            shape = (self.board.columns, self.board.rows)
            made = cv2.aruco.CharucoBoard(
                shape, self.board.square_m, self.board.marker_m, _dictionary(self.board.dictionary)
            )
            self._charuco = cv2.aruco.CharucoDetector(made)

    def choose(self, greys: Sequence[NDArray[np.float32]]) -> None:
        """Keeps the dictionaries of which a marker is in several of some frames [h, w]."""
        if self.board is not None:
            return
        kept = []
        for name in DICTIONARIES:
            sightings: dict[int, int] = {}
            for grey in greys:
                for number in _markers(marker_picture(grey), name):
                    sightings[number] = sightings.get(number, 0) + 1
            if max(sightings.values(), default=0) >= _LEAST_SIGHTINGS:
                kept.append(name)
        self.dictionaries = tuple(kept)

    def find(self, grey: NDArray[np.float32]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Corners [N, 2] in pixels (centres at 0.5) of a frame [h, w], and their labels [N]."""
        if self._charuco is not None:
            corners, numbers = self._charuco.detectBoard(marker_picture(grey))[:2]
            if numbers is None or not len(numbers):
                return _NO_PLACES, _NO_LABELS
            return corners.reshape(-1, 2).astype(np.float64) + 0.5, numbers.ravel().astype(np.int64)
        places, labels = [], []
        for position, name in enumerate(self.dictionaries):
            for number, corners in _markers(marker_picture(grey), name).items():
                places.append(corners)
                first = _CORNER_LABELS * (position * 100_000 + number)
                labels.append(np.arange(first, first + _CORNER_LABELS))
        if not places:
            return _NO_PLACES, _NO_LABELS
        return np.concatenate(places), np.concatenate(labels).astype(np.int64)


def metres_per_unit(
    corners_world: Mapping[int, NDArray[np.float64]], board: Board | None, marker_side_m: float | None
) -> tuple[float, str] | None:
    """The length of a world unit in metres, from printed corners of known distance, and how it was found.

    Args:
        corners_world: Label to [3].
        board: The board, when one was looked for.
        marker_side_m: Side of single markers.

    Returns:
        None where no known length was reconstructed.

    Raises:
        GeometryError: the lengths contradict each other: another board, or markers of several sizes.
    """
    ratios = []
    if board is not None:
        places_m = board.corners_m
        labels = sorted(label for label in corners_world if label < len(places_m))
        for position, a in enumerate(labels):
            for b in labels[position + 1 :]:
                length_m = float(np.linalg.norm(places_m[a] - places_m[b]))
                if length_m >= 2.0 * board.square_m - 1e-9:  # long ones err least
                    ratios.append(length_m / float(np.linalg.norm(corners_world[a] - corners_world[b])))
        source = f"a ChArUco board with squares of {1000 * board.square_m:g} mm"
    elif marker_side_m is not None:
        for label in corners_world:
            following = label + 1 if label % _CORNER_LABELS < _CORNER_LABELS - 1 else label - 3
            if following in corners_world:
                side = float(np.linalg.norm(corners_world[label] - corners_world[following]))
                ratios.append(marker_side_m / side)
        source = f"printed markers with sides of {1000 * marker_side_m:g} mm"
    if len(ratios) < _LEAST_LENGTHS:
        return None
    ratio = float(np.median(ratios))
    spread = float(np.median(np.abs(np.array(ratios) / ratio - 1.0)))
    if not spread < _AGREEMENT:
        raise GeometryError(
            f"The lengths on {source} contradict each other by {100 * spread:.1f} % (limit "
            f"{100 * _AGREEMENT:g} %); state the size of what was printed, and print all markers at one size."
        )
    return ratio, f"{source} ({len(ratios)} lengths, agreeing to {100 * spread:.2f} %)"


def _dictionary(name: str) -> cv2.aruco.Dictionary:
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def _markers(picture: NDArray[np.uint8], name: str) -> dict[int, NDArray[np.float64]]:
    """Number to corners [4, 2] of the markers of a dictionary that a picture shows exactly once."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    parameters.errorCorrectionRate = 0.0  # a marker read with errors is more often a texture
    found, numbers, _ = cv2.aruco.ArucoDetector(_dictionary(name), parameters).detectMarkers(picture)
    seen: dict[int, NDArray[np.float64]] = {}
    twice = set()
    listed = [] if numbers is None else [int(number) for number in np.asarray(numbers).ravel()]
    for corners, number in zip(found, listed, strict=False):
        places = np.asarray(corners, np.float64).reshape(4, 2)
        sides = np.linalg.norm(places - np.roll(places, 1, axis=0), axis=1)
        if float(sides.min()) < _LEAST_SIDE_PX:
            continue
        if number in seen:
            twice.add(number)
        seen[number] = places + 0.5
    return {number: places for number, places in seen.items() if number not in twice}
