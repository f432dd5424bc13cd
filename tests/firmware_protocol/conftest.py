"""The firmware built from its sources and driven through a pseudo-terminal, in steps of its own time.

Two devices answer to the same harness: the host build, whose clock ticks in microseconds, and the image for
the ATmega328P as built, run by simavr and timed in processor cycles. Neither depends on the speed of the
machine: time passes only when a test says so.
"""

import fcntl
import os
import shutil
import subprocess
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

import firmware_protocol
from firmware_protocol import Decoder, Hello, Packet, Ping, encode

FIRMWARE = Path(firmware_protocol.__file__).parent / "firmware"
RUNNER = Path(__file__).parent / "simavr" / "runner.c"
US_PER_S = 1_000_000

# A leak check needs ptrace, which containers forbid; the firmware allocates nothing that could leak.
ENVIRONMENT = os.environ | {"ASAN_OPTIONS": "detect_leaks=0"}


class Flash:
    """A device behind its pseudo-terminal, with the few things a host does.

    Attributes:
        edges: (seconds, on) for each edge of the lamp pin so far.
        packets: What the device has sent and nobody has taken.
        noise: Bytes between delimiters that were no packet: banners, mostly.
        sent_s: With --trace, when each byte began to leave the device's pin.
        heard_s: With --trace, when each byte had arrived there.
    """

    def __init__(self, *command):
        self._process = subprocess.Popen(
            [*map(str, command), "--step"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            bufsize=1,
            env=ENVIRONMENT,
        )
        line = self._process.stdout.readline()
        while not line.startswith("pty "):
            assert line, "the device did not start"
            line = self._process.stdout.readline()
        _, self.path, hz = line.split()
        self.clock_hz = int(hz)
        self._line = os.open(self.path, os.O_RDWR | os.O_NOCTTY)
        self._told = self._heard = 0
        self.raw = b""
        self.now_s = 0.0
        self.stack = None
        self.edges, self.packets, self.noise = [], [], []
        self.sent_s, self.heard_s = [], []
        self._decoder = Decoder()
        self.seq = 0
        self.nonce = None

    def close(self):
        with suppress(BrokenPipeError):
            self._process.stdin.close()
        self._process.stdout.read()
        self._process.stdout.close()
        code = self._process.wait(timeout=5)
        os.close(self._line)
        assert code == 0, "the device's program failed: a sanitizer's report is on stderr"

    def write(self, data):
        """Bytes onto the line; the device meets them when time next passes."""
        self._told += len(data)
        while data:
            data = data[os.write(self._line, data) :]

    def run(self, seconds):
        """Let device time pass, not too long at once, so that what the device says fits the line's buffer."""
        us = round(seconds * US_PER_S)
        while us > 0:
            self._step(min(us, 3 * US_PER_S))
            us -= 3 * US_PER_S

    def _step(self, us):
        self.command(f"run {us} {self._told}")
        while True:
            line = self._process.stdout.readline()
            assert line, "the device's program ended: see stderr"
            word, when, *rest = line.split()
            if word == "edge":
                self.edges.append((int(when) / self.clock_hz, rest[0] == "1"))
            elif word == "sent":
                self.sent_s.append(int(when) / self.clock_hz)
            elif word == "heard":
                self.heard_s.append(int(when) / self.clock_hz)
            elif word == "ok":
                break
        self.now_s = int(when) / self.clock_hz
        self.stack = int(rest[1]) if len(rest) > 1 else None
        total = int(rest[0])
        while self._heard < total:
            data = os.read(self._line, 65536)
            self._heard += len(data)
            self.raw += data
            for item in self._decoder.feed(data):
                (self.packets if isinstance(item, Packet) else self.noise).append(item)

    def command(self, text):
        self._process.stdin.write(text + "\n")

    @property
    def lit(self):
        return bool(self.edges) and self.edges[-1][1]

    def pulses(self):
        """(start, width) in seconds of each pulse that has ended."""
        return [(on, off - on) for (on, _), (off, _) in zip(self.edges[::2], self.edges[1::2], strict=False)]

    def take(self, kind=None):
        """The packets so far, all or those with one kind of message; they are gone then."""
        taken = [p for p in self.packets if kind is None or isinstance(p.message, kind)]
        self.packets = [p for p in self.packets if not (kind is None or isinstance(p.message, kind))]
        return taken

    def ask(self, message, seq=None, within_s=0.02):
        """Sends a command and gives back the answer that carries its number."""
        self.seq = self.seq % 0xFFFF + 1 if seq is None else seq
        self.write(encode(message, self.seq))
        self.run(within_s)
        answers = [p for p in self.packets if p.seq == self.seq]
        assert answers, f"no answer to {message}"
        self.packets = [p for p in self.packets if p.seq != self.seq]
        assert len(answers) == 1, answers
        return answers[0].message

    def hello(self):
        """The handshake, then the second in which the lamp stays dark after a start."""
        answer = self.ask(Hello.from_host("test"))
        self.nonce, self.tick_hz = answer.boot_nonce, answer.tick_hz
        return answer

    def ready(self):
        self.run(1.05)
        self.hello()
        self.take()
        return self

    def ping(self):
        return self.ask(Ping(round(self.now_s * US_PER_S)))

    def keep_alive(self, seconds):
        """Lets time pass with a PING each half second."""
        while seconds > 0:
            self.ping()
            self.run(min(seconds, 0.5) - 0.02)
            seconds -= 0.5

    def tick_in(self, seconds):
        """The device's clock that far from now."""
        return self.ping().t3_tick + round(seconds * self.tick_hz)


def build(directory, *targets, **variables):
    """Makes targets of the firmware's own Makefile; once, however many test processes share the directory."""
    directory.mkdir(exist_ok=True)
    with (directory / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        return _make(directory, *targets, **variables)


def _make(directory, *targets, **variables):
    settings = [f"{name}={value}" for name, value in variables.items()]
    made = subprocess.run(
        ["make", "-C", FIRMWARE, f"BUILD={directory}", "STRICT=-Werror", *targets, *settings],
        capture_output=True,
        text=True,
        check=False,
    )
    assert made.returncode == 0, made.stdout + made.stderr
    return directory


def need(*tools):
    for tool in tools:
        if shutil.which(tool) is None:
            pytest.skip(f"{tool} is missing")


@pytest.fixture(scope="session")
def shared_directory(tmp_path_factory):
    """Of all test processes of one run: under xdist, each worker has a directory of its own below it."""
    base = tmp_path_factory.getbasetemp()
    return base.parent if os.environ.get("PYTEST_XDIST_WORKER") else base


@pytest.fixture(scope="session")
def host_build(shared_directory):
    need("make", "cc")
    return build(shared_directory / "firmware", "host")


@pytest.fixture(scope="session")
def fuzz_build(host_build):
    return build(host_build, host_build / "fuzz", host_build / "corpus.txt")


@pytest.fixture(scope="session")
def sanitizer_environment():
    return ENVIRONMENT


@pytest.fixture(scope="session")
def avr_build(shared_directory):
    need("make", "avr-gcc")
    return build(shared_directory / "firmware", "avr")


@pytest.fixture(scope="session")
def runner(tmp_path_factory):
    need("cc")
    program = tmp_path_factory.mktemp("runner") / "runner"
    made = subprocess.run(
        ["cc", "-std=gnu99", "-O2", "-Wall", "-Wextra", RUNNER, "-o", program, "-lsimavr", "-lelf"],
        capture_output=True,
        text=True,
        check=False,
    )
    if made.returncode:
        if "sim_avr.h" in made.stderr or "avr_uart.h" in made.stderr or "cannot find -l" in made.stderr:
            pytest.skip("simavr is missing")
        pytest.fail(made.stderr)
    assert not made.stderr, made.stderr
    return program


@contextmanager
def _opened(*command):
    flash = Flash(*command)
    try:
        yield flash
    finally:
        flash.close()


@pytest.fixture
def opened():
    """Opens a device: `with opened(program, *arguments) as flash`."""
    return _opened


@pytest.fixture
def double(host_build):
    """The host build."""
    with _opened(host_build / "flash_double") as flash:
        yield flash


@pytest.fixture
def avr(avr_build, runner):
    """The image for the ATmega328P, in simavr."""
    with _opened(runner, avr_build / "flash.elf", "--trace") as flash:
        yield flash


@pytest.fixture
def avr_on_d10(avr_build, runner, tmp_path):
    """The same with its lamp at the other pin."""
    with _opened(runner, build(tmp_path, "avr", LAMP_PIN=10) / "flash.elf") as flash:
        yield flash


@pytest.fixture(params=["host", "avr"])
def flash(request):
    """Either of them."""
    return request.getfixturevalue("double" if request.param == "host" else "avr")
