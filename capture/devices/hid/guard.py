"""A process of its own that puts a lamp out when the one that lights it dies or hangs.

A bought lamp stays as it is when its host is killed in the middle of a flash, and nothing within a process
survives its death. So the host opens a pipe to a small process that waits: '1' before each light, '0' after,
'x' when it is closed in order. When the pipe ends without an 'x', or a '1' is not taken back in time, the
process opens the lamp by itself and sends the report that turns it off. It cannot help when the whole machine
stops, and there is none on Windows, whose pipes cannot be waited for with a timeout.

    python -m capture.devices.hid.guard PATH VENDOR PRODUCT out|set REPORT
"""

from __future__ import annotations

import contextlib
import logging
import os
import select
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from capture.devices.bench import Bench, MonotonicClock
from capture.devices.flash import LONGEST_ON_S
from capture.devices.hid.transport import HidAddress, find_devices, open_device
from capture.errors import FlashError

_log = logging.getLogger(__name__)

#: A light that is not taken back within this is put out: the longest flash, and what a busy host may be late.
LIMIT_S = LONGEST_ON_S + 0.1
_START_S = 5.0
_END_S = 2.0
_TRIES, _PAUSE_S = 20, 0.1
_LIT, _DARK, _END, _READY = b"1", b"0", b"x", b"r"


class Guard:
    """The host's end of the pipe. Never raises: a lamp works without a guard too, and the log says so."""

    def __init__(self, command: list[str]) -> None:
        """Starts the process and waits until it is ready.

        Args:
            command: Of the process.
        """
        root = str(Path(__file__).resolve().parents[3])
        paths = [root, *filter(None, [os.environ.get("PYTHONPATH")])]
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=os.environ | {"PYTHONPATH": os.pathsep.join(paths)},
            start_new_session=True,  # a key that interrupts us must not end it
        )
        self._alive = True
        assert self._process.stdout is not None
        ready, _, _ = select.select([self._process.stdout], [], [], _START_S)
        if not (ready and self._process.stdout.read(1) == _READY):
            self._lost()

    def lit(self, on: bool) -> None:
        """Told before the light goes on and after it is off."""
        self._say(_LIT if on else _DARK)

    def end(self) -> None:
        """The lamp is dark and closed: the process may go."""
        self._say(_END)
        self._alive = False
        for pipe in (self._process.stdin, self._process.stdout):
            with contextlib.suppress(OSError):
                if pipe is not None:
                    pipe.close()
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _say(self, word: bytes) -> None:
        if not self._alive:
            return
        try:
            assert self._process.stdin is not None
            os.write(self._process.stdin.fileno(), word)
        except OSError:
            self._lost()

    def _lost(self) -> None:
        self._alive = False
        _log.warning("Nothing would put the lamp out if this program were killed: its guard does not run")


def start_guard(address: HidAddress, dark: tuple[str, bytes], bench: Bench) -> Guard | None:
    """A guard over a lamp; None in simulated time and on systems where there is none.

    Args:
        address: Of the lamp.
        dark: How it is put out: "out" or "set" for an output or a feature report, and the report.
        bench: Its clock says whether time is real.
    """
    if os.name != "posix" or not isinstance(bench.clock, MonotonicClock):
        return None
    lamp = [address.path, f"{address.vendor_id:04x}", f"{address.product_id:04x}", dark[0], dark[1].hex()]
    try:
        return Guard([sys.executable, "-m", "capture.devices.hid.guard", *lamp])
    except OSError as error:
        _log.warning("Nothing would put the lamp out if this program were killed (%s)", error)
        return None


def watch(pipe: int, put_out: Callable[[], None], limit_s: float = LIMIT_S) -> None:
    """Waits at the pipe's other end until the host is done or dead.

    Args:
        pipe: A file descriptor to read from.
        put_out: Called when the host hangs with the light on, and when it dies.
        limit_s: How long a light may be on.
    """
    lit_s: float | None = None
    while True:
        left_s = None if lit_s is None else max(0.0, lit_s + limit_s - time.monotonic())
        ready, _, _ = select.select([pipe], [], [], left_s)
        if not ready:
            put_out()
            lit_s = None
            continue
        words = os.read(pipe, 64)
        if not words:
            put_out()
            return
        if _END in words:
            return
        lit_s = time.monotonic() if words.endswith(_LIT) else None


def put_out_device(path: str, vendor_id: int, product_id: int, kind: str, report: bytes) -> None:
    """Opens a lamp and sends the report that turns it off, again and again until it is taken."""
    for _ in range(_TRIES):
        with contextlib.suppress(FlashError):
            for address in find_devices(vendor_id, (product_id,)):
                if address.path == path:
                    transport = open_device(address)
                    try:
                        (transport.write if kind == "out" else transport.send_feature)(report)
                    finally:
                        transport.close()
                    return
        time.sleep(_PAUSE_S)


def main(arguments: list[str]) -> None:
    """The process."""
    path, vendor, product, kind, report = arguments
    sys.stdout.buffer.write(_READY)
    sys.stdout.flush()
    watch(0, lambda: put_out_device(path, int(vendor, 16), int(product, 16), kind, bytes.fromhex(report)))


if __name__ == "__main__":
    main(sys.argv[1:])
