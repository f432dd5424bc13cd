"""Logitech Litra Glow, Beam and Beam LX: `litra:`, `litra:serial=2246FE900DBB;kelvin=5000;lumen=200`.

Feature 0x1990 (illumination light), functions 0 get, 1 set, 3 and 4 brightness in lumen, 8 and 9 temperature
in kelvin; events 0 on or off, 1 brightness, 2 temperature. Bytes, product numbers and ranges:
timrogers/litra-rs `src/lib.rs` (MIT); functions and events: A. Bergmeier, "hid: Support for Litra Glow",
linux-input, 2022-12-15.

Not known, because none has been on our desk: how long from the command to the light, whether the lamp ramps,
its PWM, and whether it takes a brightness while it is off.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any

from capture.devices.bench import Bench, Clock
from capture.devices.flash import FlashCapabilities, FlashInfo
from capture.devices.hid.guard import start_guard
from capture.devices.hid.hidpp import HidppLink
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

_log = logging.getLogger(__name__)

VENDOR_ID = 0x046D
_USAGE_PAGE = 0xFF43
_FEATURE = 0x1990
# Functions, with the number that litra-rs asks under in the low half.
_IS_ON, _SET_ON = 0x01, 0x1C
_GET_LUMEN, _SET_LUMEN = 0x31, 0x4C
_GET_KELVIN, _SET_KELVIN = 0x81, 0x9C
_EVENT_ON, _EVENT_LUMEN, _EVENT_KELVIN = 0, 1, 2
_KELVIN = range(2700, 6501, 100)
#: A command that was not answered for so long was lost.
_SILENCE_S = 1.0
_OPTIONS = {"serial": str, "path": str, "kelvin": int, "lumen": int}


@dataclass(frozen=True)
class Model:
    """A kind of Litra.

    Attributes:
        name: For a person.
        lumen: From its lowest to its highest.
        feature_index: Of feature 0x1990 where the lamp does not tell.
    """

    name: str
    lumen: range
    feature_index: int


_BEAM = Model("Logitech Litra Beam", range(30, 401), 0x04)
MODELS = {
    0xC900: Model("Logitech Litra Glow", range(20, 251), 0x04),
    0xC901: _BEAM,
    0xB901: _BEAM,
    0xC903: Model("Logitech Litra Beam LX", range(30, 401), 0x06),
}


def open_flash(rest: str, bench: Bench) -> HostFlash:
    """The lamp of `litra:REST`.

    serial=...   which one, where there are several; path=... likewise
    kelvin=5000  its temperature, in steps of 100
    lumen=200    how bright a flash of level 1 is; else as bright as it gets

    Raises:
        FlashError: A setting is not understood or beyond the lamp's range, no such lamp, or no permission.
    """
    options = parse_options(rest, _OPTIONS, FlashError, scheme="litra")
    address = choose_device(
        find_devices(VENDOR_ID, MODELS, _USAGE_PAGE),
        scheme="litra",
        kind="Litra",
        serial=options.get("serial"),
        path=options.get("path"),
    )
    transport = open_device(address)
    try:
        lamp = LitraLamp(transport, bench.clock, kelvin=options.get("kelvin"), lumen=options.get("lumen"))
        return HostFlash(lamp, bench.clock, start_guard(address, lamp.dark, bench))
    except BaseException:
        transport.close()
        raise


def list_flashes() -> list[str]:
    """URLs of the lamps that are plugged in."""
    return [device_url("litra", device) for device in find_devices(VENDOR_ID, MODELS, _USAGE_PAGE)]


class LitraLamp:
    """A Litra, as a `HostLamp`: dark from the moment it is opened, its settings put back at the end."""

    def __init__(
        self,
        transport: HidTransport,
        clock: Clock,
        *,
        kelvin: int | None = None,
        lumen: int | None = None,
    ) -> None:
        """Turns it off and sets its temperature.

        Args:
            transport: An opened Litra.
            clock: Of the bench.
            kelvin: Temperature; None = as it is.
            lumen: Of a flash of level 1; None = as bright as the model gets.

        Raises:
            FlashError: A setting is beyond the model's range, or the lamp refuses it.
        """
        self._transport = transport
        self._clock = clock
        self._link = HidppLink(transport, clock)
        self._model = MODELS[transport.address.product_id]
        self._full = self._model.lumen[-1] if lumen is None else lumen
        if self._full not in self._model.lumen:
            raise FlashError(
                f"lumen is {self._full}; the {self._model.name} does {self._model.lumen[0]} to "
                f"{self._model.lumen[-1]}."
            )
        if kelvin is not None and kelvin not in _KELVIN:
            raise FlashError(f"kelvin is {kelvin}; a Litra does 2700 to 6500 in steps of 100.")
        self._index = self._find_feature()
        self._on = False
        self._pressed: list[str] = []
        was_on = self._link.ask(self._index, _IS_ON)
        self._answers = was_on is not None
        self._told = self._settings()
        self._found = dict(self._told)
        self._transport.write(self._command(_SET_ON, b"\0"))
        if kelvin is not None:
            self._set("kelvin", _SET_KELVIN, _GET_KELVIN, kelvin)
        self._details = {
            "serial": transport.address.serial,
            "path": transport.address.path,
            "answers": self._answers,
            "was_on": bool(was_on and was_on[0] & 1),
            "found": dict(self._found),
            "kelvin": self._told.get("kelvin"),
            "lumen_full": self._full,
        }

    @property
    def info(self) -> FlashInfo:
        """Who it is."""
        return FlashInfo(
            url=device_url("litra", self._transport.address),
            name=self._model.name,
            back_end="litra",
            details=self._details,
        )

    @property
    def capabilities(self) -> FlashCapabilities:
        """What it can do; the shortest flash is a guess on the safe side."""
        return FlashCapabilities(own_schedule=False, watchdog=False, shortest_on_s=0.05, dimmable=True)

    @property
    def dark(self) -> tuple[str, bytes]:
        """The report that turns it off, for its guard."""
        return "out", self._command(_SET_ON, b"\0")

    def prepare(self, level: float) -> None:
        """Sets the brightness; refuses a level below the model's lowest."""
        lumen = round(self._full * level)
        if lumen not in self._model.lumen:
            raise FlashError(
                f"Level {level} is {lumen} lumen; the {self._model.name} does {self._model.lumen[0]} or more."
            )
        self._set("lumen", _SET_LUMEN, _GET_LUMEN, lumen)

    def arm(self, on_s: float) -> None:
        """Does nothing: a Litra has no watchdog."""

    def switch(self, on: bool) -> None:
        """Gives the command."""
        self._on = on
        if self._answers:
            self._link.tell(self._index, _SET_ON, bytes((on,)))
        else:
            self._transport.write(self._command(_SET_ON, bytes((on,))))

    def check(self, idle_s: float) -> None:
        """Looks for answers, and for buttons that somebody has pressed."""
        # Told before listening: an event of our own command is older than the answer to it.
        allowed = {self._on} | ({not self._on} if self._link.unanswered else set())
        self._link.listen()
        while self._link.events:
            event = self._link.events.popleft()
            if event.feature_index != self._index:
                continue
            value = int.from_bytes(event.parameters[:2], "big")
            if event.number == _EVENT_ON and bool(event.parameters[0] & 1) not in allowed:
                self._pressed.append("on" if event.parameters[0] & 1 else "off")
            elif event.number == _EVENT_LUMEN and value != self._told.get("lumen"):
                self._pressed.append(f"{value} lumen")
            elif event.number == _EVENT_KELVIN and value != self._told.get("kelvin"):
                self._pressed.append(f"{value} K")
        if self._pressed:
            pressed, self._pressed = ", ".join(self._pressed), []
            raise FlashError(
                f"Somebody has pressed a button of the {self._model.name} (now {pressed}), so the flashes "
                "are not alike any more; leave its buttons alone and start again."
            )
        if self._link.unanswered and self._clock.now_s() - self._link.unanswered[0][2] > _SILENCE_S:
            self._link.unanswered.clear()
            raise FlashError(
                f"{self._link.name} has not answered a command for {_SILENCE_S} s; unplug it and plug it in "
                "again."
            )

    def confirm_dark(self) -> bool:
        """Asks it."""
        answer = self._link.ask(self._index, _IS_ON) if self._answers else None
        return answer is not None and not answer[0] & 1

    def report(self) -> dict[str, Any]:
        """What it was told and found at."""
        return {
            "told": dict(self._told),
            "found": dict(self._found),
            "unanswered": len(self._link.unanswered),
        }

    def close(self) -> None:
        """Puts brightness and temperature back, stays dark."""
        try:
            for name, function in (("lumen", _SET_LUMEN), ("kelvin", _SET_KELVIN)):
                if self._told.get(name) != self._found.get(name) and name in self._found:
                    self._transport.write(self._command(function, self._found[name].to_bytes(2, "big")))
        finally:
            self._transport.close()

    def _find_feature(self) -> int:
        index = self._link.feature_index(_FEATURE)
        if index is None:
            _log.info("%s does not tell where its light is; the usual place is taken", self._link.name)
            return self._model.feature_index
        if index == 0:
            raise FlashError(
                f"{self._link.name} has no light that can be switched (HID++ feature 0x1990 is missing); "
                "update its firmware."
            )
        return index

    def _settings(self) -> dict[str, int]:
        """Brightness and temperature, where the lamp tells them."""
        settings = {}
        for name, function in (("lumen", _GET_LUMEN), ("kelvin", _GET_KELVIN)):
            answer = self._link.ask(self._index, function) if self._answers else None
            if answer is not None:
                settings[name] = int.from_bytes(answer[:2], "big")
        return settings

    def _set(self, name: str, set_function: int, get_function: int, value: int) -> None:
        parameters = value.to_bytes(2, "big")
        if not self._answers:
            self._transport.write(self._command(set_function, parameters))
            self._told[name] = value
            return
        self._link.ask(self._index, set_function, parameters)
        answer = self._link.ask(self._index, get_function)
        if answer is None:
            raise FlashError(f"{self._link.name} does not answer; unplug it and plug it in again.")
        self._told[name] = int.from_bytes(answer[:2], "big")
        if self._told[name] != value:
            _log.warning("%s was asked for %s %d and says %d", self._link.name, name, value, self._told[name])

    def _command(self, function: int, parameters: bytes) -> bytes:
        return bytes((0x11, 0xFF, self._index, function)) + parameters.ljust(16, b"\0")
