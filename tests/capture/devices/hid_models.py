"""Lamps on USB HID as their documents say they behave: reports in, reports out, and whether they shine.

No kernel, no library, no thread: time is what the caller says it is (seconds, any start). They serve as
doubles in one process (`ModelTransport`) and behind the kernel's uhid. What they do not model: brightness in
light, latency, the relay's bounce, other programs, and any answer that the documents do not tell.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import Protocol

from capture.devices.bench import Clock, VirtualClock
from capture.devices.hid.transport import HidAddress
from capture.devices.host_flash import HostFlash
from capture.errors import FlashGoneError

LITRA_DESCRIPTOR = bytes.fromhex("0643ff0a0202a101851175089513150026ff000902810009029100c0")
RELAY_DESCRIPTOR = bytes.fromhex("0600ff0901a101150026ff00750895080900b20201c0")
BLINK1_DESCRIPTOR = bytes.fromhex("0600ff0901a101150026ff007508850195080900b20201c0")


class HidModel(Protocol):
    """What every model is."""

    #: (when, lit) of each change, oldest first.
    changes: list[tuple[float, bool]]

    def write(self, report: bytes, now_s: float) -> list[bytes]:
        """Takes an output report, id first; the input reports that it causes."""

    def set_feature(self, report: bytes, now_s: float) -> None:
        """Takes a feature report, id first."""

    def get_feature(self, report_id: int, now_s: float) -> bytes:
        """A feature report as it comes back on Linux."""

    def advance(self, now_s: float) -> list[bytes]:
        """Lets time pass; the input reports that it causes."""


class LitraModel:
    """A Litra: HID++ 2.0 with a root feature and 0x1990 at an index of its own."""

    def __init__(
        self,
        *,
        feature_index: int = 0x04,
        lumen: tuple[int, int] = (20, 250),
        answers: bool = True,
        answers_root: bool = True,
    ) -> None:
        self.changes: list[tuple[float, bool]] = []
        self.on = False
        self.lumen, self.kelvin = 100, 4000
        self.feature_index = feature_index
        self.answers, self.answers_root = answers, answers_root
        self.refuse: int | None = None  # a HID++ error code for every command of the light
        self._range = lumen
        self._pressed: list[bytes] = []

    def write(self, report: bytes, now_s: float) -> list[bytes]:
        if len(report) != 20 or report[0] != 0x11 or report[1] != 0xFF:
            return []
        index, function, parameters = report[2], report[3], report[4:]
        if index == 0 and function >> 4 == 0:
            wanted = int.from_bytes(parameters[:2], "big")
            place = self.feature_index if wanted == 0x1990 else 0
            return (
                [_hidpp(index, function, bytes((place, 0, 0)))] if self.answers and self.answers_root else []
            )
        if index != self.feature_index:
            return [_hidpp(0xFF, index, bytes((function, 0x06)))] if self.answers else []
        if self.refuse is not None:
            return [_hidpp(0xFF, index, bytes((function, self.refuse)))]
        answer = self._obey(function >> 4, parameters, now_s)
        return [_hidpp(index, function, answer)] if self.answers else []

    def set_feature(self, report: bytes, now_s: float) -> None:
        raise OSError("a Litra has no feature reports")

    def get_feature(self, report_id: int, now_s: float) -> bytes:
        raise OSError("a Litra has no feature reports")

    def advance(self, now_s: float) -> list[bytes]:
        pressed, self._pressed = self._pressed, []
        return pressed

    def press_power(self, now_s: float) -> None:
        """Somebody presses the front button."""
        self._switch(not self.on, now_s)
        self._pressed.append(_hidpp(self.feature_index, 0x00, bytes((self.on,))))

    def press_brighter(self) -> None:
        """Somebody presses the button for more light."""
        self.lumen = min(self._range[1], self.lumen + 20)
        self._pressed.append(_hidpp(self.feature_index, 0x10, self.lumen.to_bytes(2, "big")))

    def _obey(self, function: int, parameters: bytes, now_s: float) -> bytes:
        value = int.from_bytes(parameters[:2], "big")
        if function == 0:
            return bytes((self.on,))
        if function == 1:
            self._switch(bool(parameters[0] & 1), now_s)
            return parameters[:1]
        if function == 3:
            return self.lumen.to_bytes(2, "big")
        if function == 4:
            self.lumen = min(max(value, self._range[0]), self._range[1])
            return parameters[:2]
        if function == 8:
            return self.kelvin.to_bytes(2, "big")
        if function == 9:
            self.kelvin = min(max(value, 2700), 6500)
            return parameters[:2]
        return b""

    def _switch(self, on: bool, now_s: float) -> None:
        if on != self.on:
            self.on = on
            self.changes.append((now_s, on))


class RelayModel:
    """A board of relays; the lamp hangs on one channel."""

    def __init__(self, *, channels: int = 2, serial: str = "BITFT", lamp: int = 1) -> None:
        self.changes: list[tuple[float, bool]] = []
        self.closed = 0
        self.serial = serial
        self._channels, self._lamp = channels, lamp

    def write(self, report: bytes, now_s: float) -> list[bytes]:
        self.set_feature(report, now_s)  # the board's USB software does not tell them apart
        return []

    def set_feature(self, report: bytes, now_s: float) -> None:
        if len(report) != 9 or report[0] != 0:
            return
        code, channel = report[1], report[2]
        everything = (1 << self._channels) - 1
        before = self.closed
        if code in (0xFF, 0xFD) and 1 <= channel <= self._channels:
            bit = 1 << (channel - 1)
            self.closed = self.closed | bit if code == 0xFF else self.closed & ~bit
        elif code in (0xFE, 0xFC):
            self.closed = everything if code == 0xFE else 0
        bit = 1 << (self._lamp - 1)
        if (before ^ self.closed) & bit:
            self.changes.append((now_s, bool(self.closed & bit)))

    def get_feature(self, report_id: int, now_s: float) -> bytes:
        state = self.serial.encode("ascii") + b"\0\0" + bytes((self.closed,))
        return state if report_id else b"\0" + state

    def advance(self, now_s: float) -> list[bytes]:
        return []


_FACTORY = [(255, 0, 0, 50), (0, 0, 0, 50), (0, 255, 0, 50), (0, 0, 0, 50), (0, 0, 255, 50), (0, 0, 0, 50)]


@dataclass
class _Line:
    rgb: tuple[int, int, int] = (0, 0, 0)
    ticks: int = 0
    led: int = 0


class Blink1Model:
    """A blink(1): colour, a pattern in RAM that it plays, and the watchdog "serverdown".

    Fades are jumps. `whole_pattern` is the mk3's habit to play all of its pattern whatever it was told.
    """

    def __init__(self, *, firmware: tuple[int, int] = (2, 6), whole_pattern: bool = False) -> None:
        self.changes: list[tuple[float, bool]] = []
        self.rgb = (0, 0, 0)
        lines = 32 if firmware[0] >= 2 else 12
        self.pattern = [_Line() for _ in range(lines)]
        for line, (r, g, b, ticks) in enumerate(_FACTORY):
            self.pattern[line] = _Line((r, g, b), ticks)
        self.playing = False
        self.saves = 0
        self._firmware, self._whole = firmware, whole_pattern
        self._reply = bytes(8)
        self._led = 0
        self._bite_s = math.inf
        self._down = (0, lines)
        self._play = (0, lines)
        self._position, self._next_s = 0, math.inf

    def write(self, report: bytes, now_s: float) -> list[bytes]:
        raise OSError("a blink(1) has no output reports")

    def set_feature(self, report: bytes, now_s: float) -> None:
        self.advance(now_s)
        if report[0] != 1:
            return
        command, a = chr(report[1]), report[2:8].ljust(6, b"\0")
        reply = bytearray(report[:8].ljust(8, b"\0"))
        if command == "n":
            self.playing = False
            self._show((a[0], a[1], a[2]), now_s)
        elif command == "r":
            reply[2:8] = bytes((*self.rgb, 0, 0, 0))
        elif command == "v":
            reply[3], reply[4] = ord("0") + self._firmware[0], ord("0") + self._firmware[1]
        elif command == "l":
            self._led = a[0]
        elif command == "P":
            place = a[5] if a[5] < len(self.pattern) else 0
            self.pattern[place] = _Line((a[0], a[1], a[2]), a[3] << 8 | a[4], self._led)
            self.saves += self._firmware[0] < 2  # a mk1 writes its EEPROM at once
        elif command == "R":
            line = self.pattern[a[5] if a[5] < len(self.pattern) else 0]
            reply[2:8] = bytes((*line.rgb, line.ticks >> 8, line.ticks & 0xFF, line.led))
        elif command == "W":
            self.saves += a[:4] == bytes.fromhex("beefcafe")
        elif command == "D":
            end = a[5] + 1
            self._down = (a[4], end if end <= len(self.pattern) else len(self.pattern))
            self._bite_s = now_s + (a[1] << 8 | a[2]) * 0.01 if a[0] else math.inf
            if a[3] == 0:
                self.playing = False
                self._show((0, 0, 0), now_s)
        self._reply = bytes(reply)

    def get_feature(self, report_id: int, now_s: float) -> bytes:
        self.advance(now_s)
        return self._reply

    def advance(self, now_s: float) -> list[bytes]:
        if now_s > self._bite_s:
            self._next_s, self._bite_s = self._bite_s, math.inf
            self._play = (0, len(self.pattern)) if self._whole else self._down
            self._position, self.playing = self._play[0], True
        while self.playing and now_s > self._next_s:
            line = self.pattern[self._position]
            if line.ticks or any(line.rgb):  # lines of zeros alone are skipped
                self._show(line.rgb, self._next_s)
            self._position += 1
            if self._position >= self._play[1]:
                self._position = self._play[0]
            self._next_s += max(line.ticks * 0.01, 0.001)
        return []

    def _show(self, rgb: tuple[int, int, int], now_s: float) -> None:
        if any(rgb) != any(self.rgb):
            self.changes.append((now_s, any(rgb)))
        self.rgb = rgb


@dataclass
class ModelTransport:
    """A `HidTransport` to a model in the same process.

    Attributes:
        model: The device.
        address: As enumeration would give it.
        clock: Of the bench.
        takes_s: How long each transfer takes, by that clock.
        gone: It was pulled out.
        sent: Every report that went out.
    """

    model: HidModel
    address: HidAddress
    clock: Clock
    takes_s: float = 0.0
    gone: bool = False
    closed: bool = False
    sent: list[bytes] = field(default_factory=list)
    _incoming: deque[bytes] = field(default_factory=deque)

    def write(self, report: bytes) -> None:
        self._transfer(report)
        self._incoming += self.model.write(report, self.clock.now_s())

    def read(self, timeout_s: float) -> bytes:
        if self.gone or self.closed:
            raise FlashGoneError(f"{self.address.description} is gone")
        self._incoming += self.model.advance(self.clock.now_s())
        if not self._incoming and timeout_s > 0:
            self.clock.sleep(timeout_s)
            self._incoming += self.model.advance(self.clock.now_s())
        return self._incoming.popleft() if self._incoming else b""

    def send_feature(self, report: bytes) -> None:
        self._transfer(report)
        self.model.set_feature(report, self.clock.now_s())

    def get_feature(self, report_id: int, length: int) -> bytes:
        self._transfer(None)
        return self.model.get_feature(report_id, self.clock.now_s())[:length]

    def close(self) -> None:
        self.closed = True

    def _transfer(self, report: bytes | None) -> None:
        if self.gone or self.closed:
            raise FlashGoneError(f"{self.address.description} is gone")
        if self.takes_s:
            self.clock.sleep(self.takes_s)
        if report is not None:
            self.sent.append(report)


def _hidpp(index: int, function: int, parameters: bytes) -> bytes:
    return (bytes((0x11, 0xFF, index, function)) + parameters).ljust(20, b"\0")


class DrivenClock(VirtualClock):
    """Virtual time in which a `HostFlash` is served as its thread would: each switch when it is due.

    Attributes:
        flash: That is served; None = its host has died.
    """

    def __init__(self) -> None:
        super().__init__()
        self.flash: HostFlash | None = None
        self._serving = False

    def sleep(self, seconds: float) -> None:
        end_s = self.now_s() + max(0.0, seconds)
        if not self._serving and self.flash is not None:
            self._serving = True
            while (next_s := self.flash.next_s()) is not None and next_s <= end_s:
                self.advance_to(next_s)
                self.flash.run_due()
            self._serving = False
        self.advance_to(end_s)
