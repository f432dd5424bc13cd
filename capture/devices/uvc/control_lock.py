"""Locking a UVC camera's controls by requests: automatics off, values set, everything read back, put back.

Order of a lock (each step is there because some camera needs it): what the automatics have found is read
before the stream starts; after it has, automatics off, because firmware forgets its controls at a start, and
exposure by way of another mode, because a camera can have lost the mode that it says it has; only then the
values, because they are refused while an automatic is on; at last everything is read back.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

from capture.devices.bench import Bench
from capture.devices.camera import CameraProfile, ControlReport
from capture.devices.uvc.requests import UvcControls
from capture.devices.uvc.usb_link import StalledError
from capture.errors import CameraError, CameraGoneError

_EXPOSURE, _AE_MODE = "exposure_time_absolute", "auto_exposure_mode"
_UNIT_S = 1e-4  # of the exposure time
_MANUAL, _AUTO, _SHUTTER_PRIORITY, _APERTURE_PRIORITY = 1, 2, 4, 8
_AUTOMATICS = (
    "auto_exposure_priority",
    "white_balance_temperature_auto",
    "white_balance_component_auto",
    "focus_auto",
    "hue_auto",
    "contrast_auto",
)
#: Control -> the automatic that sets it, and the values of that in which it does.
_GOVERNED = {
    _EXPOSURE: (_AE_MODE, (_AUTO, _APERTURE_PRIORITY)),
    "iris_absolute": (_AE_MODE, (_AUTO, _SHUTTER_PRIORITY)),
    "white_balance_temperature": ("white_balance_temperature_auto", (1,)),
    "white_balance_blue": ("white_balance_component_auto", (1,)),
    "white_balance_red": ("white_balance_component_auto", (1,)),
    "focus_absolute": ("focus_auto", (1,)),
    "hue": ("hue_auto", (1,)),
    "contrast": ("contrast_auto", (1,)),
}
_LEAST = ("backlight_compensation", "sharpness")  # set to their least value
_DEFAULT = ("brightness", "contrast", "saturation", "hue", "gamma")  # whatever was there before us
_RECORDED = (
    "white_balance_blue",
    "white_balance_red",
    "digital_multiplier",
    "iris_absolute",
    "zoom_absolute",
    "pan_absolute",
    "tilt_absolute",
    "roll_absolute",
)
_HZ_OF_POWER_LINE: dict[int, float] = {0: 0.0, 1: 50.0, 2: 60.0}
_POWER_LINE_OF_HZ: dict[float, float] = {0: 0.0, 50: 1.0, 60: 2.0}
_SETTLING_S = 0.5  # a lens that moves (GET_INFO: asynchronous) answers with where it is
_SETTLING_STEP_S = 0.05


@dataclass(frozen=True)
class _Setting:
    """A field of the profile and the control that it goes to, with the conversion both ways."""

    field: str
    control: str
    to_device: Callable[[float], float] = float
    from_device: Callable[[int], float | None] = float


def _seconds(units: float) -> float:
    return round(units * _UNIT_S, 7)


_SETTINGS = (
    _Setting("exposure_s", _EXPOSURE, lambda exposure_s: exposure_s / _UNIT_S, _seconds),
    _Setting("gain", "gain"),
    _Setting("white_balance_k", "white_balance_temperature"),
    _Setting("focus", "focus_absolute"),
    _Setting("mains_hz", "power_line_frequency", _POWER_LINE_OF_HZ.__getitem__, _HZ_OF_POWER_LINE.get),
)


class ControlLock:
    """The controls of one camera, held."""

    def __init__(self, controls: UvcControls, bench: Bench) -> None:
        """Touches nothing yet."""
        self._controls = controls
        self._bench = bench
        self._found: dict[str, int] | None = None
        self._before: dict[str, int] = {}
        self._locked: dict[str, int] = {}

    def begin(self) -> bool:
        """Notes what the controls are before the stream starts; whether they have not been touched yet."""
        fresh = self._found is None
        self._before = self._readable()
        if self._found is None:
            self._found = self._before
        return fresh

    def lock(self, profile: CameraProfile, fresh: bool) -> list[ControlReport]:
        """Sets everything; the stream runs.

        Args:
            profile: What is asked.
            fresh: The stream has just begun: everything is set, whatever the camera says that it has.
        """
        reports = [*self._automatics_off(fresh)]
        for setting in _SETTINGS:
            reports.extend(self._apply(setting, getattr(profile, setting.field), fresh))
        for name in (*_LEAST, *_DEFAULT):
            if name in self._controls:
                limits = self._controls.limits(name)
                neutral = limits.minimum if name in _LEAST else limits.default
                value = float(self._before.get(name, 0) if neutral is None else neutral)
                reports.append(self._set(name, name, value, float, fresh, requested=value))
        now = self._readable()
        for name in _RECORDED:
            if name in now:
                self._locked[name] = now[name]
                reports.append(ControlReport(name=name, requested=None, read_back=float(now[name])))
        return reports

    @property
    def exposure_s(self) -> float | None:
        """That is locked; None = the camera has no such control."""
        units = self._locked.get(_EXPOSURE)
        return None if units is None else _seconds(units)

    @property
    def shut(self) -> bool:
        """Whether the camera says that its privacy shutter is closed."""
        if "privacy" not in self._controls:
            return False
        try:
            return self._controls.get("privacy") == 1
        except StalledError:
            return False

    def set_exposure(self, exposure_s: float) -> float:
        """Tries an exposure without holding it; what the camera says it has."""
        with suppress(StalledError):  # then it keeps what it has, which the read-back says
            self._controls.set(_EXPOSURE, self._controls.limits(_EXPOSURE).nearest(exposure_s / _UNIT_S))
        return _seconds(self._controls.get(_EXPOSURE))

    def force_manual(self) -> None:
        """The lock's exposure mode, by way of another: a camera can have lost the mode it says it has."""
        if (manual := self._locked.get(_AE_MODE)) is not None:
            self._force_manual(manual)

    def check(self) -> tuple[ControlReport, ...]:
        """Reads every locked control again: other programs and the firmware change them."""
        changed = []
        names = {setting.control: setting for setting in _SETTINGS}
        for name, locked in self._locked.items():
            setting = names.get(name, _Setting(name, name))
            try:
                read = self._controls.get(name)
            except StalledError as error:
                changed.append(
                    ControlReport(
                        name=setting.field,
                        requested=setting.from_device(locked),
                        read_back=None,
                        note=str(error).rstrip("."),
                    )
                )
                continue
            if read != locked:
                changed.append(
                    ControlReport(
                        name=setting.field,
                        requested=setting.from_device(locked),
                        read_back=setting.from_device(read),
                        verified=False,
                        note=f"was {locked} after the lock and is {read} now",
                    )
                )
        return tuple(changed)

    def restore(self) -> tuple[str, ...]:
        """Puts back what `lock` found: the values first, because they are refused once an automatic is on."""
        found, self._found = self._found, None
        self._locked = {}
        if found is None:
            return ()
        problems: list[str] = []
        automatics = (_AE_MODE, *_AUTOMATICS)
        values = [name for name in found if name not in automatics and not _was_governed(name, found)]
        for name in (*values, *(name for name in automatics if name in found)):
            try:
                if self._controls.get(name) != found[name]:
                    self._controls.set(name, found[name])
            except CameraGoneError as error:
                return (*problems, f"The controls could not be put back: {error}")
            except CameraError as error:
                problems.append(f"{name} could not be put back to {found[name]}: {error}")
        return tuple(problems)

    def _readable(self) -> dict[str, int]:
        values = {}
        for name in self._controls.names:
            try:
                values[name] = self._controls.get(name)
            except StalledError:
                continue  # one that can only be set, or not be read while an automatic has it
        return values

    def _automatics_off(self, fresh: bool) -> list[ControlReport]:
        reports = []
        if _AE_MODE in self._controls:
            modes = self._controls.modes(_AE_MODE)
            wanted = _SHUTTER_PRIORITY if modes & _SHUTTER_PRIORITY and not modes & _MANUAL else _MANUAL
            if fresh and self._before.get(_AE_MODE) == wanted:
                self._force_manual(wanted)
            reports.append(self._set(_AE_MODE, _AE_MODE, wanted, float, fresh, requested=float(wanted)))
        for name in _AUTOMATICS:
            if name in self._controls:
                reports.append(self._set(name, name, 0.0, float, fresh, requested=0.0))
        return reports

    def _apply(self, setting: _Setting, asked: float | None, fresh: bool) -> list[ControlReport]:
        """Sets one field of the profile; without a wish, what the automatic had found stays."""
        name = setting.control
        if name not in self._controls:
            if asked is None:
                return []
            note = "the camera has no such control"
            return [ControlReport(name=setting.field, requested=asked, read_back=None, note=note)]
        if asked is not None:
            value = setting.to_device(asked)
        elif name == "power_line_frequency" and self._before.get(name) not in _HZ_OF_POWER_LINE:
            value = 0.0  # it looks for the mains by itself, an automatic too
        elif name in self._before:
            value = float(self._before[name])
        else:
            value = float(self._controls.limits(name).default or 0)
        return [self._set(setting.field, name, value, setting.from_device, fresh, requested=asked)]

    def _set(
        self,
        report_name: str,
        name: str,
        value: float,
        from_device: Callable[[int], float | None],
        always: bool,
        requested: float | None,
    ) -> ControlReport:
        """Sets a control to the nearest value that the camera takes, reads it back, says how that went."""
        limits = self._controls.limits(name)
        chosen = limits.nearest(value)
        notes = []
        if requested is not None and abs(chosen - value) > 0.5:
            notes.append(f"asked for {value:.6g} in the camera's units, which takes {limits}")
        try:
            if always or self._controls.get(name) != chosen:
                if self._controls.state(name).disabled_by_auto:
                    notes.append("the camera says that an automatic has it")
                self._controls.set(name, chosen)
            read = self._read_back(name, chosen)
        except StalledError as error:
            notes.append(str(error).rstrip("."))
            return ControlReport(name=report_name, requested=requested, read_back=None, note="; ".join(notes))
        if read != chosen:
            notes.append(f"set to {chosen}, but the camera says {read}")
        self._locked[name] = read
        return ControlReport(
            name=report_name, requested=requested, read_back=from_device(read), note="; ".join(notes)
        )

    def _read_back(self, name: str, chosen: int) -> int:
        read = self._controls.get(name)
        waited_s = 0.0
        while read != chosen and waited_s < _SETTLING_S and self._controls.state(name).asynchronous:
            self._bench.clock.sleep(_SETTLING_STEP_S)
            waited_s += _SETTLING_STEP_S
            read = self._controls.get(name)
        return read

    def _force_manual(self, manual: int) -> None:
        """Manual mode by way of another: a camera can have lost the mode that it says it has."""
        modes = self._controls.modes(_AE_MODE)
        detour = next((mode for mode in (_APERTURE_PRIORITY, _AUTO) if modes & mode), None)
        for mode in (detour, manual):
            if mode is not None:
                with suppress(StalledError):
                    self._controls.set(_AE_MODE, mode)


def _was_governed(name: str, found: dict[str, int]) -> bool:
    """Whether an automatic was setting a control when it was found, so that its value means nothing."""
    automatic, values = _GOVERNED.get(name, ("", ()))
    return found.get(automatic) in values
