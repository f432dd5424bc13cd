"""The ChArUco board: a chessboard whose white squares hold coded markers, so that every corner has a name.

Board axes: origin at the middle of the board, x right, y down, z into it, metres, as seen from the front. The
inner chessboard corners are numbered row by row from the top left one.

Two layouts exist. Since OpenCV 4.6 the top left square is black; before, and on boards of calib.io, it is
white when the number of rows is even. With an odd number they are the same (OpenCV issue 23152).

    {"schema": "relight-board", "version": 1, "squares": [7, 10], "square_m": 0.025, "marker_m": 0.018,
     "dictionary": "DICT_5X5_250", "layout": "current"}
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.errors import BoardError
from capture.atomic import atomic_write
from capture.json_fields import read_json

SCHEMA = "relight-board"
SCHEMA_VERSION = 1
LAYOUTS = ("current", "legacy")
_KEYS = {"schema", "version", "squares", "square_m", "marker_m", "dictionary", "layout"}

#: Families of markers by name; OpenCV spells those of AprilTag twice.
DICTIONARIES = tuple(
    sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_") and name == name.upper())
)
_FEWEST_SQUARES, _MOST_SQUARES = 3, 60
_SHORTEST_M, _LONGEST_M = 1e-4, 10.0
# A marker that fills its square leaves no white around it, without which it is not found.
_LARGEST_MARKER_SHARE = 0.95


@dataclass(frozen=True)
class Board:
    """A ChArUco board.

    Attributes:
        squares: (across, down).
        square_m: side of a chessboard square.
        marker_m: side of a marker, its black border included.
        dictionary: a name of `DICTIONARIES`.
        layout: "current" or "legacy"; see the module.

    Raises:
        BoardError: no such board can be made.
    """

    squares: tuple[int, int] = (7, 10)
    square_m: float = 0.025
    marker_m: float = 0.018
    dictionary: str = "DICT_5X5_250"
    layout: str = "current"

    def __post_init__(self) -> None:
        across, down = self.squares
        if not (_FEWEST_SQUARES <= across <= _MOST_SQUARES and _FEWEST_SQUARES <= down <= _MOST_SQUARES):
            raise BoardError(
                f"A board has {_FEWEST_SQUARES} to {_MOST_SQUARES} squares a side, not {across} x {down}."
            )
        if not _SHORTEST_M <= self.square_m <= _LONGEST_M:
            raise BoardError(f"The squares are {self.square_m * 1e3:g} mm; 0.1 mm to 10 m can be used.")
        if not 0 < self.marker_m <= _LARGEST_MARKER_SHARE * self.square_m:
            raise BoardError(
                f"The markers are {self.marker_m * 1e3:g} mm; they need white around them: at most "
                f"{_LARGEST_MARKER_SHARE * self.square_m * 1e3:g} mm in squares of {self.square_m * 1e3:g} "
                "mm."
            )
        if self.dictionary not in DICTIONARIES:
            raise BoardError(
                f"The dictionary {self.dictionary!r} is unknown; there are {', '.join(DICTIONARIES)}."
            )
        if self.layout not in LAYOUTS:
            raise BoardError(f"The layout {self.layout!r} is unknown; there are {' and '.join(LAYOUTS)}.")
        held = len(marker_dictionary(self.dictionary).bytesList)
        if self.marker_count > held:
            raise BoardError(
                f"{across} x {down} squares need {self.marker_count} markers; {self.dictionary} has {held}: "
                "name a larger dictionary or fewer squares."
            )

    @property
    def marker_count(self) -> int:
        """Number of white squares, each with a marker numbered from 0, row by row."""
        return int((~self.black_squares).sum())

    @property
    def black_squares(self) -> NDArray[np.bool_]:
        """[down, across] whether a square is black."""
        across, down = self.squares
        odd: NDArray[np.bool_] = (np.arange(across) + np.arange(down)[:, None]) % 2 == 1
        return odd if self.layout == "legacy" and down % 2 == 0 else ~odd

    @property
    def corners_m(self) -> NDArray[np.float64]:
        """[(across - 1) * (down - 1), 3] inner corners in board axes."""
        across, down = self.squares
        x, y = np.meshgrid(np.arange(1, across) - across / 2, np.arange(1, down) - down / 2)
        return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1) * self.square_m

    @property
    def marker_corners_m(self) -> NDArray[np.float64]:
        """[markers, 4, 2] corners of each marker from its top left one clockwise, in board axes."""
        across, down = self.squares
        row, column = np.nonzero(~self.black_squares)
        centre = (np.stack([column, row], axis=1) + 0.5 - np.array([across, down]) / 2) * self.square_m
        around = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * self.marker_m / 2
        corners: NDArray[np.float64] = centre[:, None] + around
        return corners

    def with_layout(self, layout: str) -> Board:
        """The same board in a layout."""
        return Board(self.squares, self.square_m, self.marker_m, self.dictionary, layout)

    def to_opencv(self) -> Any:
        """OpenCV's object of it (whose own axes start at the board's top left corner)."""
        made = cv2.aruco.CharucoBoard(
            self.squares, self.square_m, self.marker_m, marker_dictionary(self.dictionary)
        )
        made.setLegacyPattern(self.layout == "legacy")
        return made

    def describe(self) -> str:
        """One line for people, as it is printed on the board."""
        legacy = ", legacy layout" if self.layout == "legacy" else ""
        return (
            f"ChArUco {self.squares[0]} x {self.squares[1]} squares of {self.square_m * 1e3:g} mm, "
            f"markers {self.marker_m * 1e3:g} mm, {self.dictionary}{legacy}"
        )

    def to_json(self) -> dict[str, Any]:
        """What board.json holds."""
        return {
            "schema": SCHEMA,
            "version": SCHEMA_VERSION,
            "squares": list(self.squares),
            "square_m": self.square_m,
            "marker_m": self.marker_m,
            "dictionary": self.dictionary,
            "layout": self.layout,
        }


def marker_dictionary(name: str) -> Any:
    """OpenCV's dictionary of a name of `DICTIONARIES`."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def save_board(board: Board, path: Path) -> None:
    """Writes a board.json."""
    atomic_write(path, json.dumps(board.to_json(), indent=2).encode() + b"\n")


def load_board(path: Path) -> Board:
    """Reads a board.json.

    Raises:
        BoardError: missing, malformed, or of a board that cannot be.
    """
    entries = read_json(Path(path), BoardError)
    if entries.text("schema", "") != SCHEMA:
        raise entries.fail(f"the schema is {entries.text('schema', '')!r}, not {SCHEMA!r}.")
    if (version := entries.integer("version", low=1)) > SCHEMA_VERSION:
        raise entries.fail(
            f"it was written by a newer program (schema version {version}; this one knows {SCHEMA_VERSION}); "
            "update the program."
        )
    if unknown := sorted(entries.values.keys() - _KEYS):
        raise entries.fail(f"the entry {unknown[0]!r} is unknown (known: {', '.join(sorted(_KEYS))}).")
    squares = entries.array("squares", (2,))
    if not np.array_equal(squares, np.round(squares)) or not (np.abs(squares) < 1e6).all():
        raise entries.fail('"squares" must be two whole numbers.')
    try:
        return Board(
            squares=(int(squares[0]), int(squares[1])),
            square_m=entries.number("square_m"),
            marker_m=entries.number("marker_m"),
            dictionary=entries.text("dictionary"),
            layout=entries.text("layout", "current"),
        )
    except BoardError as cause:
        raise entries.fail(str(cause)) from cause
