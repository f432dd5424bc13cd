"""The firmware's flash in real time: behind a pseudo-terminal, in simavr, behind a socket, on a board.

RELIGHT_TEST_FLASH=/dev/ttyUSB0 runs the contract on a real flash. It blinks.
"""

import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import suppress
from random import Random

import pytest
from flash_contract import WATCHDOG_S, FlashContract, FlashRig, edge_count
from flash_doubles import LiveDevice, build, damage

from capture.devices.bench import Bench, MonotonicClock
from capture.devices.firmware_flash.flash import open_firmware_flash
from capture.devices.flash import PulseTrain
from capture.devices.serial_flash import open_flash
from capture.devices.serial_flash.port import SerialLine
from capture.devices.table import open_flash as open_by_url
from capture.errors import FlashError, FlashGoneError

REAL = os.environ.get("RELIGHT_TEST_FLASH")


class MutedLine(SerialLine):
    """A line that can be made to say nothing more, as a dead process would."""

    muted = False

    def write(self, data):
        if not self.muted:
            super().write(data)


class DamagingLine(SerialLine):
    """One byte in a hundred, both ways."""

    random = Random(11)

    def write(self, data):
        super().write(damage(data, self.random, 0.01))

    def read(self, timeout_s):
        return damage(super().read(timeout_s), self.random, 0.01)


class HurriedClock(MonotonicClock):
    """Ten seconds in one."""

    def now_s(self):
        return 10 * super().now_s()


class LiveRig(FlashRig):
    """A device in real time at a URL; `device` where its lamp can be seen."""

    real_time = True
    lead_s = 0.4
    #: Twenty worst round trips of a busy machine.
    slack_s = 0.02

    def __init__(self, url, device=None):
        self.url, self.device = url, device
        self.clock = MonotonicClock()
        self.line = None

    def open(self):
        self.line = MutedLine(self.url, self.clock)
        return open_firmware_flash(self.line, Bench(self.clock), url=self.url, back_end="serial")

    def lamp(self):
        return self.device.lamp() if self.device else None

    def kill_host(self):
        self.line.muted = True


@pytest.fixture(scope="module")
def double(firmware_directory, tmp_path_factory):
    edges = tmp_path_factory.mktemp("double") / "edges.txt"
    device = LiveDevice(build(firmware_directory, "flash_double"), edges_file=edges)
    yield device
    device.close()


@pytest.fixture
def chip(firmware_directory, tmp_path):
    image = build(firmware_directory, "flash.elf")
    device = LiveDevice(build(firmware_directory, "runner"), image, edges_file=tmp_path / "edges.txt")
    yield device
    device.close()


@pytest.fixture
def served(double):
    """The double behind a socket: its URL."""
    listener = socket.create_server(("127.0.0.1", 0))
    done = threading.Event()

    def serve():
        line = os.open(double.path, os.O_RDWR | os.O_NOCTTY)
        connection, _ = listener.accept()
        with connection, suppress(ConnectionError):  # the host may leave in the middle of a word
            while not done.is_set():
                for ready in select.select([line, connection], [], [], 0.05)[0]:
                    if ready is not connection:
                        connection.sendall(os.read(line, 4096))
                    elif data := connection.recv(4096):
                        os.write(line, data)
                    else:
                        done.set()
        os.close(line)

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    yield f"socket://127.0.0.1:{listener.getsockname()[1]}"
    done.set()
    thread.join(timeout=5)
    listener.close()


class TestContractOnAPseudoTerminal(FlashContract):
    @pytest.fixture
    def rig(self, double):
        return LiveRig(double.path, double)

    test_a_host_that_dies_leaves_it_dark_where_it_has_a_watchdog = None  # below: killed, not only silent


if REAL is not None:

    class TestContractOnARealFlash(FlashContract):
        @pytest.fixture
        def rig(self):
            return LiveRig(REAL)


def expect_one_flash(rig, flash):
    train = PulseTrain(start_s=rig.clock.now_s() + rig.lead_s, on_s=0.1, count=1)
    flash.start(train)
    edges = rig.watch(flash, train.end_s - rig.clock.now_s() + 0.3)
    assert [edge.on for edge in edges] == [True, False]
    for (time_s, _), edge in zip(rig.lamp()[-2:], edges, strict=True):
        assert edge.time_s == pytest.approx(time_s, abs=5 * edge.sigma_s)
        assert edge.time_s == pytest.approx(train.start_s + (0 if edge.on else 0.1), abs=rig.slack_s)


