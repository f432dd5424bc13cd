"""USB relay boards "USBRelayN": `hidrelay:`, `hidrelay:serial=BITFT;channel=2`, `hidrelay:path=/dev/hidraw3`.

Feature reports: 00 ff N closes channel N (from 1), 00 fd N opens it, 00 fe and 00 fc all of them, filled with
zeros to 9 bytes. Report 1 read back has 8 bytes: the board's own number in 0..4 as text, and in byte 7 a bit
for each closed channel (darrylb123/usbrelay, pavel-a/usb-relay-hid). 16c0:05df is shared by many makers
(V-USB), so the product string has to be "USBRelay" and a digit; a device that has another name is left alone.
The number in the report is not the serial number of USB: it is known only once a board is opened.

A relay is slow (5 to 10 ms), bounces, and wears: one flash a second is 3600 operations an hour of some 1e5 to
1e6 in its life. A solid-state relay on the same board, or a transistor, does better.
"""

from __future__ import annotations

import contextlib
import logging
import re
import sys
from typing import Any

from capture.devices.bench import Bench, Clock
from capture.devices.flash import FlashCapabilities, FlashInfo
from capture.devices.hid.guard import start_guard
from capture.devices.hid.transport import (
    HidAddress,
    HidTransport,
    choose_device,
    find_devices,
    open_device,
)
from capture.devices.host_flash import HostFlash
from capture.devices.url_options import parse_options
from capture.errors import FlashError

_log = logging.getLogger(__name__)

VENDOR_ID, PRODUCT_ID = 0x16C0, 0x05DF
_PRODUCT = re.compile(r"USBRelay([1-8])")
_CLOSE, _OPEN = 0xFF, 0xFD
_REPORT_BYTES, _STATE_BYTES = 9, 8
#: The board has no report ids. On Linux usbrelay asks for 1, elsewhere usb-relay-hid asks for 0.
_STATE_REPORT = 1 if sys.platform == "linux" else 0
#: Reading the state takes a slow device some milliseconds: not when a switch is due.
_READ_S = 0.1
#: No more than so often.
_CHECK_S = 1.0
_WEAR = (
    "a mechanical relay wears out after some 100,000 to 1,000,000 operations, and one flash a second is "
    "3,600 an hour; prefer a solid-state one"
)
_OPTIONS = {"serial": str, "path": str, "channel": int}


def open_flash(rest: str, bench: Bench) -> HostFlash:
    """The lamp behind `hidrelay:REST`.

    serial=BITFT  the board's own five letters; path=... where the system has it
    channel=1     of the board, from 1

    Raises:
        FlashError: A setting is not understood, no such board or channel, or no permission.
    """
    options = parse_options(rest, _OPTIONS, FlashError, scheme="hidrelay")
    transport = _open_board(options.get("serial"), options.get("path"))
    try:
        lamp = RelayLamp(transport, bench.clock, channel=options.get("channel", 1))
        return HostFlash(lamp, bench.clock, start_guard(transport.address, lamp.dark, bench))
    except BaseException:
        transport.close()
        raise


def list_flashes() -> list[str]:
    """URLs of all channels of the boards that are plugged in."""
    return [
        f"hidrelay:path={board.path};channel={channel}"
        for board in _find_boards()
        for channel in range(1, _channels(board) + 1)
    ]


