"""Printed ArUco markers of a known size, on the walls or on a folding screen behind the head.

Of OpenCV's dictionary DICT_4X4_50: six modules a side with the black border, on white paper one module wider.
Corners are in OpenCV's order, from the marker's top left clockwise as it is seen.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from capture.sim.furniture import BACK, LEFT, RIGHT, Panel
from capture.sim.room_textures import plain_texture

DICTIONARY = "DICT_4X4_50"
_MODULES = 6
_TEXELS = 8  # a module: finer than a phone's pixel at the distance that a marker's size is for
_PAPER, _INK, _BOARD = 0.78, 0.035, (0.42, 0.41, 0.39)
_OFF_M = 0.02  # of the paper before a wall and its pictures
_OFF_BOARD_M = 0.004

# The screen's edges from above, x and z, metres: behind the head, out of sight of a camera beside it.
_SCREEN = np.array([[-0.42, -0.12], [-0.28, -0.45], [0.28, -0.45], [0.42, -0.12]])
_SCREEN_TOP, _SCREEN_BOTTOM = 0.36, -0.52


@dataclass(frozen=True, eq=False)
class Marker:
    """A marker as it hangs in the room.

    Attributes:
        number: in the dictionary.
        corners: [4, 3] of its black square, metres, the room's axes.
    """

    number: int
    corners: np.ndarray


def wall_markers(side_m: float) -> tuple[list[Panel], list[Marker]]:
    """Two rows of markers on the back wall and on both sides; furniture hides some of them."""
    places = [
        ((x, y, BACK + _OFF_M), (1.0, 0.0, 0.0)) for y in (0.42, -0.2) for x in np.linspace(-1.35, 1.35, 7)
    ]
    for x, right in ((LEFT + _OFF_M, (0.0, 0.0, -1.0)), (RIGHT - _OFF_M, (0.0, 0.0, 1.0))):
        places += [((x, y, z), right) for y in (0.42, -0.2) for z in np.linspace(-1.3, 0.9, 6)]
    return _hang(places, side_m)


def screen_markers(side_m: float) -> tuple[list[Panel], list[Marker]]:
    """A folding screen of three boards behind the head, full of markers."""
    boards, places = [], []
    height = _SCREEN_TOP - _SCREEN_BOTTOM
    for (x0, z0), (x1, z1), columns in zip(_SCREEN[:-1], _SCREEN[1:], (3, 4, 3), strict=True):
        edge = np.array([x1 - x0, 0.0, z1 - z0])
        corner = np.array([x0, _SCREEN_TOP, z0])
        down = np.array([0.0, -height, 0.0])
        boards.append(Panel(corner, edge, down, plain_texture(_BOARD)(8, 8)))
        inwards = boards[-1].normal
        for row in (np.arange(4) + 0.5) / 4:
            for column in (np.arange(columns) + 0.5) / columns:
                centre = corner + column * edge + 0.9 * row * down + _OFF_BOARD_M * inwards
                places.append((tuple(centre), tuple(edge / np.linalg.norm(edge))))
    papers, markers = _hang(places, side_m)
    return [*boards, *papers], markers


#: Where markers can be: name to what hangs them.
PLACES: dict[str, Callable[[float], tuple[list[Panel], list[Marker]]]] = {
    "walls": wall_markers,
    "screen": screen_markers,
}


def _hang(
    places: list[tuple[tuple[float, float, float], tuple[float, float, float]]], side_m: float
) -> tuple[list[Panel], list[Marker]]:
    """Markers numbered from 0, upright, at centres and with unit vectors along their top edges."""
    papers, markers = [], []
    for number, (centre, right) in enumerate(places):
        along, down = np.array(right), np.array([0.0, -1.0, 0.0])
        # A texture's outermost texels are centred on the panel's edge, so that the paper is shorter by one.
        modules = _MODULES + 2
        paper_m = side_m * (modules * _TEXELS - 1) / (_MODULES * _TEXELS)
        corner = np.array(centre) - 0.5 * paper_m * (along + down)
        papers.append(Panel(corner, paper_m * along, paper_m * down, _print(number)))
        offsets = 0.5 * side_m * np.array([-along - down, along - down, along + down, down - along])
        markers.append(Marker(number, np.array(centre) + offsets))
    return papers, markers


def _print(number: int) -> np.ndarray:
    """[h, w, 3] reflectance of a marker on its paper."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, DICTIONARY))
    black = cv2.aruco.generateImageMarker(dictionary, number, _MODULES * _TEXELS) == 0
    paper = np.full((black.shape[0] + 2 * _TEXELS, black.shape[1] + 2 * _TEXELS), _PAPER, np.float32)
    paper[_TEXELS:-_TEXELS, _TEXELS:-_TEXELS][black] = _INK
    return np.repeat(paper[..., None], 3, axis=2)


def described(markers: tuple[Marker, ...], side_m: float) -> dict[str, object]:
    """What gt/markers.json says of them."""
    return {
        "dictionary": DICTIONARY,
        "side_m": side_m,
        "axes": "the room's, metres; corners from the top left clockwise as seen",
        "corners": {str(marker.number): marker.corners.tolist() for marker in markers},
    }
