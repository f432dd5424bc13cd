import json

import numpy as np
import pytest

from calib.board.charuco import Board, load_board, save_board
from calib.errors import BoardError


@pytest.mark.parametrize("layout", ["current", "legacy"])
@pytest.mark.parametrize("squares", [(7, 10), (8, 5), (4, 6)])
def test_corners_and_markers_lie_where_opencv_draws_them(layout, squares):
    board = Board(squares, layout=layout)
    theirs = board.to_opencv()
    middle = np.array(squares) * board.square_m / 2
    # OpenCV keeps float32: 1e-7 of a quarter of a metre.
    assert np.allclose(theirs.getChessboardCorners()[:, :2] - middle, board.corners_m[:, :2], atol=1e-6)
    assert np.allclose(np.array(theirs.getObjPoints())[..., :2] - middle, board.marker_corners_m, atol=1e-6)
    assert len(board.marker_corners_m) == board.marker_count


def test_the_layouts_differ_only_with_an_even_number_of_rows():
    for rows, same in ((9, True), (10, False)):
        squares = [Board((7, rows), layout=layout).black_squares for layout in ("current", "legacy")]
        assert np.array_equal(*squares) == same


def test_a_saved_board_is_loaded(tmp_path):
    board = Board((5, 8), 0.0312, 0.02, "DICT_4X4_50", "legacy")
    save_board(board, tmp_path / "board.json")
    assert load_board(tmp_path / "board.json") == board
    assert "5 x 8 squares of 31.2 mm" in board.describe()
    assert "legacy" in board.describe()


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"squares": (2, 9)}, "3 to 60 squares"),
        ({"squares": (7, 99)}, "3 to 60 squares"),
        ({"square_m": 0.0}, "0 mm"),
        ({"square_m": float("nan")}, "nan mm"),
        ({"marker_m": 0.0249}, "white around"),
        ({"marker_m": -1.0}, "white around"),
        ({"dictionary": "DICT_9X9"}, "DICT_5X5_250"),
        ({"dictionary": "DICT_5X5_50", "squares": (12, 12)}, "need 72 markers; DICT_5X5_50 has 50"),
        ({"layout": "old"}, "current and legacy"),
    ],
)
def test_boards_that_cannot_be_are_refused(wrong, words):
    with pytest.raises(BoardError, match=words):
        Board(**wrong)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda c: c.update(schema="x"), "schema"),
        (lambda c: c.update(version=2), "newer program"),
        (lambda c: c.update(colour="red"), "'colour' is unknown"),
        (lambda c: c.update(squares=[7.5, 10]), "whole numbers"),
        (lambda c: c.update(squares=[7]), "squares"),
        (lambda c: c.update(squares=[1e300, 10]), "whole numbers"),
        (lambda c: c.pop("marker_m"), "marker_m"),
        (lambda c: c.update(marker_m=1), "white around"),
        (lambda c: c.update(dictionary=5), "dictionary"),
    ],
)
def test_a_malformed_description_names_its_fault(tmp_path, change, words):
    path = tmp_path / "board.json"
    content = Board().to_json()
    change(content)
    path.write_text(json.dumps(content))
    with pytest.raises(BoardError, match=words):
        load_board(path)


def test_a_missing_description_is_named(tmp_path):
    with pytest.raises(BoardError, match=r"none\.json"):
        load_board(tmp_path / "none.json")