def test_the_chip_in_simavr_flashes_when_it_was_told(chip):
    rig = LiveRig(chip.path, chip)
    with open_by_url(chip.path) as flash:
        assert flash.info.details["firmware"].endswith("atmega328p")
        expect_one_flash(rig, flash)
        report = flash.link_report()
    # Its line has a UART's pace, and the clock knows.
    assert report["uart_pace"]
    assert report["round_trip_min_s"] > 52 * 10 / 117_647


def test_a_socket_is_a_line_too(served, double):
    rig = LiveRig(served, double)
    with open_by_url(served) as flash:
        expect_one_flash(rig, flash)
        assert not flash.link_report()["uart_pace"]


def test_a_line_that_damages_in_real_time_costs_repeats_and_no_flash(double):
    rig = LiveRig(double.path, double)
    before = edge_count(rig)
    line = DamagingLine(double.path, rig.clock)
    with open_firmware_flash(line, Bench(rig.clock), url=double.path, back_end="serial") as flash:
        flash.start(PulseTrain(start_s=rig.clock.now_s() + 0.8, period_s=0.4, on_s=0.05, count=3))
        rig.watch(flash, 1.9)
        assert flash.off()
        report = flash.link_report()
    assert report["resyncs"] > 0
    assert [on for _, on in rig.lamp()[before:]] == [True, False] * 3


def test_a_device_that_is_pulled_out_is_gone_at_the_next_poll(firmware_directory, tmp_path):
    device = LiveDevice(build(firmware_directory, "flash_double"), edges_file=tmp_path / "edges.txt")
    flash = open_flash(device.path, Bench())
    flash.start(PulseTrain(start_s=time.monotonic() + 0.5))
    device.process.kill()
    device.process.wait(timeout=10)
    flash._thread.join(timeout=10)  # it has noticed
    for _ in range(2):
        with pytest.raises(FlashGoneError, match="not there any more"):
            flash.poll()
    assert flash.off() is False
    flash.close()
    flash.close()
    device.process.stdin.close()
    device.process.stdout.close()


def test_a_flash_that_is_forgotten_stops(double):
    rig = LiveRig(double.path, double)
    flash = open_flash(double.path, Bench())
    flash.start(PulseTrain(start_s=rig.clock.now_s() + 0.3, period_s=0.34, on_s=0.1, count=1000))
    while not flash.poll():
        rig.sleep(0.01)
    del flash
    rig.sleep(0.25)
    before = len(rig.lamp())
    rig.sleep(0.7)  # two flashes more would have come, and the watchdog not yet
    assert len(rig.lamp()) == before
    assert not rig.lamp()[-1][1]


HOST = """
import sys
from capture.devices.bench import Bench
from capture.devices.serial_flash import open_flash
from capture.devices.flash import PulseTrain

bench = Bench()
flash = open_flash(sys.argv[1], bench)
flash.start(PulseTrain(start_s=bench.clock.now_s() + 0.2, on_s=0.25, count=1000))
while not flash.poll():
    bench.clock.sleep(0.005)
print("lit", flush=True)
while True:
    flash.poll()
    bench.clock.sleep(0.05)
"""


def test_a_host_that_is_killed_leaves_the_lamp_dark(double):
    before = len(double.lamp())
    host = subprocess.Popen([sys.executable, "-c", HOST, double.path], stdout=subprocess.PIPE, text=True)
    assert host.stdout.readline() == "lit\n"
    killed_s = time.monotonic()
    host.send_signal(signal.SIGKILL)
    host.wait(timeout=10)
    host.stdout.close()
    time.sleep(WATCHDOG_S + 0.4)
    lamp = double.lamp()[before:]
    assert not lamp[-1][1]
    assert lamp[-1][0] < killed_s + WATCHDOG_S


def test_a_line_that_the_system_cannot_wait_for_is_polled():
    """loop:// stands for rfc2217:// too; what it says is its own echo."""
    with pytest.raises(FlashError, match="only echoes"):
        open_flash("loop://", Bench(HurriedClock()))


def test_a_port_that_is_in_use_or_missing_says_so(double):
    with (
        open_flash(double.path, Bench()),
        pytest.raises(FlashError, match="in use by another program; close it"),
    ):
        open_flash(double.path, Bench())
    with pytest.raises(FlashError, match="does not exist; plug the flash in"):
        open_flash("/dev/ttyUSB987", Bench())
    with pytest.raises(FlashError, match="does not exist; plug the flash in"):
        open_flash("hwgrep://no such port", Bench())
    with pytest.raises(FlashError, match="cannot be opened as a serial port"):
        open_flash("socket://127.0.0.1:1", Bench())
    with pytest.raises(FlashError, match="cannot be opened as a serial port"):
        open_flash("nonsense://x", Bench())
