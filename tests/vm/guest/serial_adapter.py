"""A USB serial adapter (CDC-ACM) in Python, and behind it a program that listens on a pseudo-terminal."""

import os
import re
import select
import subprocess
import threading
import tty
from contextlib import contextmanager

from kernel import until
from usb_bus import plugged
from usbip import USBDevice
from usbip.classes.device.cdc_acm import CDCACM


class PtyProgram:
    """A program that prints "pty PATH ..." and lives until its input ends; its terminal is ours."""

    def __init__(self, *command, output):
        self._output = output
        with output.open("w") as said:
            self._process = subprocess.Popen(
                [*map(str, command)], stdin=subprocess.PIPE, stdout=said, stderr=said, text=True
            )
        path = until(lambda: re.search(r"^pty (\S+)", output.read_text(), re.MULTILINE), "a pty")[1]
        self.line = os.open(path, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(self.line)

    def say(self, text):
        """A line to its standard input."""
        self._process.stdin.write(text + "\n")
        self._process.stdin.flush()

    def close(self):
        self._process.stdin.close()
        self._process.wait(10)
        os.close(self.line)


@contextmanager
def adapter(program, vendor=0x2341, product=0x0043, name="Flash", serial="0001"):
    """Plugs an adapter with a `PtyProgram` behind it in; yields a function that pulls it out.

    The program lives on then, as a board with a battery would.
    """
    device = USBDevice(vendor, product, product=name, manufacturer="Tests", serial=serial)
    port = device.add(CDCACM(on_rx=lambda port, data: os.write(program.line, data)))
    ended, end = os.pipe()
    pump = threading.Thread(target=_pump, args=(program.line, ended, port), daemon=True)
    pump.start()
    try:
        with plugged(device) as pull:
            yield pull
    finally:
        os.write(end, b"x")
        pump.join()
        os.close(ended)
        os.close(end)


def _pump(line, ended, port):
    while ended not in (ready := select.select([line, ended], [], [])[0]):
        if ready:
            port.write(os.read(line, 4096))
