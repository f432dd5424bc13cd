"""A USB serial adapter (CDC-ACM) in Python with a program behind it that listens on a pseudo-terminal."""

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


@contextmanager
def program_on_a_wire(*command, output, name="Flash", serial="0001"):
    """Starts the program and plugs it in; yields a function that pulls the plug; the program lives on.

    Args:
        command: Program that prints "pty PATH ..." and lives until its input ends.
        output: File for what it prints.
        name: Product's name.
        serial: Number of the adapter.
    """
    with output.open("w") as said:
        process = subprocess.Popen([*map(str, command)], stdin=subprocess.PIPE, stdout=said, stderr=said)
    try:
        path = until(lambda: re.search(r"^pty (\S+)", output.read_text(), re.MULTILINE), "a pty")[1]
        line = os.open(path, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(line)
        device = USBDevice(0x1209, 0x0003, product=name, manufacturer="Tests", serial=serial)
        port = device.add(CDCACM(on_rx=lambda port, data: os.write(line, data)))
        ended, end = os.pipe()
        pump = threading.Thread(target=_pump, args=(line, ended, port), daemon=True)
        pump.start()
        with plugged(device) as pull:
            yield pull
        os.write(end, b"x")
        pump.join()
    finally:
        process.stdin.close()
        process.wait(10)
        for file in (line, ended, end):
            os.close(file)


def _pump(line, ended, port):
    while ended not in select.select([line, ended], [], [])[0]:
        port.write(os.read(line, 4096))
