"""Reading and setting UVC controls: GET_INFO, MIN, MAX, RES, DEF, CUR and SET_CUR (UVC 1.5, section 4.2.1).

A request goes to an entity of the VideoControl interface: wValue is the selector shifted by 8, wIndex the
entity's number shifted by 8 plus the interface's number.
"""

from __future__ import annotations

from dataclasses import dataclass

from capture.devices.uvc.control_table import CONTROLS, Control
from capture.devices.uvc.descriptors import VideoControl
from capture.devices.uvc.usb_link import StalledError, UsbLink
from capture.errors import CameraError

_SET_CUR = 0x01
_GET_CUR, _GET_MIN, _GET_MAX, _GET_RES, _GET_INFO, _GET_DEF = 0x81, 0x82, 0x83, 0x84, 0x86, 0x87
_TO_DEVICE, _TO_HOST = 0x21, 0xA1  # class request to an interface
_ERROR_CODE_SELECTOR = 0x02
#: VC_REQUEST_ERROR_CODE_CONTROL (UVC 1.5, section 4.2.1.2).
_ERROR_WORDS = {
    1: "it is not ready",
    2: "not in its present state, as while an automatic is on",
    3: "its power mode does not allow it",
    4: "the value is out of range",
    5: "it has no such unit",
    6: "it has no such control",
    7: "it knows no such request",
    8: "the value is invalid within the range",
}


@dataclass(frozen=True)
class ControlState:
    """GET_INFO: what can be done with a control now (UVC 1.5, table 4-3)."""

    readable: bool
    settable: bool
    disabled_by_auto: bool
    auto_update: bool
    asynchronous: bool


@dataclass(frozen=True)
class Limits:
    """The values that a control takes; None = the camera does not say."""

    minimum: int | None = None
    maximum: int | None = None
    step: int | None = None
    default: int | None = None

    def nearest(self, value: float) -> int:
        """The value that the camera can take that is nearest."""
        chosen = round(value)
        if self.step and self.minimum is not None:
            chosen = self.minimum + round((value - self.minimum) / self.step) * self.step
        if self.maximum is not None and chosen > self.maximum:
            # The greatest step within the range: a camera's maximum need not be one.
            step, minimum = self.step or 1, self.minimum or 0
            chosen = minimum + (self.maximum - minimum) // step * step
        return chosen if self.minimum is None else max(chosen, self.minimum)

    def __str__(self) -> str:
        low, high = ("?" if end is None else str(end) for end in (self.minimum, self.maximum))
        return f"{low}..{high}" + (f" in steps of {self.step}" if (self.step or 1) > 1 else "")


class UvcControls:
    """The controls that a camera announces and answers for."""

    def __init__(self, link: UsbLink, interface: VideoControl) -> None:
        """Asks every announced control what it can do; a camera may announce what it then refuses."""
        self._link = link
        self._interface = interface
        self._limits: dict[str, Limits] = {}
        self.refused: list[str] = []
        self.names: list[str] = []
        for name, control in CONTROLS.items():
            unit = interface.units.get(control.entity)
            if unit is None or not unit.controls >> control.bit & 1:
                continue
            try:
                self.state(name)
            except StalledError:
                self.refused.append(name)
            else:
                self.names.append(name)

    def __contains__(self, name: object) -> bool:
        return name in self.names

    def state(self, name: str) -> ControlState:
        """What can be done with a control now."""
        bits = self._read(CONTROLS[name], _GET_INFO, 1)[0]
        return ControlState(*(bool(bits >> bit & 1) for bit in range(5)))

    def limits(self, name: str) -> Limits:
        """The values that it takes, asked once; modes and switches, all of one byte, have no range."""
        if CONTROLS[name].length == 1:
            return Limits()
        if name not in self._limits:
            requests = (_GET_MIN, _GET_MAX, _GET_RES, _GET_DEF)
            minimum, maximum, step, default = (
                self._optional(CONTROLS[name], request) for request in requests
            )
            if minimum is not None and maximum is not None and minimum > maximum:
                minimum = maximum = None  # cameras that answer with zeros or garbage
            self._limits[name] = Limits(minimum, maximum, step, default)
        return self._limits[name]

    def modes(self, name: str) -> int:
        """GET_RES of a bitmap control: the bits that it can be set to; 0 = the camera does not say."""
        return self._optional(CONTROLS[name], _GET_RES) or 0

    def get(self, name: str) -> int:
        """The value now."""
        control = CONTROLS[name]
        return control.decode(self._read(control, _GET_CUR, control.length))

    def set(self, name: str, value: int) -> None:
        """Sets a value as it is; `limits` gives those that the camera takes.

        Raises:
            StalledError: The camera refuses it, with its own reason where it gives one.
        """
        control = CONTROLS[name]
        low, high = control.span
        if not low <= value <= high:
            raise ValueError(f"{name} is {value}; its {control.size} bytes hold {low}..{high}")
        whole = control.length == control.size
        around = bytes(control.length) if whole else self._read(control, _GET_CUR, control.length)
        try:
            self._link.write(
                _TO_DEVICE,
                _SET_CUR,
                control.selector << 8,
                self._index(control),
                control.encode(value, around),
            )
        except StalledError as error:
            raise StalledError(f"The {self._link.device} refuses {name} = {value}: {self._why()}.") from error

    def _why(self) -> str:
        index = self._interface.interface
        try:
            code = self._link.read(_TO_HOST, _GET_CUR, _ERROR_CODE_SELECTOR << 8, index, 1)
        except CameraError:
            return "it does not say why"
        return _ERROR_WORDS.get(code[0] if code else 0, "it does not say why")

    def _optional(self, control: Control, request: int) -> int | None:
        try:
            return control.decode(self._read(control, request, control.length))
        except StalledError:
            return None

    def _read(self, control: Control, request: int, length: int) -> bytes:
        data = self._link.read(_TO_HOST, request, control.selector << 8, self._index(control), length)
        if len(data) != length:
            raise StalledError(
                f"The {self._link.device} answers for {control.name} with {len(data)} bytes, not {length}."
            )
        return data

    def _index(self, control: Control) -> int:
        return self._interface.units[control.entity].number << 8 | self._interface.interface
