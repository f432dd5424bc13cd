"""Our firmware on USB serial ports: the kernel's cdc-acm and ftdi_sio, with the firmware at the other end.

Behind cdc-acm it is the firmware's host build, in this machine; its lamp's edges have this machine's clock.
Behind ftdi_sio it is the chip's image in simavr beside the machine; its edges have the clock out there, so
only what lies between them can be compared. In an emulated machine a byte may be late by tens of
milliseconds.
"""

import os
import signal
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path

import pytest
from kernel import load, until
from monitor import Monitor
from serial_adapter import PtyProgram, adapter

from capture.devices.flash import PulseTrain
from capture.devices.serial_flash import list_flashes
from capture.devices.table import open_flash
from capture.errors import FlashError, FlashGoneError, FlashResetError

CHIP_EDGES = Path("/run/machine/share/chip_edges.txt")
#: Of an edge's time, against the lamp's own: what the round trips in here leave open.
TOLERANCE_S = 0.05


class Rig:
    """A flash on a port: its node, its lamp's edges, its plug."""

    def __init__(self, node, edges_file, pull, say=None):
        self.node = str(node)
        self.pull, self.say = pull, say
        self._file = edges_file
        self._before = len(self._all())

    def _all(self):
        lines = self._file.read_text().splitlines()
        return [(int(ns) * 1e-9, what == "1") for ns, what in map(str.split, lines) if what in "01"]

    @property
    def edges(self):
        """(seconds, lit) since the rig was built."""
        return self._all()[self._before :]

    @property
    def lit(self):
        edges = self.edges
        return bool(edges) and edges[-1][1]


@pytest.fixture
def cdc_acm(tmp_path):
    if not os.environ["DOUBLE"]:
        pytest.skip("there is no C compiler for the firmware's host build")
    load("cdc-acm")
    edges = tmp_path / "edges"
    program = PtyProgram(os.environ["DOUBLE"], "--edges", edges, output=tmp_path / "double.log")
    try:
        with adapter(program) as pull:
            node = until(lambda: next(Path("/dev").glob("ttyACM*"), None), "a port")
            yield Rig(node, edges, pull, program.say)
    finally:
        program.close()


@pytest.fixture
def ftdi():
    if os.environ["WHY_NO_CHIP"]:
        pytest.skip(os.environ["WHY_NO_CHIP"])
    load("xhci-pci")
    load("ftdi_sio")
    monitor = Monitor()
    node = until(lambda: next(Path("/dev").glob("ttyUSB*"), None), "a port")
    out = []

    def pull():
        out.append(True)
        monitor("device_del", id="flash")
        until(lambda: not node.exists() or None, "the end of the port")

    try:
        yield Rig(node, CHIP_EDGES, pull)
    finally:
        if out:
            until(lambda: not list(Path("/dev").glob("ttyUSB*")), "the end of the port")
            monitor("device_add", driver="usb-serial", chardev="line", id="flash")
        monitor.close()
        time.sleep(1.6)  # without a heartbeat the firmware ends its train and goes dark


@pytest.fixture(params=["cdc_acm", "ftdi"])
def rig(request):
    return request.getfixturevalue(request.param)


def train(count=4, on_s=0.1, period_s=0.5, in_s=0.5):
    return PulseTrain(start_s=time.monotonic() + in_s, period_s=period_s, on_s=on_s, count=count)


def edges_until(flash, end_s):
    edges = []
    while time.monotonic() < end_s:
        edges += flash.poll()
        time.sleep(0.02)
    return edges


def test_the_port_is_listed_and_the_firmware_answers(rig):
    assert rig.node in list_flashes()
    with open_flash(rig.node) as flash:
        assert flash.info.back_end == "serial"
        assert "flash-c" in flash.info.details["firmware"]
        assert flash.capabilities.own_schedule
        assert flash.capabilities.watchdog
    assert rig.edges == []


def test_the_ftdi_driver_is_told_to_hand_bytes_over_at_once(ftdi):
    with open_flash(ftdi.node) as flash:
        assert flash.info.details["usb"] == "0403:6001"
        assert flash.info.details["latency_timer_ms"] == 1


