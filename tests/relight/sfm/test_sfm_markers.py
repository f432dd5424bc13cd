"""Printed markers and boards in drawn pictures."""

import cv2
import numpy as np
import pytest

from relight.errors import GeometryError
from relight.sfm.markers import Board, MarkerFinder, metres_per_unit


def drawn_marker(number=5, side=60, at=(50, 40), size=(200, 240)):
    """Linear radiance [h, w] of a marker on white paper, its top-left corner at a pixel's corner."""
    page = np.full(size, 0.5, np.float32)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_250)
    ink = cv2.aruco.generateImageMarker(dictionary, number, side)
    page[at[1] : at[1] + side, at[0] : at[0] + side] = np.where(ink > 0, 0.5, 0.02)
    return cv2.GaussianBlur(page, (0, 0), 0.7)


def test_markers_of_a_common_dictionary_are_found_with_their_corners():
    finder = MarkerFinder()
    finder.choose([drawn_marker(), drawn_marker(at=(80, 60))])
    assert finder.dictionaries == ("DICT_5X5_250",)
    corners, labels = finder.find(drawn_marker())
    assert len(labels) == 4
    # The paper's blur draws them in by a third of a pixel; a wrong convention would shift all of them alike.
    assert corners == pytest.approx(np.array([[50, 40], [110, 40], [110, 100], [50, 100]]), abs=0.5)
    assert corners.mean(axis=0) == pytest.approx([80, 70], abs=0.1)
    assert np.array_equal(labels, finder.find(drawn_marker(at=(90, 70)))[1])


def test_a_plain_page_has_no_markers():
    finder = MarkerFinder()
    page = np.full((100, 100), 0.4, np.float32)
    finder.choose([page, page])
    assert finder.dictionaries == ()
    corners, labels = finder.find(page)
    assert corners.shape == (0, 2)
    assert labels.shape == (0,)


def test_a_board_is_found_and_gives_the_metre():
    board = Board.parse("5x4:0.03:0.02:DICT_5X5_250")
    drawn = cv2.aruco.CharucoBoard(
        (5, 4), 0.03, 0.02, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_250)
    )
    page = (drawn.generateImage((500, 400), marginSize=0) / 255.0).astype(np.float32)
    corners, labels = MarkerFinder(board).find(np.pad(page, 30, constant_values=1.0))
    assert len(labels) == 12
    # In the picture a square is 100 px: taken for a world of pixels, 0.0003 m is one.
    world = {int(label): np.array([*corner, 0.0]) for label, corner in zip(labels, corners, strict=True)}
    ratio, source = metres_per_unit(world, board, None)
    assert ratio == pytest.approx(0.0003, rel=0.005)
    assert "30 mm" in source


def test_the_sides_of_markers_give_the_metre():
    square = np.array([[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]], float)
    world = {4 * 7 + k: square[k] for k in range(4)}
    ratio, _ = metres_per_unit(world, None, 0.05)
    assert ratio == pytest.approx(0.025)
    assert metres_per_unit({}, None, 0.05) is None
    assert metres_per_unit(world, None, None) is None


def test_markers_of_several_sizes_are_refused():
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    world = {4 * m + k: (1 + 0.2 * m) * square[k] for m in range(4) for k in range(4)}
    with pytest.raises(GeometryError, match="contradict"):
        metres_per_unit(world, None, 0.05)


@pytest.mark.parametrize(
    "text", ["7x10", "7x10:0.02:0.03:DICT_5X5_250", "1x5:0.03:0.02:DICT_5X5_250", "7x10:0.03:0.02:DICT_X"]
)
def test_boards_that_cannot_be_are_refused(text):
    with pytest.raises(ValueError, match=r"board|dictionary"):
        Board.parse(text)
