"""A USB bus of the kernel (vhci-hcd) into which devices made in Python are plugged.

The device is served by threads of this process; the kernel meets it as it meets any other, through a socket.
"""

import socket
import threading
from contextlib import contextmanager
from pathlib import Path

from kernel import load, until
from usbip import core, protocol

_BUS = Path("/sys/devices/platform/vhci_hcd.0")
_FREE, _USED = "004", "006"  # <linux/usbip.h>: VDEV_ST_NULL, VDEV_ST_USED


@contextmanager
def plugged(device, patience_s=20.0):
    """The device is in the bus; yields a function that pulls it out."""
    load("vhci-hcd")
    port = _free_port()
    ours, kernels = socket.socketpair()
    threading.Thread(target=protocol.serve_connection, args=(ours, device), daemon=True).start()
    protocol.client_import(kernels)
    speed = core.WIRE_SPEED[device.speed]
    (_BUS / "attach").write_text(f"{port} {kernels.fileno()} {1 << 16 | 2} {speed}\n")
    kernels.close()
    until(lambda: _status(port) == _USED, "an answer of the bus", patience_s)
    out = []

    def pull():
        if not out:
            out.append(True)
            (_BUS / "detach").write_text(f"{port}\n")
            until(lambda: _status(port) == _FREE, "the end of the device", patience_s)

    try:
        yield pull
    finally:
        pull()


def _ports():
    """(number, status) of the ports of the high-speed hub."""
    lines = (_BUS / "status").read_text().splitlines()[1:]
    return [(int(words[1]), words[2]) for words in map(str.split, lines) if words[0] == "hs"]


def _free_port():
    return next(port for port, status in _ports() if status == _FREE)


def _status(port):
    return dict(_ports())[port]