def test_a_train_is_run_by_the_firmware_and_its_edges_come_back(rig):
    with open_flash(rig.node) as flash:
        asked = train()
        flash.start(asked)
        edges = edges_until(flash, asked.end_s + 1.0)
        assert flash.off() is True
        assert flash.link_report()
    assert [lit for _, lit in rig.edges] == [True, False] * 4
    assert [(edge.on, edge.pulse) for edge in edges] == [
        (on, pulse) for pulse in range(4) for on in (True, False)
    ]
    lamp_s = [edge_s for edge_s, _ in rig.edges]
    for on_s, off_s in list(pairwise(lamp_s))[::2]:
        # The chip's own clock: ticks of 4 us, and its rate as the host has measured it in a second or two.
        assert off_s - on_s == pytest.approx(0.1, abs=0.002)
    offsets = [edge.time_s - happened_s for edge, happened_s in zip(edges, lamp_s, strict=True)]
    assert max(offsets) - min(offsets) < TOLERANCE_S


def test_edges_are_told_in_the_clock_of_the_host(cdc_acm):
    with open_flash(cdc_acm.node) as flash:
        asked = train()
        flash.start(asked)
        edges = edges_until(flash, asked.end_s + 1.0)
    assert [edge.time_s for edge in edges] == pytest.approx(
        [when for when, _ in cdc_acm.edges], abs=TOLERANCE_S
    )
    assert edges[0].time_s == pytest.approx(asked.start_s, abs=TOLERANCE_S)


def test_a_second_program_is_refused(cdc_acm):
    with open_flash(cdc_acm.node), pytest.raises(FlashError, match="in use"):
        open_flash(cdc_acm.node)


def test_off_in_a_flash_is_dark_and_confirmed(ftdi):
    with open_flash(ftdi.node) as flash:
        flash.start(train(count=50, on_s=0.25))
        until(lambda: ftdi.lit, "light")
        assert flash.off() is True
        until(lambda: not ftdi.lit, "darkness", 1.0)
        count = len(ftdi.edges)
        time.sleep(1.2)
        assert len(ftdi.edges) == count


def test_a_flash_pulled_out_of_the_bus_is_gone_and_goes_dark_by_itself(rig):
    flash = open_flash(rig.node)
    flash.start(train(count=50))
    until(lambda: rig.lit, "light")
    rig.pull()
    with pytest.raises(FlashGoneError):
        edges_until(flash, time.monotonic() + 8)
    assert flash.off() is False
    flash.close()
    flash.close()
    time.sleep(2.0)  # 1.5 s without a heartbeat
    count = len(rig.edges)
    time.sleep(1.0)
    assert not rig.lit
    assert len(rig.edges) == count


def test_a_program_that_is_killed_leaves_the_flash_dark(ftdi):
    program = (
        "import sys, time\n"
        "from capture.devices.table import open_flash\n"
        "from capture.devices.flash import PulseTrain\n"
        "flash = open_flash(sys.argv[1])\n"
        "flash.start(PulseTrain(start_s=time.monotonic() + 0.5, period_s=0.5, on_s=0.2, count=100))\n"
        "time.sleep(60)\n"
    )
    environment = os.environ | {"PYTHONPATH": os.getcwd()}
    process = subprocess.Popen([sys.executable, "-c", program, ftdi.node], env=environment)
    until(lambda: ftdi.lit, "light")
    process.send_signal(signal.SIGKILL)
    process.wait(10)
    time.sleep(2.0)
    count = len(ftdi.edges)
    time.sleep(1.0)
    assert not ftdi.lit
    assert len(ftdi.edges) == count
    assert max(off_s - on_s for (on_s, _), (off_s, _) in list(pairwise(ftdi.edges))[::2]) <= 0.25


def test_a_reset_of_the_flash_is_noticed_and_a_new_train_may_follow(cdc_acm):
    with open_flash(cdc_acm.node) as flash:
        flash.start(train(count=50))
        until(lambda: cdc_acm.lit, "light")
        cdc_acm.say("reset")
        with pytest.raises(FlashResetError):
            edges_until(flash, time.monotonic() + 5)
        assert not cdc_acm.lit
        time.sleep(1.1)  # dark for a second after a start
        before = len(cdc_acm.edges)
        again = train(count=2, in_s=3.0)  # a new handshake comes first
        flash.start(again)
        edges_until(flash, again.end_s + 0.5)
    assert [lit for _, lit in cdc_acm.edges[before:]] == [True, False] * 2
