"""The process that puts a lamp out when its host dies or hangs."""

import os
import signal
import subprocess
import sys
import time

import pytest

from capture.devices.bench import Bench, VirtualClock
from capture.devices.hid import guard as guard_module
from capture.devices.hid.guard import Guard, put_out_device, start_guard, watch
from capture.devices.hid.transport import HidAddress
from capture.errors import FlashGoneError

pytestmark = pytest.mark.skipif(os.name != "posix", reason="there is no guard on this system")

ADDRESS = HidAddress(path="/dev/hidraw0", vendor_id=0x046D, product_id=0xC900)

#: A guard whose lamp is a file, in place of a device.
WATCH = """
import sys
from capture.devices.hid.guard import watch
sys.stdout.write("r"); sys.stdout.flush()
watch(0, lambda: open(sys.argv[1], "a").write("out\\n"), float(sys.argv[2]))
"""
HOST = """
import sys, time
from capture.devices.hid.guard import Guard
guard = Guard([sys.executable, "-c", *sys.argv[1:]])
guard.lit(True)
print("lit", flush=True)
time.sleep(60)
"""


@pytest.mark.parametrize(
    ("words", "times"), [(b"1010x", 0), (b"x", 0), (b"10", 1), (b"1", 1), (b"", 1), (b"10101", 1)]
)
def test_it_acts_when_the_pipe_ends_without_a_farewell(words, times):
    read, write = os.pipe()
    os.write(write, words)
    os.close(write)
    put_out = []
    watch(read, lambda: put_out.append(1))
    os.close(read)
    assert len(put_out) == times


def test_it_acts_when_the_light_is_not_taken_back_in_time():
    read, write = os.pipe()
    put_out = []

    def out():
        put_out.append(1)
        os.write(write, b"x")  # else it would wait on

    os.write(write, b"1")
    watch(read, out, limit_s=0.02)
    os.close(read)
    os.close(write)
    assert put_out == [1]


@pytest.fixture
def lit_host(tmp_path):
    """Starts a host with its light on: (process, what its guard wrote so far)."""
    lamp = tmp_path / "lamp"
    hosts = []

    def start(limit_s):
        command = [sys.executable, "-c", HOST, WATCH, str(lamp), str(limit_s)]
        hosts.append(subprocess.Popen(command, stdout=subprocess.PIPE, text=True))
        assert hosts[-1].stdout.readline() == "lit\n"
        return hosts[-1], lambda: lamp.read_text() if lamp.exists() else ""

    yield start
    for host in hosts:
        host.kill()
        host.wait(10)
        host.stdout.close()


def text_of(written):
    deadline_s = time.monotonic() + 10
    while not written() and time.monotonic() < deadline_s:
        time.sleep(0.01)
    return written()


def test_a_host_that_is_killed_while_the_light_is_on_has_it_put_out(lit_host):
    host, written = lit_host(limit_s=60)  # the test does not live to see it: it is the death that is noticed
    host.send_signal(signal.SIGKILL)
    assert text_of(written) == "out\n"


def test_a_host_that_stands_still_while_the_light_is_on_has_it_put_out(lit_host):
    host, written = lit_host(limit_s=0.3)
    host.send_signal(signal.SIGSTOP)
    assert text_of(written) == "out\n"


def test_a_host_that_says_farewell_is_left_alone(tmp_path):
    lamp = tmp_path / "lamp"
    guard = Guard([sys.executable, "-c", WATCH, str(lamp), "60"])
    guard.lit(True)
    guard.lit(False)
    guard.end()
    assert not lamp.exists()


def test_a_guard_that_does_not_run_harms_nothing_but_is_told(caplog):
    guard = Guard([sys.executable, "-c", "raise SystemExit(1)"])
    guard.lit(True)
    guard.lit(False)
    guard.end()
    assert "its guard does not run" in caplog.text


def test_it_sends_the_report_to_the_same_device_again_and_again_until_it_is_taken(monkeypatch):
    sent, tries = [], []

    class Transport:
        def write(self, report):
            tries.append(report)
            if len(tries) < 3:
                raise FlashGoneError("busy")
            sent.append(("out", report))

        def send_feature(self, report):
            sent.append(("set", report))

        def close(self):
            pass

    monkeypatch.setattr(guard_module, "_PAUSE_S", 0.0)
    monkeypatch.setattr(guard_module, "find_devices", lambda vendor, products: [ADDRESS])
    monkeypatch.setattr(guard_module, "open_device", lambda address: Transport())
    put_out_device("/dev/hidraw0", 0x046D, 0xC900, "out", b"dark")
    put_out_device("/dev/hidraw0", 0x046D, 0xC900, "set", b"dark")
    put_out_device("/dev/hidraw1", 0x046D, 0xC900, "set", b"dark")  # another device by now: left alone
    assert sent == [("out", b"dark"), ("set", b"dark")]


def test_there_is_none_in_simulated_time():
    assert start_guard(ADDRESS, ("out", b"dark"), Bench(VirtualClock())) is None


def test_the_process_itself_starts_and_ends():
    guard = start_guard(ADDRESS, ("out", b"dark"), Bench())
    assert guard is not None
    guard.lit(True)
    guard.lit(False)
    guard.end()
    assert guard._process.returncode == 0
