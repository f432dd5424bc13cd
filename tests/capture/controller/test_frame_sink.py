import errno
import threading
import time

import cv2
import numpy as np
import pytest

from capture.controller.frame_sink import FrameSink
from capture.devices.camera import StreamFormat
from capture.errors import SessionError
from capture.session import FrameRecord, Session

FORMAT = StreamFormat(width=32, height=24, pixel_format="RGB3", fps=30.0)
JPEG = StreamFormat(width=32, height=24, pixel_format="MJPG", fps=30.0)


def picture(k):
    return np.full((24, 32, 3), k % 256, np.uint8)


def record(k):
    return FrameRecord(index=k, file=None, width=32, height=24, pts_s=k / 30)


@pytest.fixture
def session(tmp_path):
    with Session.create(tmp_path / "S", source={"kind": "capture"}, width=32, height=24) as session:
        yield session


def test_every_frame_is_there_in_order_with_its_pixels(session):
    with FrameSink(session, FORMAT) as sink:
        for k in range(50):
            sink.put(record(k), picture(k))
        sink.drain()
    again = Session.open(session.path)
    assert [frame.index for frame in again.frames] == list(range(50))
    assert all(again.load_image(frame)[0, 0, 0] == frame.index for frame in again.frames)


def test_a_jpeg_goes_to_the_disk_as_it_came(session):
    data = cv2.imencode(".jpg", picture(9))[1].tobytes()
    with FrameSink(session, JPEG) as sink:
        sink.put(record(0), data)
    assert (session.path / "frames/000000.jpg").read_bytes() == data


def test_a_frame_that_is_no_picture_keeps_its_line_and_says_so(session):
    with FrameSink(session, JPEG) as sink:
        sink.put(record(0), b"noise")
        sink.put(record(1), cv2.imencode(".jpg", picture(1))[1].tobytes())
    assert [(frame.file, frame.reasons) for frame in session.frames] == [
        (None, ("unreadable",)),
        ("frames/000001.jpg", ()),
    ]


def test_a_full_disk_comes_out_of_the_next_put_and_what_is_logged_is_whole(session, monkeypatch):
    whole = session.append_frame

    def full_after_three(line):
        if line.index >= 3:
            raise SessionError(f"{session.path}: {errno.errorcode[errno.ENOSPC]}")
        whole(line)

    monkeypatch.setattr(session, "append_frame", full_after_three)

    def take_all():
        with FrameSink(session, FORMAT) as sink:
            for k in range(200):
                sink.put(record(k), picture(k))
                time.sleep(0.001)
            sink.drain()

    with pytest.raises(SessionError, match="ENOSPC"):
        take_all()
    assert [frame.index for frame in session.frames] == [0, 1, 2]


def test_a_slow_disk_makes_put_wait_instead_of_the_memory_grow(session, monkeypatch):
    gate = threading.Event()
    write = session.write_frame

    def slow(*args):
        gate.wait(5)
        return write(*args)

    monkeypatch.setattr(session, "write_frame", slow)
    three_frames = 3 * picture(0).nbytes
    with FrameSink(session, FORMAT, backlog_bytes=three_frames) as sink:
        for k in range(3):
            sink.put(record(k), picture(k))
        assert (sink.waits, sink.waiting) == (0, 3)
        threading.Timer(0.05, gate.set).start()
        sink.put(record(3), picture(3))
        assert sink.waits == 1
    assert len(session.frames) == 4


def test_a_frame_beyond_the_bound_is_taken_when_nothing_else_waits(session):
    with FrameSink(session, FORMAT, backlog_bytes=1) as sink:
        for k in range(3):
            sink.put(record(k), picture(k))
    assert len(session.frames) == 3
