import cv2
import numpy as np
import pytest

from calib.board.charuco import Board
from calib.board.detection import BoardDetector, BoardView, Failure, Problem
from calib.lens.projection import project


def pose(tilt=(0.3, -0.2, 0.1), place=(0.01, -0.005, 0.34)):
    return cv2.Rodrigues(np.array(tilt))[0], np.array(place)


def test_corners_of_a_rendered_board_are_where_the_lens_puts_them(pictures, board, lens):
    detector = BoardDetector(board)
    errors = []
    for picture, (rotation, translation) in pictures:
        view = detector.look(picture, "picture")
        assert isinstance(view, BoardView)
        assert view.layout == "both"  # an odd number of rows
        truth = project(lens, board.corners_m @ rotation.T + translation)
        errors.append(view.corners_px - truth[view.ids])
    errors = np.concatenate(errors)
    assert np.sqrt((errors**2).mean()) < 0.05  # px; the detector's noise on 1.5 grey levels of noise
    # Half a pixel would be the sign of a wrong convention; what is left is below a hundredth.
    assert np.abs(errors.mean(0)).max() < 0.01


@pytest.mark.parametrize("layout", ["current", "legacy"])
@pytest.mark.parametrize("described", ["current", "legacy"])
@pytest.mark.parametrize("squares", [(5, 6), (6, 6)])
def test_the_layout_is_found_whatever_the_description_says(render_board, layout, described, squares):
    board = Board(squares, 0.03, 0.022)
    picture = render_board(board.with_layout(layout), pose())
    view = BoardDetector(board.with_layout(described)).look(picture, "picture")
    assert view.layout == layout
    assert len(view.ids) == (squares[0] - 1) * (squares[1] - 1)


def test_a_turned_picture_shows_the_same_corners(pictures, board):
    picture, _ = pictures[0]
    upright = BoardDetector(board).look(picture, "")
    turned = BoardDetector(board).look(np.ascontiguousarray(picture[::-1, ::-1]), "")
    both = np.intersect1d(upright.ids, turned.ids)
    here = upright.corners_px[np.isin(upright.ids, both)]
    there = np.array(upright.size) - turned.corners_px[np.isin(turned.ids, both)]
    assert len(both) > 15
    assert np.abs(here - there).max() < 0.1  # two runs of the refinement on mirrored noise


@pytest.mark.parametrize(
    ("spoil", "problem"),
    [
        (lambda picture: picture[:, ::-1], Problem.MIRRORED),
        (lambda picture: cv2.GaussianBlur(picture, (0, 0), 5), Problem.BLURRED),
        (lambda picture: np.full_like(picture, 90), Problem.BLURRED),
        (lambda picture: np.where(np.arange(480) < 290, 120, picture), Problem.PARTIAL),
        (lambda picture: np.random.default_rng(0).integers(0, 255, picture.shape), Problem.NO_BOARD),
    ],
)
def test_a_picture_that_cannot_be_used_says_why(render_board, board, spoil, problem):
    picture = np.ascontiguousarray(spoil(render_board(board, pose())).astype(np.uint8))
    detector = BoardDetector(board)
    assert isinstance(detector.look(picture, ""), Failure)
    assert detector.diagnose(picture)[0] is problem


@pytest.mark.parametrize(
    ("described", "problem", "words"),
    [
        (Board((4, 5), 0.03, 0.022), Problem.OTHER_BOARD, "it has only 10"),
        (Board((6, 7), 0.03, 0.022), Problem.OTHER_BOARD, ""),
        (Board((5, 7), 0.03, 0.022, "DICT_4X4_50"), Problem.OTHER_MARKERS, "DICT_5X5_250"),
    ],
)
def test_another_board_is_not_taken_for_this_one(render_board, board, described, problem, words):
    picture = render_board(board, pose())
    detector = BoardDetector(described)
    assert isinstance(detector.look(picture, ""), Failure)
    found, detail = detector.diagnose(picture)
    assert found is problem
    assert words in detail


def test_blur_is_told_by_the_width_of_the_edges(render_board, board):
    detector = BoardDetector(board)
    sharp = detector.look(render_board(board, pose(), blur_px=0.5), "")
    softer = detector.look(render_board(board, pose(), blur_px=1.5), "")
    # A Gaussian edge is sqrt(2 pi) = 2.5 standard deviations wide; the pixels' own width adds to it.
    assert 1.2 < sharp.edge_width_px < 2.2
    assert 3.0 < softer.edge_width_px < 4.5


def test_a_large_picture_is_searched_small_and_measured_large(render_board, board, lens):
    rotation, translation = pose()
    picture = render_board(board, (rotation, translation), noise=0.0)
    large = cv2.resize(picture, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)
    view = BoardDetector(board).look(large, "")
    truth = project(lens, board.corners_m @ rotation.T + translation)[view.ids] * 4
    assert view.size == (1920, 1440)
    assert np.sqrt(((view.corners_px - truth) ** 2).mean()) < 0.25  # of pixels a quarter as large


@pytest.mark.parametrize("shape", [(1, 1), (8, 8), (3, 2000)])
def test_pictures_of_any_size_are_looked_at(board, shape):
    assert isinstance(BoardDetector(board).look(np.zeros(shape, np.uint8), ""), Failure)


def test_a_board_through_a_very_wide_lens_is_recognised(board):
    """A picture that shrinks by a third from the middle to the corners: no homography follows it."""
    texel = 80
    drawing = board.to_opencv().generateImage((5 * texel, 7 * texel), marginSize=0)
    drawing = cv2.copyMakeBorder(drawing, *[texel] * 4, cv2.BORDER_CONSTANT, value=255)
    height, width = drawing.shape
    middle = np.array([width, height]) / 2
    reach = np.hypot(*middle)
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    way = (np.stack([x, y], axis=-1) - middle) / reach
    drawn = middle + reach * way * (0.85 + 0.45 * (way**2).sum(-1, keepdims=True)) - 0.5
    column, row = np.moveaxis(drawn.astype(np.float32), -1, 0)
    picture = cv2.remap(
        drawing, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=255
    )
    view = BoardDetector(board).look(cv2.GaussianBlur(picture, (0, 0), 0.7), "")
    assert len(view.ids) == len(board.corners_m)
    way = (view.corners_px - middle) / reach
    back = reach * way * (0.85 + 0.45 * (way**2).sum(-1, keepdims=True)) / texel
    # In squares; a tenth of a pixel is 1.3 thousandths. Bent edges pull the refinement a little.
    assert np.abs(back - board.corners_m[:, :2] / board.square_m).max() < 4e-3
