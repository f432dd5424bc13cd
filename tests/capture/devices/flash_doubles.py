"""The reference firmware as a device for the host's tests: in steps of simulated time, or live.

    SteppedCore     the firmware's C in this process, a microsecond clock; thousands of sessions in seconds
    SteppedProgram  flash_double or simavr's runner with --step, in processes of their own
    StepLine        either of them as a ByteTransport whose waits are what moves its time
    LiveDevice      the program in real time behind a pseudo-terminal, with its edges file

Not modelled: USB, a boot loader (but `StepLine.boot_s`), a supply that gives way, light.
"""

import ctypes
import fcntl
import math
import os
import shutil
import subprocess
import threading
from contextlib import suppress
from pathlib import Path

import pytest

import firmware_protocol
from capture.errors import FlashGoneError

FIRMWARE = Path(firmware_protocol.__file__).parent / "firmware"
RUNNER = Path(__file__).parents[2] / "firmware_protocol" / "simavr" / "runner.c"
# A leak check needs ptrace, which containers forbid; the firmware allocates nothing that could leak.
ENVIRONMENT = os.environ | {"ASAN_OPTIONS": "detect_leaks=0"}
US = 1_000_000


def need(*tools):
    for tool in tools:
        if shutil.which(tool) is None:
            pytest.skip(f"{tool} is missing")


def _run(*command):
    made = subprocess.run([*map(str, command)], capture_output=True, text=True, check=False)
    if made.returncode and any(word in made.stderr for word in ("sim_avr.h", "avr_uart.h", "cannot find -l")):
        pytest.skip("simavr is missing")
    assert made.returncode == 0, made.stdout + made.stderr


