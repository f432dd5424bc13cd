"""A line to a flash: bytes both ways, in order or lost, with a timeout on every wait.

Frames survive damage (firmware_protocol), so a transport need not: it may drop, and it may add zero bytes,
which are delimiters (HID pads its reports so). What it must not do is wait longer than it was told.
"""

from __future__ import annotations

from typing import Protocol


class ByteTransport(Protocol):
    """A line that has been opened. One thread reads and writes at a time; `close` may come from any."""

    @property
    def description(self) -> str:
        """What a person calls it: "/dev/ttyUSB0 (CH340)". Error messages begin with it."""

    @property
    def seconds_per_byte(self) -> float:
        """How long a byte takes where it is sent bit by bit (10 bits at the baud rate); 0 = no such pace."""

    def write(self, data: bytes) -> None:
        """Sends all of it, within half a second.

        Raises:
            FlashGoneError: The line is not there any more, or takes nothing.
        """

    def read(self, timeout_s: float) -> bytes:
        """What has come, at once when there is something; empty after `timeout_s` without a byte.

        Raises:
            FlashGoneError: The line is not there any more.
        """

    def close(self) -> None:
        """Lets go of it; harmless when repeated. Never raises."""
