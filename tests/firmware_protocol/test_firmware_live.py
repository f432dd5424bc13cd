"""The two simulated devices in real time, as a host's link meets them: a terminal, and nothing to steer.

Only what does not depend on the speed of the machine is judged: the device's own ticks, and that it answers.
"""

import os
import select
import subprocess
import time

import pytest

from firmware_protocol import Decoder, Event, Hello, Packet, Set, Stat, encode
from firmware_protocol.limits import FULL_LEVEL

PATIENCE_S = 20.0


class Live:
    """A device that runs by itself."""

    def __init__(self, *command):
        self.process = subprocess.Popen(
            [*map(str, command)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        line = self.process.stdout.readline()
        while not line.startswith("pty "):
            assert line, "the device did not start"
            line = self.process.stdout.readline()
        self.line = os.open(line.split()[1], os.O_RDWR | os.O_NOCTTY)
        self.decoder = Decoder()
        self.packets = []

    def close(self):
        self.process.stdin.close()
        self.process.stdout.read()
        self.process.stdout.close()
        code = self.process.wait(timeout=5)
        os.close(self.line)
        assert code == 0

    def until(self, wanted, repeat=b""):
        """Reads until a packet is wanted; sends `repeat` each 100 ms, as the protocol says."""
        end = time.monotonic() + PATIENCE_S
        again = 0.0
        while time.monotonic() < end:
            for packet in self.packets:
                if wanted(packet):
                    self.packets.remove(packet)
                    return packet.message
            if repeat and time.monotonic() > again:
                os.write(self.line, repeat)
                again = time.monotonic() + 0.1
            if select.select([self.line], [], [], 0.1)[0]:
                found = self.decoder.feed(os.read(self.line, 4096))
                self.packets += [item for item in found if isinstance(item, Packet)]
        raise AssertionError("no such packet came")


@pytest.fixture
def edges_file(tmp_path):
    return tmp_path / "edges.txt"


@pytest.fixture(params=["double", "simavr"])
def live(request, edges_file):
    if request.param == "double":
        device = Live(request.getfixturevalue("host_build") / "flash_double", "--edges", edges_file)
    else:
        image = request.getfixturevalue("avr_build") / "flash.elf"
        device = Live(request.getfixturevalue("runner"), image, "--edges", edges_file)
    yield device
    device.close()


def light_once(live):
    """(EVENT on, EVENT off, tick_hz) of a flash of 50 ms."""
    hello = live.until(lambda p: p.seq == 1, repeat=encode(Hello.from_host("live"), 1))
    assert hello.boot_nonce
    # The device refuses its first second; the numbers are new ones until it obeys.
    for seq in range(2, 200):
        answer = live.until(
            lambda p, seq=seq: p.seq == seq, repeat=encode(Set(hello.boot_nonce, FULL_LEVEL, 50), seq)
        )
        if isinstance(answer, Stat):
            break
        time.sleep(0.05)
    on = live.until(lambda p: isinstance(p.message, Event) and p.message.edge == 1)
    off = live.until(lambda p: isinstance(p.message, Event) and p.message.edge == 0)
    return on, off, hello.tick_hz


def test_a_host_shakes_hands_and_lights_the_lamp_once(live):
    on, off, tick_hz = light_once(live)
    assert on.pulse == off.pulse == 1
    # In ticks of the device, whose clock does not know how busy this machine is: exact but for two roundings.
    assert (off.tick - on.tick) / tick_hz == pytest.approx(0.05, abs=8e-6)


def told_until_now(edges_file, patience_s=5.0):
    """The file's lines up to a time after the last edge; a machine that is held up writes that one late."""
    give_up_s = time.monotonic() + patience_s
    while True:
        lines = [
            line.split() for line in edges_file.read_text().splitlines(keepends=True) if line.endswith("\n")
        ]
        if lines[-1][1] == "t" or time.monotonic() > give_up_s:
            return lines
        time.sleep(0.005)


def test_the_edges_file_has_the_lamp_by_the_clock_of_the_system(live, edges_file):
    before_ns = time.clock_gettime_ns(time.CLOCK_MONOTONIC)
    on, off, tick_hz = light_once(live)
    after_ns = time.clock_gettime_ns(time.CLOCK_MONOTONIC)
    lines = told_until_now(edges_file)
    times_ns = [int(when) for when, _ in lines]
    assert times_ns == sorted(times_ns)
    (on_ns, off_ns) = (int(when) for when, what in lines if what != "t")
    assert before_ns < on_ns < off_ns < after_ns
    # The file's edges and the firmware's own ticks are the same two moments, but for their roundings.
    assert (off_ns - on_ns) * 1e-9 == pytest.approx((off.tick - on.tick) / tick_hz, abs=8e-6)
    assert sum(what == "t" for _, what in lines) > 2  # hundreds, but on a machine that is held up
    assert lines[-1][1] == "t"  # its time goes on after the last edge
