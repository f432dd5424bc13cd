"""The flash's firmware beside the machine: the chip's image in simavr, in real time, on a pseudo-terminal.

The machine has that terminal as an FTDI adapter. The firmware's host build, for tests that run it in the
machine, is made here too, where the compiler is.
"""

import os
import re
import shutil
import subprocess
import time

FIRMWARE = "firmware_protocol/firmware"
RUNNER = "tests/firmware_protocol/simavr/runner.c"
_START_S = 10.0


class Chip:
    """The simulated chip, while it runs.

    Attributes:
        terminal: Its serial port; None when there is no chip.
        double: The firmware's host build; None when there is no compiler.
        why_not: Why there is no chip; empty when there is one.
    """

    def __init__(self, folder, share):
        self.terminal = self.double = None
        self.why_not = ""
        self._folder = folder / "firmware"
        self._edges = share / "chip_edges.txt"
        self._process = None

    def __enter__(self):
        self.double = self._folder / "flash_double" if self._made("host") else None
        self.why_not = self._start()
        return self

    def __exit__(self, *_):
        if self._process is not None:
            self._process.kill()
            self._process.communicate()  # closes its input and waits

    def _start(self):
        if not self._made("avr"):
            return "avr-gcc is missing"
        runner = self._folder / "runner"
        built = ["cc", "-std=gnu99", "-O2", RUNNER, "-o", runner, "-lsimavr", "-lelf"]
        if subprocess.run(built, capture_output=True, check=False).returncode:
            return "simavr is missing"
        self._edges.unlink(missing_ok=True)
        said = self._folder / "runner.log"
        with said.open("w") as output:
            self._process = subprocess.Popen(
                [runner, self._folder / "flash.elf", "--edges", self._edges],
                stdin=subprocess.PIPE,
                stdout=output,
            )
        end_s = time.monotonic() + _START_S
        while time.monotonic() < end_s:
            if told := re.search(r"^pty (\S+)", said.read_text(), re.MULTILINE):
                self.terminal = told[1]
                return ""
            time.sleep(0.05)
        return "simavr's runner did not start"

    def _made(self, target):
        """Whether the firmware's own Makefile made a target."""
        if shutil.which("make") is None:
            return False
        self._folder.mkdir(parents=True, exist_ok=True)
        return not subprocess.run(
            ["make", "-s", "-C", FIRMWARE, f"BUILD={os.path.abspath(self._folder)}", target],
            capture_output=True,
            check=False,
        ).returncode