class RelayLamp:
    """A lamp behind one channel of a board, as a `HostLamp`; the other channels are left alone."""

    def __init__(self, transport: HidTransport, clock: Clock, channel: int = 1) -> None:
        """Opens the relay, should it be closed.

        Args:
            transport: An opened board.
            clock: Of the bench.
            channel: From 1.

        Raises:
            FlashError: No relay board, no such channel, or it says something else than a relay board.
        """
        self._transport = transport
        self._clock = clock
        self._channel = channel
        self._channels = _channels(transport.address)
        if not 1 <= channel <= self._channels:
            raise FlashError(
                f"channel is {channel}; {transport.address.description} has 1 to {self._channels}."
            )
        self._on = False
        self._operations = 0
        self._checked_s = clock.now_s()
        self._serial, closed = read_state(transport)
        was_on = bool(closed & self._bit)
        self.switch(False)
        self._details = {
            "serial": self._serial,
            "path": transport.address.path,
            "channels": self._channels,
            "channel": channel,
            "was_on": was_on,
            "wear": _WEAR,
        }
        _log.warning("%s: %s", self.info.name, _WEAR)

    @property
    def info(self) -> FlashInfo:
        """Who it is."""
        return FlashInfo(
            url=f"hidrelay:serial={self._serial};channel={self._channel}",
            name=f"{self._transport.address.product} {self._serial}, channel {self._channel}",
            back_end="hidrelay",
            details=self._details,
        )

    @property
    def capabilities(self) -> FlashCapabilities:
        """What it can do; latency and jitter as relays of this size have them, not measured."""
        return FlashCapabilities(
            own_schedule=False, watchdog=False, shortest_on_s=0.05, latency_s=0.0075, jitter_s=0.002
        )

    @property
    def dark(self) -> tuple[str, bytes]:
        """The report that turns it off, for its guard."""
        return "set", self._command(_OPEN)

    def prepare(self, level: float) -> None:
        """Does nothing: a relay has one level."""

    def arm(self, on_s: float) -> None:
        """Does nothing: a relay board has no watchdog."""

    def switch(self, on: bool) -> None:
        """Gives the command."""
        self._operations += on != self._on
        self._on = on
        self._transport.send_feature(self._command(_CLOSE if on else _OPEN))

    def check(self, idle_s: float) -> None:
        """Reads the relay's state now and then."""
        if idle_s < _READ_S or self._clock.now_s() - self._checked_s < _CHECK_S:
            return
        self._checked_s = self._clock.now_s()
        if bool(read_state(self._transport)[1] & self._bit) != self._on:
            raise FlashError(
                f"{self.info.name} was told to be {'on' if self._on else 'off'} and is not; another program "
                "switches it too, or the board is broken."
            )

    def confirm_dark(self) -> bool:
        """Asks it."""
        return not read_state(self._transport)[1] & self._bit

    def report(self) -> dict[str, Any]:
        """How often it has moved."""
        return {"operations": self._operations}

    def close(self) -> None:
        """Lets go of it."""
        self._transport.close()

    def _command(self, code: int) -> bytes:
        return bytes((0, code, self._channel)).ljust(_REPORT_BYTES, b"\0")

    @property
    def _bit(self) -> int:
        return 1 << (self._channel - 1)


def read_state(transport: HidTransport) -> tuple[str, int]:
    """A board's own number, and a bit for each closed channel.

    Raises:
        FlashError: That is no answer of such a board.
    """
    report = transport.get_feature(_STATE_REPORT, _REPORT_BYTES)
    if len(report) == _STATE_BYTES + 1:  # with the report's id, as some systems give it
        report = report[1:]
    serial = report[:5]
    if len(report) != _STATE_BYTES or not (serial.isascii() and serial.decode("ascii").isprintable()):
        raise FlashError(
            f"{transport.address.description} says {report.hex(' ') or 'nothing'} of its state, which is not "
            "what a USB relay board says; unplug it and plug it in again."
        )
    return serial.decode("ascii"), report[7]


def _find_boards() -> list[HidAddress]:
    return [board for board in find_devices(VENDOR_ID, (PRODUCT_ID,)) if _PRODUCT.fullmatch(board.product)]


def _channels(address: HidAddress) -> int:
    named = _PRODUCT.fullmatch(address.product)
    if named is None:
        raise FlashError(f"{address.description} is no USBRelay board, though it has the same USB number.")
    return int(named[1])


def _open_board(serial: str | None, path: str | None) -> HidTransport:
    boards = _find_boards()
    if serial is None or not boards:
        return open_device(choose_device(boards, scheme="hidrelay", kind="USBRelay", serial=None, path=path))
    found = []
    for board in boards:
        if path is not None and board.path != path:
            continue
        transport = open_device(board)
        with contextlib.suppress(FlashError):
            name, _ = read_state(transport)
            if name == serial:
                return transport
            found.append(f"{name} at {board.path}")
        transport.close()
    raise FlashError(
        f"No USBRelay has serial={serial}; plugged in: {'; '.join(found) or 'none that answers'}."
    )
