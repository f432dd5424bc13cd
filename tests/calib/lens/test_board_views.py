import cv2
import numpy as np
import pytest

from calib.board.charuco import Board
from calib.board.pictures import Picture
from calib.errors import IntrinsicsError
from calib.lens.views import collect_views


def as_pictures(images):
    return [Picture(f"p{n}.png", image, (n + 1) / len(images)) for n, image in enumerate(images)]


def test_views_come_with_an_account_of_all_pictures(pictures, board):
    images = [image for image, _ in pictures]
    images += [images[0], np.full_like(images[0], 128), np.where(np.arange(480) < 380, 128, images[1])]
    stages = []
    collected = collect_views(as_pictures(images), board, progress=lambda *stage: stages.append(stage))
    assert collected.searched == 17
    assert len(collected.views) == 14
    said = collected.describe()
    assert "17 pictures searched, 14 views used, 1 of a pose that was seen already" in said
    assert "no board was found" in said
    assert stages[-1] == ("look for the board", 1.0)


@pytest.mark.parametrize(
    ("spoil", "described", "words"),
    [
        (lambda image: image[:, ::-1], None, "the picture is mirrored.*switch the mirroring"),
        (lambda image: cv2.GaussianBlur(image, (0, 0), 5), None, "is blurred.*lock the focus"),
        (lambda image: np.where(np.arange(480) < 250, 128, image), None, "seen: show more of the board"),
        (lambda image: image, Board((4, 5), 0.03, 0.022), "marker 1. was seen.*give the description"),
        (lambda image: image, Board(dictionary="DICT_4X4_50"), "DICT_5X5_250 were seen.*dictionary"),
        (lambda image: np.full_like(image, 128), None, "board"),
    ],
)
def test_too_few_views_are_refused_with_what_is_wrong(pictures, board, spoil, described, words):
    images = [np.ascontiguousarray(spoil(image).astype(np.uint8)) for image, _ in pictures[:6]]
    with pytest.raises(IntrinsicsError, match=words) as refused:
        collect_views(as_pictures(images), described or board)
    assert "0 of 6 pictures" in str(refused.value) or "of 6 pictures" in str(refused.value)
    assert (described or board).describe() in str(refused.value)


def test_one_pose_many_times_is_one_view(pictures, board):
    with pytest.raises(
        IntrinsicsError, match=r"1 of 9 pictures.*where it was seen already: move and tilt it"
    ):
        collect_views(as_pictures([pictures[0][0]] * 9), board)


def test_no_pictures_and_few_good_ones_are_refused(pictures, board):
    with pytest.raises(IntrinsicsError, match=r"0 of 0 pictures.*Take more"):
        collect_views([], board)
    with pytest.raises(IntrinsicsError, match=r"3 of 3 pictures.*Take more"):
        collect_views(as_pictures([image for image, _ in pictures[:3]]), board)
