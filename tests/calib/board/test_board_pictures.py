import cv2
import numpy as np
import pytest

from calib.board.pictures import board_pictures
from calib.errors import IntrinsicsError
from capture.errors import SourceError
from capture.frame_record import FrameRecord
from capture.images import write_image
from capture.session import Session
from capture.video import VideoWriter

RAMP = np.tile(np.arange(64, dtype=np.uint8) * 3, (48, 1))


def colour(grey):
    return np.repeat(grey[..., None], 3, axis=2)


def test_stills_come_in_the_order_of_their_names(tmp_path):
    for name, value in (("b.png", 2), ("a.jpg", 1), ("c.exr", 3)):
        write_image(tmp_path / name, colour((RAMP // value).astype(np.uint8 if value < 3 else np.float32)))
    (tmp_path / "notes.txt").write_text("not a picture")
    found = list(board_pictures([tmp_path]))
    assert [picture.name for picture in found] == ["a.jpg", "b.png", "c.exr"]
    assert all(picture.grey.dtype == np.uint8 and picture.grey.shape == (48, 64) for picture in found)
    assert np.array_equal(found[1].grey, RAMP // 2)
    assert [round(picture.fraction, 3) for picture in found] == [0.333, 0.667, 1.0]


def test_deep_pictures_keep_their_upper_bits(tmp_path):
    write_image(tmp_path / "deep.png", (RAMP.astype(np.uint16) << 8) + 77)
    (picture,) = board_pictures([tmp_path / "deep.png"])
    assert np.array_equal(picture.grey, RAMP)


def test_a_session_gives_its_frames(tmp_path):
    with Session.create(tmp_path / "S", source={"kind": "test"}, width=64, height=48) as session:
        file = session.write_frame(7, colour(RAMP))
        session.append_frame(FrameRecord(index=7, file=file, width=64, height=48, flash=0))
        session.append_frame(FrameRecord(index=8, file=None, width=64, height=48, flash=0))
    (picture,) = board_pictures([tmp_path / "S"])
    assert picture.name == "frame 7"
    assert np.array_equal(picture.grey, RAMP)


def film(path, frames):
    with VideoWriter(path, 64, 48, crf=4) as writer:
        for number, frame in enumerate(frames):
            writer.write(colour(frame), number / 30)


def test_of_a_film_the_sharp_still_frame_of_each_interval_is_taken(tmp_path):
    texture = np.random.default_rng(0).integers(60, 200, (48, 64)).astype(np.uint8)
    frames = []
    for number in range(18):
        if number % 6 in (2, 3):
            frames.append(texture)  # still for two frames
        elif number % 6 == 5:
            frames.append(cv2.GaussianBlur(texture, (0, 0), 3))
        else:
            frames.append(np.roll(texture, 5 * (number % 6 + 1), axis=1))
    film(tmp_path / "film.mp4", frames)
    found = list(board_pictures([tmp_path / "film.mp4"]))
    assert [picture.name for picture in found] == [
        f"film.mp4 at {number / 30:.2f} s" for number in (3, 9, 15)
    ]


def test_pictures_of_two_sizes_are_refused(tmp_path):
    write_image(tmp_path / "a.png", RAMP)
    write_image(tmp_path / "b.png", RAMP.T)
    with pytest.raises(IntrinsicsError, match=r"a\.png is 64 x 48 pixels and b\.png is 48 x 64"):
        list(board_pictures([tmp_path]))


def test_a_folder_without_pictures_is_refused(tmp_path):
    with pytest.raises(SourceError, match="holds no picture"):
        list(board_pictures([tmp_path]))
    with pytest.raises(SourceError, match="does not exist"):
        list(board_pictures([tmp_path / "film.mp4"]))
