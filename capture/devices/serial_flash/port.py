"""A serial port as a `ByteTransport`: opened gently, read without waiting longer than told, gone when gone.

DTR and RTS are low before it is opened, which spares some boards the reset that opening makes; others reset
all the same (on Linux the kernel raises both for a moment), and the handshake waits for them. The port is
taken exclusively where that exists: a second reader would steal bytes. Adapters gather what they have read
for up to 16 ms (FTDI) unless they are told to hand it over at once.
"""

from __future__ import annotations

import errno
import logging
import os
import select
from pathlib import Path
from typing import Any

import serial

from capture.devices.bench import Clock
from capture.devices.serial_flash.boards import usb_details
from capture.errors import FlashError, FlashGoneError

log = logging.getLogger(__name__)

BAUD = 115_200
_BITS_PER_BYTE = 10  # start, eight, stop
_WRITE_S = 0.5
_READ_BYTES = 4096
_POLL_S = 0.001
#: An adapter that holds bytes back for longer spoils the clock's fit.
_LATENCY_MS = 2


class SerialLine:
    """A port that is open."""

    def __init__(self, url: str, clock: Clock) -> None:
        """Opens it.

        Args:
            url: A path, `COM3`, or a URL of pyserial's.
            clock: For waits on ports that the system cannot wait for.

        Raises:
            FlashError: No such port, no permission, in use.
        """
        self._clock = clock
        self._port = _open(url)
        path = str(self._port.port)
        self.details: dict[str, Any] = {"port": path} | usb_details(path)
        self._description = f"{url} ({path})" if path != url else url
        self._is_tty = "://" not in url or url.lower().startswith(("hwgrep://", "alt://"))
        self._selects = os.name == "posix" and _has_file(self._port)
        if self._is_tty:
            self.details |= _hurry(self._port, Path(path).name, self._description)

    @property
    def description(self) -> str:
        """The URL, and the port that it turned out to be."""
        return self._description

    @property
    def seconds_per_byte(self) -> float:
        """Of a UART at 115,200 baud; a pseudo-terminal is one too until it is quicker."""
        return _BITS_PER_BYTE / BAUD if self._is_tty else 0.0

    def write(self, data: bytes) -> None:
        """Sends all of it.

        Raises:
            FlashGoneError: Unplugged, or nothing is taken for half a second.
        """
        try:
            self._port.write(data)
        except serial.SerialTimeoutException as error:
            raise FlashGoneError(
                f"{self._description} has taken nothing for {_WRITE_S} s; check its cable, then start again."
            ) from error
        except (OSError, ValueError, TypeError) as error:
            raise self._gone(error) from error

    def read(self, timeout_s: float) -> bytes:
        """What has come, waiting for the first byte only.

        Raises:
            FlashGoneError: Unplugged.
        """
        try:
            if self._selects:
                if not select.select([self._port.fileno()], [], [], max(0.0, timeout_s))[0]:
                    return b""
                return bytes(self._port.read(_READ_BYTES))
            end_s = self._clock.now_s() + timeout_s
            while not (waiting := self._port.in_waiting):
                if self._clock.now_s() >= end_s:
                    return b""
                self._clock.sleep(_POLL_S)
            return bytes(self._port.read(waiting))
        except (OSError, ValueError, TypeError) as error:  # the last two from a port that is closed under us
            raise self._gone(error) from error

    def close(self) -> None:
        """Lets go of it."""
        try:
            self._port.close()
        except (OSError, ValueError, TypeError) as error:
            log.debug("%s: closing: %s", self._description, error)

    def _gone(self, error: Exception) -> FlashGoneError:
        return FlashGoneError(
            f"{self._description} is not there any more ({error}); its light goes out by itself. Plug it in "
            "and start again."
        )


def _open(url: str) -> Any:
    try:
        port = serial.serial_for_url(
            url,
            baudrate=BAUD,
            timeout=0,
            write_timeout=_WRITE_S,
            exclusive=True if os.name == "posix" else None,
            do_not_open=True,
        )
        port.dtr = False
        port.rts = False
        port.open()
    except (OSError, ValueError) as error:
        raise FlashError(_why_not(url, error)) from error
    return port


def _has_file(port: Any) -> bool:
    """Whether the system can wait for it: not for rfc2217:// and loop://."""
    try:
        return bool(port.fileno() >= 0)
    except (OSError, ValueError):  # io.UnsupportedOperation is both
        return False


def _why_not(url: str, error: OSError | ValueError) -> str:
    code = getattr(error, "errno", None)
    text = str(error)
    if "exclusively lock" in text or code == errno.EBUSY:
        return f"{url} is in use by another program; close it (a serial monitor, another capture)."
    if code in (errno.EACCES, errno.EPERM) or "PermissionError" in text:
        return (
            f"{url} may not be opened; add yourself to the group dialout (uucp on some systems) and log in "
            "again, or install the udev rule that `relight doctor` prints."
        )
    if code in (errno.ENOENT, errno.ENODEV, errno.ENXIO) or "no ports found" in text:
        return f"{url} does not exist; plug the flash in, or see `relight doctor` for the ports there are."
    return f"{url} cannot be opened as a serial port: {text}."


def _hurry(port: Any, name: str, description: str) -> dict[str, Any]:
    """Asks the driver to hand bytes over at once; what is known of its latency, for `FlashInfo`."""
    if hasattr(port, "set_low_latency_mode"):
        try:
            port.set_low_latency_mode(True)
        except (OSError, ValueError, NotImplementedError) as error:  # a pseudo-terminal, or a driver without
            log.debug("%s: no low-latency mode: %s", description, error)
    latency = Path("/sys/bus/usb-serial/devices") / name / "latency_timer"
    try:
        latency_ms = int(latency.read_text())
    except (OSError, ValueError):
        return {}
    if latency_ms > _LATENCY_MS:
        log.warning(
            "%s holds bytes back for %d ms; write 1 into %s, or install the udev rule that `relight doctor` "
            "prints",
            description,
            latency_ms,
            latency,
        )
    return {"latency_timer_ms": latency_ms}