def build(directory, name):
    """One of "core", "flash_double", "flash.elf", "runner"; once for all test processes of a run."""
    directory.mkdir(exist_ok=True)
    made = directory / name
    with (directory / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if made.exists():
            return made
        if name == "core":
            need("cc")
            sources = [*sorted((FIRMWARE / "core").glob("*.c")), FIRMWARE / "ports" / "host" / "port_host.c"]
            include = ["-I", FIRMWARE / "core", "-I", FIRMWARE / "ports" / "host"]
            _run("cc", "-std=c99", "-O2", "-fPIC", "-shared", *include, *sources, "-o", made)
        elif name == "runner":
            need("cc")
            _run("cc", "-std=gnu99", "-O2", RUNNER, "-o", made, "-lsimavr", "-lelf")
        else:
            need("make", "avr-gcc" if name == "flash.elf" else "cc")
            _run("make", "-C", FIRMWARE, f"BUILD={directory}", directory / name)
    return made


class _Edge(ctypes.Structure):
    _fields_ = (("tick", ctypes.c_uint64), ("on", ctypes.c_bool))


class SteppedCore:
    """The firmware in this process. There is one: a second takes the place of the first.

    Attributes:
        edges: (seconds, on) since it was made, by its own clock.
        now_us: Since it was made.
    """

    IDLE = 0

    def __init__(self, library, clock_us=0):
        self._core = ctypes.CDLL(str(library))
        self._edge_hook = ctypes.CFUNCTYPE(None, ctypes.POINTER(_Edge))(self._on_edge)
        self._sent_hook = ctypes.CFUNCTYPE(None, ctypes.c_uint8)(self._on_sent)
        for name, hook in (("host_edge_hook", self._edge_hook), ("host_sent_hook", self._sent_hook)):
            ctypes.c_void_p.in_dll(self._core, name).value = ctypes.cast(hook, ctypes.c_void_p).value
        self._core.host_advance.argtypes = [ctypes.c_uint64]
        self._core.host_set_clock.argtypes = [ctypes.c_uint64]
        self._core.host_receive.argtypes = [ctypes.c_char_p, ctypes.c_size_t]
        self._core.host_reset.argtypes = [ctypes.c_uint32, ctypes.c_uint8]
        self.edges = []
        self._out = bytearray()
        self.now_us = self._reset_us = 0
        self._nonce = 0x1234
        self.reset(clock_us)

    def _on_edge(self, edge):
        since_us = (edge.contents.tick - self._clock_us) % 2**64
        self.edges.append(((self._reset_us + since_us) / US, edge.contents.on))

    def _on_sent(self, byte):
        self._out.append(byte)

    def reset(self, clock_us=0):
        """The counter begins anew, as a chip's does."""
        self._reset_us, self._clock_us = self.now_us, clock_us
        self._core.host_set_clock(clock_us)
        self._nonce = (self._nonce * 1_103_515_245 + 12_345) % 2**32 or 1
        self._core.host_reset(self._nonce, self.IDLE)

    def advance(self, us):
        self.now_us += us
        self._core.host_advance((self._clock_us + self.now_us - self._reset_us) % 2**64)

    def feed(self, data):
        self._core.host_receive(bytes(data), len(data))

    def take(self):
        out = bytes(self._out)
        self._out.clear()
        return out

    def close(self):
        ctypes.c_void_p.in_dll(self._core, "host_edge_hook").value = None
        ctypes.c_void_p.in_dll(self._core, "host_sent_hook").value = None


class SteppedProgram:
    """The same as `SteppedCore`, of a program with --step."""

    def __init__(self, *command):
        self._process = subprocess.Popen(
            [*map(str, command), "--step"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            bufsize=1,
            env=ENVIRONMENT,
        )
        _, path, hz = _first_line(self._process).split()
        self._hz = int(hz)
        self._line = os.open(path, os.O_RDWR | os.O_NOCTTY)
        self._told = self._heard = 0
        self._out = bytearray()
        self.edges = []
        self.now_us = 0

    def reset(self):
        self.command("reset")

    def command(self, text):
        self._process.stdin.write(text + "\n")

    def advance(self, us):
        self.now_us += us
        self._process.stdin.write(f"run {us} {self._told}\n")
        while (words := self._process.stdout.readline().split())[0] != "ok":
            if words[0] == "edge":
                self.edges.append((int(words[1]) / self._hz, words[2] == "1"))
        while self._heard < int(words[2]):
            data = os.read(self._line, 65536)
            self._heard += len(data)
            self._out += data

    def feed(self, data):
        self._told += len(data)
        while data:
            data = data[os.write(self._line, data) :]

    def take(self):
        out = bytes(self._out)
        self._out.clear()
        return out

    def close(self):
        _end(self._process)
        os.close(self._line)


class StepLine:
    """A stepped device as a `ByteTransport` and as the `Clock` of its host: time passes as either waits.

    Attributes:
        rate: Device seconds in a host second.
        step_us: Bytes come and go this often.
        boot_s: How long the boot loader holds a device that was reset, deaf.
        boot_noise: What it says meanwhile.
        unplugged: Everything fails.
    """

    description = "the stepped device"
    seconds_per_byte = 10 / 115_200

    def __init__(self, device, *, rate=1.0, step_us=500, boot_s=0.0, boot_noise=b""):
        self.device = device
        self.rate, self.step_us, self.boot_s, self.boot_noise = rate, step_us, boot_s, boot_noise
        self.unplugged = False
        self.closed = False
        self._now_us = 0
        self._rest = 0.0
        self._booted_us = None
        self._out = bytearray()

    # ---- the host's clock

    def now_s(self):
        return 1000.0 + self._now_us / US

    def sleep(self, seconds):
        end_us = self._now_us + math.ceil(max(0.0, seconds) * US)
        while self._now_us < end_us:
            self._step(min(self.step_us, end_us - self._now_us))

    def _step(self, us):
        self._now_us += us
        self._rest += us * self.rate
        whole = int(self._rest)
        self._rest -= whole
        self.device.advance(whole)
        if self._booted_us is not None:
            self.device.take()
            if self._now_us >= self._booted_us:
                self._booted_us = None
                self.device.reset()
        self._out += self.device.take()

    def lamp(self):
        """(host seconds, on)."""
        return [(1000.0 + t / self.rate, on) for t, on in self.device.edges]

    # ---- faults

    def reset(self):
        """The reset button: dark at once, then the boot loader."""
        self.device.reset()
        if self.boot_s:
            self.device.take()
            self._booted_us = self._now_us + round(self.boot_s * US)
        self._out += self.boot_noise

    # ---- the line

    def write(self, data):
        self._check()
        if self._booted_us is None:
            self.device.feed(data)

    def read(self, timeout_s):
        self._check()
        end_us = self._now_us + math.ceil(max(0.0, timeout_s) * US)
        while not self._out and self._now_us < end_us:
            self._step(min(self.step_us, end_us - self._now_us))
        data = bytes(self._out)
        self._out.clear()
        self._check()
        return data

    def take_all(self):
        """What has come and nobody has read, as a driver forgets it when its port is opened anew."""
        self._out.clear()

    def close(self):
        self.closed = True

    def _check(self):
        if self.unplugged or self.closed:
            raise FlashGoneError(f"{self.description} is not there any more.")


def damage(data, random, odds):
    """Bytes as a bad line passes them on: each at these odds flipped, lost, doubled, among foreign ones."""
    out = bytearray()
    for byte in data:
        if not odds or random.random() >= odds:
            out.append(byte)
            continue
        kind = random.randrange(6)
        if kind == 0:
            out.append(byte ^ 1 << random.randrange(8))
        elif kind == 2:
            out += bytes((byte, byte))
        elif kind == 3:
            out += random.randbytes(random.randrange(1, 80)) + bytes((byte,))
        elif kind == 4:
            out += bytes(out[-40:]) + bytes((byte,))  # what has just passed, again
        elif kind == 5:
            out += b"\0"
    return bytes(out)


class LiveDevice:
    """A program in real time.

    Attributes:
        path: Of the terminal to open.
    """

    def __init__(self, *command, edges_file):
        self._edges_file = Path(edges_file)
        self.process = subprocess.Popen(
            [*map(str, command), "--edges", str(edges_file)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=ENVIRONMENT,
        )
        self.path = _first_line(self.process).split()[1]
        self._reader = threading.Thread(target=self._drain, daemon=True)
        self._reader.start()

    def _drain(self):
        for _ in self.process.stdout:
            pass

    def command(self, text):
        self.process.stdin.write(text + "\n")
        self.process.stdin.flush()

    def lamp(self):
        """(CLOCK_MONOTONIC seconds, on)."""
        lines = self._edges_file.read_text().splitlines() if self._edges_file.exists() else []
        pairs = [line.split() for line in lines if not line.endswith("t")]
        return [(int(pair[0]) * 1e-9, pair[1] == "1") for pair in pairs if len(pair) == 2]

    def close(self):
        with suppress(BrokenPipeError, ValueError):
            self.process.stdin.close()
        code = self.process.wait(timeout=10)
        self._reader.join(timeout=10)
        self.process.stdout.close()
        assert code == 0, "the device's program failed: a sanitizer's report is on stderr"


def _first_line(process):
    line = process.stdout.readline()
    while not line.startswith("pty "):
        assert line, "the device did not start"
        line = process.stdout.readline()
    return line


def _end(process):
    with suppress(BrokenPipeError):
        process.stdin.close()
    process.stdout.read()
    process.stdout.close()
    code = process.wait(timeout=10)
    assert code == 0, "the device's program failed: a sanitizer's report is on stderr"
