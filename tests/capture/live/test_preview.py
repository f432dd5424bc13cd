import http.client
import json
import re
import socket
import threading
import time

import cv2
import numpy as np
import pytest

from capture.devices.bench import VirtualClock
from capture.errors import DeviceError
from capture.live.preview import PreviewServer
from capture.live.preview_page import page
from capture.live.state import LiveState
from capture.live.steady_picture import SteadyPicture

PICTURE = np.full((48, 64, 3), (200, 100, 50), np.uint8)


def labelled(label):
    return LiveState(labels=("unlit", label))


@pytest.fixture
def clock():
    return VirtualClock()


@pytest.fixture
def server(clock):
    with PreviewServer(clock=clock) as preview:
        yield preview


def ask(server, path, *, method="GET", host=None, headers=None):
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=5)
    connection.request(method, path, headers={"Host": host or f"127.0.0.1:{server.port}"} | (headers or {}))
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer, body


def inside(server, name=""):
    return "/" + server.url.split("/", 3)[3] + name


def test_page_state_and_picture_are_served(server):
    server.update(labelled("unlit"), PICTURE)
    answer, body = ask(server, inside(server))
    assert answer.status == 200
    assert b"<title>Recording</title>" in body
    answer, body = ask(server, inside(server, "state.json"))
    state = json.loads(body)
    assert state["labels"] == ["unlit", "unlit"]
    assert state["picture"] == 1
    answer, body = ask(server, inside(server, "picture.jpg?7"))
    assert answer.getheader("Content-Type") == "image/jpeg"
    decoded = cv2.imdecode(np.frombuffer(body, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    # JPEG of one colour: rounding of its conversions.
    assert np.abs(decoded.astype(int) - PICTURE).max() <= 3


def test_before_the_first_picture_there_is_none(server):
    answer, body = ask(server, inside(server, "picture.jpg"))
    assert answer.status == 204
    assert body == b""


def test_it_listens_on_the_loopback_address_only(server):
    assert server._server.server_address[0] == "127.0.0.1"
    assert server.url.startswith(f"http://127.0.0.1:{server.port}/")


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:{port}", "127.0.0.1", "127.0.0.1:1", "[::1]:{port}"]
)
def test_another_host_is_refused_even_with_the_address(server, host):
    answer, _ = ask(server, inside(server, "state.json"), host=host.format(port=server.port))
    assert answer.status == 403


def test_a_page_elsewhere_cannot_read(server):
    answer, _ = ask(server, inside(server, "state.json"), headers={"Origin": "http://evil.example"})
    names = {name.lower() for name, _ in answer.getheaders()}
    assert not any(name.startswith("access-control") for name in names)
    assert answer.getheader("Cross-Origin-Resource-Policy") == "same-origin"
    assert "frame-ancestors 'none'" in answer.getheader("Content-Security-Policy")


@pytest.mark.parametrize("path", ["/", "/state.json", "/wrong/state.json", "//state.json", "/%00/"])
def test_without_the_random_part_nothing_is_there(server, path):
    answer, body = ask(server, path)
    assert answer.status == 404
    assert server._token.encode() not in body


def test_what_is_not_there_is_not_read_from_the_disk(server):
    answer, _ = ask(server, inside(server, "../../../etc/passwd"))
    assert answer.status == 404


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "OPTIONS"])
def test_it_only_reads(server, method):
    answer, _ = ask(server, inside(server), method=method)
    assert answer.status == 501


def test_addresses_cannot_be_guessed():
    with PreviewServer() as one, PreviewServer() as other:
        assert one._token != other._token
        assert len(one._token) >= 24  # 18 random bytes


def test_a_port_that_is_taken_is_one_sentence(server):
    with pytest.raises(DeviceError, match=rf"port {server.port} .*choose another port"):
        PreviewServer(server.port)
    with pytest.raises(DeviceError, match="port 99999"):
        PreviewServer(99999)


def test_it_stops_and_leaves_no_thread():
    before = set(threading.enumerate())
    preview = PreviewServer()
    silent = socket.create_connection(("127.0.0.1", preview.port))  # a client that never asks
    ask(preview, inside(preview))
    silent.close()
    preview.close()
    preview.close()
    assert set(threading.enumerate()) == before
    with pytest.raises(OSError):  # noqa: PT011
        socket.create_connection(("127.0.0.1", preview.port), timeout=1)


def test_updates_and_questions_at_once_do_no_harm(server, clock):
    done = threading.Event()

    def record():
        while not done.is_set():
            server.update(labelled("unlit"), PICTURE)
            clock.sleep(0.2)
            time.sleep(0.001)

    recording = threading.Thread(target=record)
    recording.start()
    try:
        for _ in range(10):
            assert json.loads(ask(server, inside(server, "state.json"))[1])["picture"] >= 0
            assert ask(server, inside(server, "picture.jpg"))[0].status in (200, 204)
    finally:
        done.set()
        recording.join()


def test_pictures_are_shown_upright():
    tall = np.zeros((20, 40, 3), np.uint8)
    tall[:, :20] = 255  # the left half; a quarter turn clockwise brings it to the top
    with PreviewServer(rotation_deg=90, clock=VirtualClock()) as preview:
        preview.update(labelled("unlit"), tall)
        shown = cv2.imdecode(np.frombuffer(ask(preview, inside(preview, "picture.jpg"))[1], np.uint8), 0)
    assert shown.shape == (40, 20)
    assert shown[:15].min() > 240
    assert shown[25:].max() < 15


def test_the_page_needs_nothing_from_elsewhere():
    text = page("abc")
    links = set(re.findall(r"https?://[^\"'` ]+", text))
    assert links == {"http://www.w3.org/2000/svg"}  # the name of SVG; nothing is fetched
    assert text.count('nonce="abc"') == 2
    assert not re.search(r"%[A-Z_]+%", text)


def brightness_over(pictures):
    """Changes of the shown brightness by more than a tenth, and their times, at 30 frames a second."""
    steady, levels = SteadyPicture(), []
    for k, (gain, label) in enumerate(pictures):
        picture = np.full((48, 64), round(100 * gain), np.uint8)
        steady.offer(picture, label, k / 30)
        levels.append(int(steady.picture[0, 0]) if steady.picture is not None else 100)
    steps = np.flatnonzero(np.abs(np.diff(levels)) > 10)
    return levels, steps / 30


def test_labelled_flashes_are_not_shown():
    pictures = [(1.6, "lit") if k % 30 in (10, 11, 12) else (1.0, "unlit") for k in range(300)]
    levels, _ = brightness_over(pictures)
    assert set(levels) == {100}


def test_flashes_that_nobody_labelled_are_not_shown_either():
    # The longest flash that any device may make, 0.25 s.
    pictures = [(1.6, "unlit") if k % 30 in range(10, 18) else (1.0, "unknown") for k in range(300)]
    levels, _ = brightness_over(pictures)
    assert set(levels) == {100}


@pytest.mark.parametrize("on_frames", [15, 16, 20, 45])
def test_the_screen_never_changes_more_than_three_times_a_second(on_frames):
    pictures = [(1.6, "unlit") if k % (2 * on_frames) < on_frames else (1.0, "unlit") for k in range(600)]
    _, steps_s = brightness_over(pictures)
    assert len(steps_s) > 1
    assert np.diff(steps_s).min() > 1 / 3


def test_at_most_ten_pictures_a_second_are_shown():
    steady = SteadyPicture()
    taken = sum(steady.offer(PICTURE, "unlit", k / 60) for k in range(600))
    assert 90 <= taken <= 101  # ten seconds
