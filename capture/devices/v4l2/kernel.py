"""What the layer above asks of the operating system: a few calls, so that a double can stand behind it.

Errors are `OSError`s with their number, as the kernel gives them; `capture.devices.v4l2.node` translates
them.
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
import mmap
import os
import select
from collections.abc import Callable
from pathlib import Path
from typing import Protocol


class Mapping(Protocol):
    """Memory shared with a driver."""

    def __getitem__(self, part: slice) -> bytes:
        """A copy of some of it."""

    def close(self) -> None:
        """Unmaps it."""


class Kernel(Protocol):
    """The calls; every one may raise `OSError`."""

    def open(self, path: str) -> int:
        """Opens a device node for reading and writing, non-blocking."""

    def close(self, descriptor: int) -> None:
        """Closes it."""

    def ioctl(self, descriptor: int, request: int, argument: ctypes._CData) -> None:
        """A request that reads and writes `argument` in place."""

    def mmap(self, descriptor: int, length: int, offset: int) -> Mapping:
        """Maps a buffer of the driver."""

    def wait(self, descriptor: int, timeout_s: float) -> bool:
        """Waits until a buffer may be taken or something is wrong; False = the time is over."""

    def describe(self, path: str) -> dict[str, str]:
        """What the system knows of the device behind a node: "usb_id", "serial", "by_id"; may be empty."""


class LinuxKernel:
    """The real one."""

    def open(self, path: str) -> int:
        """Open(2)."""
        return os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)

    def close(self, descriptor: int) -> None:
        """Close(2)."""
        os.close(descriptor)

    def ioctl(self, descriptor: int, request: int, argument: ctypes._CData) -> None:
        """Ioctl(2)."""
        fcntl.ioctl(descriptor, request, argument, True)

    def mmap(self, descriptor: int, length: int, offset: int) -> Mapping:
        """Mmap(2), shared."""
        return mmap.mmap(descriptor, length, mmap.MAP_SHARED, mmap.PROT_READ | mmap.PROT_WRITE, offset=offset)

    def wait(self, descriptor: int, timeout_s: float) -> bool:
        """Poll(2); interrupted waits go on (PEP 475)."""
        poll = select.poll()
        poll.register(descriptor, select.POLLIN)
        return bool(poll.poll(max(0.0, timeout_s) * 1000.0))

    def describe(self, path: str) -> dict[str, str]:
        """From /dev/v4l/by-id and sysfs."""
        about: dict[str, str] = {}
        node = os.path.realpath(path)
        names = sorted(Path("/dev/v4l/by-id").glob("*"))
        if links := [str(name) for name in names if os.path.realpath(name) == node]:
            about["by_id"] = links[0]
        device = Path("/sys/class/video4linux") / Path(node).name / "device"
        for folder in (device, device / ".."):
            vendor, product = _line(folder / "idVendor"), _line(folder / "idProduct")
            if vendor and product:
                about["usb_id"] = f"{vendor}:{product}"
                about |= {
                    name: text for name in ("serial", "bcdDevice", "speed") if (text := _line(folder / name))
                }
                break
        return about


def retry(call: Callable[[], None]) -> None:
    """Does a call again as long as signals interrupt it: EINTR is no answer."""
    while True:
        try:
            return call()
        except OSError as error:
            if error.errno != errno.EINTR:
                raise


def _line(path: Path) -> str:
    try:
        return path.read_text(errors="replace").strip()
    except OSError:
        return ""
