"""What OpenCV's capture back ends make of a camera's controls: which property, which unit, and how they lie.

`VideoCapture.set` says True for a gain under automatic gain and for a clamped exposure, so whatever is set is
read back and compared. Facts, from the sources of OpenCV 4 and 5 (modules/videoio/src):

    V4L2   AUTO_EXPOSURE is V4L2's own menu, 1 manual and 3 automatic (0.25 is rounded to 0 = automatic);
           exposure in 100 us; the driver's clamping is ignored; no access to exposure_dynamic_framerate.
    DSHOW  AUTO_EXPOSURE 0 manual, 1 automatic (since 4.7; before it did nothing); exposure is the power of
           two of seconds, whole numbers; white balance in kelvin is WHITE_BALANCE_BLUE_U.
    MSMF   AUTO_EXPOSURE switches to automatic at any value but 0, and at 0 it also sets 1 s; setting the
           exposure switches to manual by itself. `get` gives the default of a control, never its value.
    others (AVFoundation, FFmpeg, GStreamer) set none of these.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Protocol

import cv2

from capture.devices.camera import CameraProfile, ControlReport


class Properties(Protocol):
    """The part of `cv2.VideoCapture` that controls go through."""

    def set(self, prop: int, value: float) -> bool:
        """Whether OpenCV thinks that it worked."""

    def get(self, prop: int) -> float:
        """What OpenCV thinks that the value is."""


@dataclass(frozen=True, kw_only=True)
class Way:
    """How one field of a profile is set through a back end.

    Attributes:
        prop: OpenCV's property.
        automatic: Property that turns the automatic off, its value for off and for on; None = setting the
            value does it.
        to_device: From the profile's unit to the property's.
        from_device: Back.
    """

    prop: int
    automatic: tuple[int, float, float] | None = None
    to_device: Callable[[float], float] = float
    from_device: Callable[[float], float] = float


@dataclass(frozen=True, kw_only=True)
class Dialect:
    """What a back end understands.

    Attributes:
        ways: By field of the profile; a field that is missing cannot be set.
        tells: Whether `get` gives the value that a control has.
    """

    ways: Mapping[str, Way] = field(default_factory=dict)
    tells: bool = True


def _log2(seconds: float) -> float:
    return float(round(math.log2(seconds)))


def _exp2(power: float) -> float:
    return 2.0**power


_FOCUS = Way(prop=cv2.CAP_PROP_FOCUS, automatic=(cv2.CAP_PROP_AUTOFOCUS, 0, 1))
_GAIN = Way(prop=cv2.CAP_PROP_GAIN)
DIALECTS: Mapping[str, Dialect] = {
    "V4L2": Dialect(
        ways={
            "exposure_s": Way(
                prop=cv2.CAP_PROP_EXPOSURE,
                automatic=(cv2.CAP_PROP_AUTO_EXPOSURE, 1, 3),
                to_device=lambda seconds: float(max(1, round(seconds * 1e4))),
                from_device=lambda units: units / 1e4,
            ),
            "gain": _GAIN,
            "white_balance_k": Way(prop=cv2.CAP_PROP_WB_TEMPERATURE, automatic=(cv2.CAP_PROP_AUTO_WB, 0, 1)),
            "focus": _FOCUS,
        }
    ),
    "DSHOW": Dialect(
        ways={
            "exposure_s": Way(
                prop=cv2.CAP_PROP_EXPOSURE,
                automatic=(cv2.CAP_PROP_AUTO_EXPOSURE, 0, 1),
                to_device=_log2,
                from_device=_exp2,
            ),
            "gain": _GAIN,
            "white_balance_k": Way(
                prop=cv2.CAP_PROP_WHITE_BALANCE_BLUE_U, automatic=(cv2.CAP_PROP_AUTO_WB, 0, 1)
            ),
            "focus": _FOCUS,
        }
    ),
    "MSMF": Dialect(
        ways={
            "exposure_s": Way(prop=cv2.CAP_PROP_EXPOSURE, to_device=_log2, from_device=_exp2),
            "gain": _GAIN,
            "white_balance_k": Way(prop=cv2.CAP_PROP_TEMPERATURE),
            "focus": Way(prop=cv2.CAP_PROP_FOCUS),
        },
        tells=False,
    ),
}
_NOTHING = Dialect()
_FIELDS = ("exposure_s", "gain", "white_balance_k", "focus", "mains_hz")
#: Automatics that MSMF can at least switch on again, without telling whether they were on.
_SWITCHED_ON_AGAIN = (cv2.CAP_PROP_AUTO_EXPOSURE, cv2.CAP_PROP_AUTOFOCUS)


class OpenCvControls:
    """A camera's controls as OpenCV reaches them."""

    def __init__(self, properties: Properties, back_end: str) -> None:
        """Changes nothing."""
        self._properties = properties
        self._back_end = back_end
        self._dialect = DIALECTS.get(back_end, _NOTHING)
        self._found: dict[int, float] | None = None
        self._locked: dict[str, float] = {}

    def lock(self, profile: CameraProfile, fresh: bool) -> list[ControlReport]:
        """Automatics off, values set, everything read back; a value nobody asked for stays as it is found.

        Args:
            profile: What is asked.
            fresh: The stream has just begun; the camera may have lost what OpenCV says that it has.
        """
        if self._found is None:
            self._found = self._present()
        reports = []
        for name in _FIELDS:
            asked: float | None = getattr(profile, name)
            way = self._dialect.ways.get(name)
            if way is not None:
                reports.append(self._apply(name, way, asked, fresh))
            elif asked is not None:
                note = f"OpenCV cannot set it through {self._back_end or 'this back end'}"
                reports.append(ControlReport(name=name, requested=asked, read_back=None, note=note))
        return reports

    def _present(self) -> dict[int, float]:
        if not self._dialect.tells:
            return {}
        props = []
        for way in self._dialect.ways.values():
            props.append(way.prop)
            if way.automatic is not None:
                props.append(way.automatic[0])
        return {prop: self._properties.get(prop) for prop in props}

    def _apply(self, name: str, way: Way, asked: float | None, fresh: bool) -> ControlReport:
        notes = []
        found = self._properties.get(way.prop)
        if way.automatic is not None:
            prop, off, on = way.automatic
            if fresh and self._properties.get(prop) == off:
                self._properties.set(prop, on)  # a camera can have lost the mode that it says it has
            self._properties.set(prop, off)
            if self._properties.get(prop) != off:
                notes.append("OpenCV cannot say that the automatic is off")
        elif asked is None:
            if name != "gain":
                notes.append("only a value turns the automatic off; ask for one")
            return self._report(name, way, None, found if self._dialect.tells else None, notes)
        value = found if asked is None else way.to_device(asked)
        if asked is not None and not math.isclose(way.from_device(value), asked, rel_tol=0.01):
            notes.append(f"the nearest that can be asked for is {way.from_device(value):.6g}")
        if not self._properties.set(way.prop, value):
            notes.append("OpenCV says that it cannot be set")
            return self._report(name, way, asked, None, notes)
        if not self._dialect.tells:
            notes.append(f"OpenCV does not tell through {self._back_end} what it is now")
            return self._report(name, way, asked, None, notes)
        read = self._properties.get(way.prop)
        if read != value:
            notes.append(f"set to {value:g}, but OpenCV says {read:g}")
        return self._report(name, way, asked, read, notes)

    def _report(
        self, name: str, way: Way, asked: float | None, read: float | None, notes: list[str]
    ) -> ControlReport:
        if read is not None:
            self._locked[name] = read
        return ControlReport(
            name=name,
            requested=asked,
            read_back=None if read is None else way.from_device(read),
            note="; ".join(notes),
        )

    @property
    def sets_exposure(self) -> bool:
        """Whether there is a way to the exposure at all."""
        return "exposure_s" in self._dialect.ways

    def set_exposure(self, exposure_s: float) -> float:
        """Tries an exposure; what OpenCV says of it, or what it was asked for where it does not tell."""
        way = self._dialect.ways["exposure_s"]
        value = way.to_device(exposure_s)
        self._properties.set(way.prop, value)
        return way.from_device(self._properties.get(way.prop) if self._dialect.tells else value)

    def check(self) -> tuple[ControlReport, ...]:
        """The controls that OpenCV says have another value than after the lock."""
        changed = []
        for name, locked in self._locked.items():
            way = self._dialect.ways[name]
            read = self._properties.get(way.prop)
            if read != locked:
                changed.append(
                    ControlReport(
                        name=name,
                        requested=way.from_device(locked),
                        read_back=way.from_device(read),
                        verified=False,
                        note=f"was {locked:g} after the lock and is {read:g} now",
                    )
                )
        return tuple(changed)

    def restore(self) -> tuple[str, ...]:
        """Puts back what was found; values first, then the automatics, which would refuse them."""
        found, self._found = self._found, None
        self._locked = {}
        if found is None:
            return ()
        if not self._dialect.tells:
            for prop in _SWITCHED_ON_AGAIN:
                self._properties.set(prop, 1)
            return (
                f"OpenCV does not tell through {self._back_end} what the controls were; automatic exposure "
                "and focus are switched on, the others stay as they were set.",
            )
        problems = []
        automatics = {way.automatic[0] for way in self._dialect.ways.values() if way.automatic is not None}
        for prop, value in sorted(found.items(), key=lambda item: item[0] in automatics):
            if self._properties.get(prop) != value:
                self._properties.set(prop, value)
                if prop in automatics and self._properties.get(prop) != value:
                    problems.append(
                        f"OpenCV could not put property {prop} back to {value:g}; unplug the camera and plug "
                        "it in again."
                    )
        return tuple(problems)
