"""blink(1): `blink1:`, `blink1:serial=3A1B2C3D`. Too dim for a flash; a test lamp and a sync marker.

Feature reports of 9 bytes, id 1, then a letter: n sets a colour, r reads it, v the version, P and R write and
read a line of its colour pattern, l the LED that P is for, D the watchdog "serverdown". A report that is read
has 8 bytes (todbot/blink1 `docs/blink1-hid-commands.md`, todbot/blink1-python).

The watchdog does not turn the light off: when nothing tickles it in time, the device *plays its pattern*, as
it leaves the factory coloured flashes without end. So the pattern is made black while we use it: on mk2 and
mk3 it is in RAM until it is saved, and we save nothing, write all lines back at the end, and unplugging
restores it too. All lines, because a mk3's firmware plays all of them whatever part it was told; with a time
of 10 ms, because it skips black lines without one. Byte 5 of D is 1: with 0 each D turns the light off at
once (firmware in todbot/blink1 and todbot/blink1mk3). The mk1 keeps its pattern in EEPROM: we leave it alone,
and it has no watchdog here.
"""

from __future__ import annotations

import math
from typing import Any

from capture.devices.bench import Bench, Clock
from capture.devices.flash import LONGEST_ON_S, FlashCapabilities, FlashInfo
from capture.devices.hid.guard import start_guard
from capture.devices.hid.transport import (
    HidTransport,
    choose_device,
    device_url,
    find_devices,
    open_device,
)
from capture.devices.host_flash import HostFlash
from capture.devices.url_options import parse_options
from capture.errors import FlashError

VENDOR_ID, PRODUCT_ID = 0x27B8, 0x01ED
_REPORT_ID, _SENT_BYTES = 1, 9
_LINES = 32
_TICK_S = 0.01
#: The watchdog bites so long after the host should have turned the light off.
_GRACE_S = 0.05
#: The firmware moves its LEDs every 10 ms.
_UPDATE_S = 0.01
_OPTIONS = {"serial": str, "path": str}


def open_flash(rest: str, bench: Bench) -> HostFlash:
    """The lamp of `blink1:REST`; serial=... or path=... says which one, where there are several.

    Raises:
        FlashError: A setting is not understood, no such lamp, or no permission.
    """
    options = parse_options(rest, _OPTIONS, FlashError, scheme="blink1")
    address = choose_device(
        find_devices(VENDOR_ID, (PRODUCT_ID,)),
        scheme="blink1",
        kind="blink(1)",
        serial=options.get("serial"),
        path=options.get("path"),
    )
    transport = open_device(address)
    try:
        lamp = Blink1Lamp(transport, bench.clock)
        return HostFlash(lamp, bench.clock, start_guard(address, lamp.dark, bench))
    except BaseException:
        transport.close()
        raise


def list_flashes() -> list[str]:
    """URLs of the lamps that are plugged in."""
    return [device_url("blink1", device) for device in find_devices(VENDOR_ID, (PRODUCT_ID,))]


class Blink1Lamp:
    """A blink(1), as a `HostLamp`."""

    def __init__(self, transport: HidTransport, clock: Clock) -> None:
        """Turns it off, and makes its pattern black so that its watchdog does too.

        Args:
            transport: An opened blink(1).
            clock: Of the bench.

        Raises:
            FlashError: It says something else than a blink(1).
        """
        self._transport = transport
        self._clock = clock
        self._value = 255
        self._colour(0)
        answer = self._ask("v")
        major, minor = answer[3] - ord("0"), answer[4] - ord("0")
        if not (1 <= major <= 9 and 0 <= minor <= 99):
            raise FlashError(
                f"{transport.address.description} says {answer.hex(' ')} when asked for its version, which a "
                "blink(1) does not; unplug it and plug it in again."
            )
        self._version = 100 * major + minor
        self._pattern: list[bytes] = []
        if self._watchdog:
            self._pattern = [self._ask("R", position=line)[2:8] for line in range(_LINES)]
            self._send("l", b"\0")
            for line in range(_LINES):
                self._send("P", bytes((0, 0, 0, 0, 1)), position=line)

    @property
    def info(self) -> FlashInfo:
        """Who it is."""
        address = self._transport.address
        return FlashInfo(
            url=device_url("blink1", address),
            name="blink(1)",
            back_end="blink1",
            details={"serial": address.serial, "path": address.path, "firmware": self._version},
        )

    @property
    def capabilities(self) -> FlashCapabilities:
        """What it can do: its LEDs move every 10 ms, so a command waits 5 ms, uniformly within 10."""
        return FlashCapabilities(
            own_schedule=False,
            watchdog=self._watchdog,
            shortest_on_s=0.02,
            latency_s=_UPDATE_S / 2,
            jitter_s=_UPDATE_S / math.sqrt(12),
            dimmable=True,
        )

    @property
    def dark(self) -> tuple[str, bytes]:
        """The report that turns it off, for its guard."""
        return "set", _report("n")

    def prepare(self, level: float) -> None:
        """Sets how bright the flashes to come are; the device's own gamma makes that nonlinear."""
        self._value = max(1, round(255 * level))

    def arm(self, on_s: float) -> None:
        """Sets the watchdog to go dark when the host does not turn the light off."""
        if self._watchdog:
            ticks = math.ceil(min(on_s + _GRACE_S, LONGEST_ON_S) / _TICK_S - 1e-6)
            self._send("D", bytes((1, ticks >> 8, ticks & 0xFF, 1)))

    def switch(self, on: bool) -> None:
        """Gives the command."""
        self._colour(self._value if on else 0)

    def check(self, idle_s: float) -> None:
        """Does nothing: nobody can change a blink(1) but another program."""

    def confirm_dark(self) -> bool:
        """Asks it, after its next update; a mk1 cannot tell."""
        if not self._watchdog:
            return False
        self._clock.sleep(2 * _UPDATE_S)
        return not any(self._ask("r")[2:5])

    def report(self) -> dict[str, Any]:
        """Nothing that the device would count."""
        return {}

    def close(self) -> None:
        """Ends the watchdog, writes the pattern back, stays dark."""
        try:
            if self._watchdog:
                self._send("D", bytes((0, 0, 0, 1)))
                # From the last to the first: a device with fewer lines takes those beyond for its first.
                for line, content in reversed(list(enumerate(self._pattern))):
                    self._send("l", content[5:6])
                    self._send("P", content[:5], position=line)
                self._send("l", b"\0")
        finally:
            self._transport.close()

    @property
    def _watchdog(self) -> bool:
        return self._version >= 200

    def _colour(self, value: int) -> None:
        self._send("n", bytes((value, value, value)))

    def _send(self, command: str, parameters: bytes = b"", position: int = 0) -> None:
        self._transport.send_feature(_report(command, parameters, position))

    def _ask(self, command: str, position: int = 0) -> bytes:
        self._send(command, position=position)
        answer = self._transport.get_feature(_REPORT_ID, _SENT_BYTES)
        if len(answer) < 8 or answer[:2] != bytes((_REPORT_ID, ord(command))):
            raise FlashError(
                f"{self._transport.address.description} answers {answer.hex(' ') or 'nothing'} to the "
                f"command {command!r}, which a blink(1) does not; close other programs that use it."
            )
        return answer


def _report(command: str, parameters: bytes = b"", position: int = 0) -> bytes:
    content = bytes((_REPORT_ID, ord(command))) + parameters.ljust(5, b"\0") + bytes((position,))
    return content.ljust(_SENT_BYTES, b"\0")
