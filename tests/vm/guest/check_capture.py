"""`relight-capture` as a user types it, on a camera behind uvcvideo and a flash behind cdc-acm.

The flash is the firmware's host build, and its lamp lights what the camera sees. The program is killed in the
middle: what is on the disk by then must be whole, and the lamp must go out. To the end it is not left to run:
an emulated machine takes minutes for the last fit of the tags, which needs no device.
"""

import json
import os
import signal
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path

import pytest
from kernel import load, loaded, until
from serial_adapter import PtyProgram, adapter
from usb_bus import plugged
from uvc_camera import LOCKED, UvcCamera, video_node

from capture.images import read_image
from capture.session import Session

COMMAND = [sys.executable, "-c", "import sys; from capture.cli import main; sys.exit(main())"]
#: scipy alone takes this machine ten seconds to import, and the lock as many.
START_S = 120.0
#: A process of this machine may be held up for so long; the chip itself has its width to the tick.
HELD_UP_S = 0.05


class Lamp:
    """Pulses out of the firmware's file of edges, as far as they have happened."""

    def __init__(self, path):
        self._path, self._read = path, 0
        self.edges_s = []

    def __call__(self):
        with self._path.open() as lines:
            lines.seek(self._read)
            while (line := lines.readline()).endswith("\n"):
                self._read = lines.tell()
                ns, what = line.split()
                if what in "01":
                    self.edges_s.append(int(ns) * 1e-9)
        return list(zip(self.edges_s[::2], [*self.edges_s[1::2], float("inf")], strict=False))


@pytest.fixture
def desk(tmp_path):
    if not os.environ["DOUBLE"]:
        pytest.skip("there is no C compiler for the firmware's host build")
    load("cdc-acm")
    edges = tmp_path / "edges"
    program = PtyProgram(os.environ["DOUBLE"], "--edges", edges, output=tmp_path / "double.log")
    camera = UvcCamera()
    camera.lamp = Lamp(edges)
    try:
        with loaded("uvcvideo"), plugged(camera.device), adapter(program):
            port = until(lambda: next(Path("/dev").glob("ttyACM*"), None), "a port")
            yield camera, until(video_node, "a camera"), port
    finally:
        program.close()


def lines_of(path):
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


@pytest.mark.limit_s(200)
def test_a_capture_that_is_killed_has_kept_its_frames_and_the_lamp_goes_out(desk, tmp_path):
    camera, node, port = desk
    session = tmp_path / "session"
    asked = f"--camera {node} --flash {port} --out {session} --duration 100 --on 0.25 --quiet --size 160x120"
    asked += " --fps 10 --format YUYV --exposure 0.005 --gain 16 --white-balance 5000 --focus 50 --mains 50"
    process = subprocess.Popen([*COMMAND, *asked.split()])
    until(
        lambda: process.poll() is not None or len(lines_of(session / "flash.jsonl")) >= 6, "flashes", START_S
    )
    until(lambda: process.poll() is not None or camera.lamp()[-1][1] == float("inf"), "light")
    process.send_signal(signal.SIGKILL)
    assert process.wait(10) == -signal.SIGKILL
    assert camera.settings() == LOCKED

    until(lambda: camera.lamp()[-1][1] < float("inf"), "darkness", 1.0)
    time.sleep(2.0)  # 1.5 s without a heartbeat
    pulses = camera.lamp()
    assert max(off_s - on_s for on_s, off_s in pulses) <= 0.25 + HELD_UP_S
    time.sleep(1.2)
    assert camera.lamp() == pulses

    with Session.open(session) as kept:
        frames = list(kept.frames)
    assert len(frames) >= 10
    assert all(one.pts_s < other.pts_s for one, other in pairwise(frames))
    edges = lines_of(session / "flash.jsonl")
    assert [edge["on"] for edge in edges] == [number % 2 == 0 for number in range(len(edges))]
    light = {frame.index: read_image(session / frame.file).mean() for frame in frames}
    lit = [value for value in light.values() if value > 1.3 * min(light.values())]
    assert 1 <= len(lit) < len(light) / 2
