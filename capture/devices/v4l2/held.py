"""A control that a lock holds, and what the report says of it."""

from __future__ import annotations

from dataclasses import dataclass

from capture.devices.camera import ControlReport
from capture.devices.light_check import LightCheck
from capture.devices.v4l2 import structs as v4l2
from capture.devices.v4l2.controls import Control
from capture.devices.v4l2.settings import SETTINGS, from_device, mains_of

#: White balance and focus stay where their automatic has left them: what a driver says of them in automatic
#: mode is often old, and written back it would change the picture.
LEFT_ALONE = ("white_balance_k", "focus")
AS_LEFT, MATCHED = "as the automatic left it", "matched to the light of the automatic"


@dataclass
class Held:
    """A control under lock.

    Attributes:
        control: As it was when it was set.
        name: In the report.
        wanted: In the device's unit: what was written, after the lock what the device then had.
        asked: In the report's unit; None = found, not asked for.
        note: What is to be said of it.
    """

    control: Control
    name: str
    wanted: int
    asked: float | None
    note: str = ""

    @property
    def found(self) -> bool:
        """Whether it is where an automatic has left it, and was not written."""
        return self.name in LEFT_ALONE and self.asked is None

    def in_profile(self, value: int) -> float:
        """A device's value in the unit of the report."""
        if self.name == "mains_hz":
            hertz = mains_of(value)
            return float(value) if hertz is None else hertz
        return from_device(self.name, value)

    def report(self, value: int | None, check: LightCheck | None) -> tuple[ControlReport, str]:
        """(report, what of it is worth a warning), and from now on `value` is what is held.

        Args:
            value: That was read back; None = the device does not tell.
            check: What the light said of the exposure.
        """
        notes = [self.note] if self.note else []
        if value is None:
            notes.append("the device does not tell it")
        elif value != self.wanted:
            if not self.found:
                said = f"the device has {self.in_profile(value):g}, not {self.in_profile(self.wanted):g}"
                notes.append(said)
            self.wanted = value
        verified = None
        if self.control.id == v4l2.CID_EXPOSURE_ABSOLUTE and check is not None:
            verified = check.verified
            notes.append(check.note)
        requested = self.asked
        if requested is None and self.name not in SETTINGS:
            requested = self.in_profile(self.wanted)
        report = ControlReport(
            name=self.name,
            requested=requested,
            read_back=None if value is None else self.in_profile(value),
            verified=verified,
            note="; ".join(notes),
        )
        return report, "; ".join(note for note in notes if not _harmless(note, check))


def why_not(control: Control, value: float, number: int, name: str) -> str:
    """Why a value became another, in words.

    Args:
        control: That could not take it.
        value: That was asked, in the device's unit.
        number: That it takes.
        name: In the report.
    """
    asked, taken = from_device(name, value), from_device(name, number)
    low, high = from_device(name, control.minimum), from_device(name, control.maximum)
    if not control.minimum <= value <= control.maximum:
        return f"{asked:g} is outside the device's {low:g}..{high:g}; {taken:g} was set"
    return f"{asked:g} was rounded to {taken:g}, the device's step"


def _harmless(note: str, check: LightCheck | None) -> bool:
    if check is not None and note == check.note:
        return check.verified is True
    return note.startswith((AS_LEFT, MATCHED))
