"""Locking a camera's controls: automatics off, values written, everything read back and tried with light."""

from __future__ import annotations

from collections.abc import Callable

from capture.devices.camera import CameraProfile, CapturedFrame, ControlReport, StreamFormat
from capture.devices.light_check import LightCheck, mean_light, skip_latency, verify_exposure
from capture.devices.v4l2 import structs as v4l2
from capture.devices.v4l2.controls import Control, Controls
from capture.devices.v4l2.held import AS_LEFT, LEFT_ALONE, MATCHED, Held, why_not
from capture.devices.v4l2.settings import (
    AUTOMATICS,
    FINDERS,
    NEUTRAL,
    POWER_LINE,
    SETTINGS,
    asks,
    automatic_exposure,
    from_device,
    manual_exposure,
    own_name,
    to_device,
    without_banding,
)

#: While automatics find their values: looks, frames between them, and a change that counts as settled.
_LOOKS, _FRAMES_BETWEEN, _SETTLED = 12, 10, 0.02
#: After the automatics the frozen picture must have the light of the automatic one, within this factor.
_SAME_LIGHT, _MATCHES = 1.15, 4
#: Controls of one driver alone (V4L2_CTRL_DRIVER_PRIV) are none of ours.
_DRIVERS_OWN = 0x1000


class ControlLock:
    """The controls of one camera. Every method may raise `CameraError`."""

    def __init__(
        self,
        controls: Controls,
        read: Callable[[], CapturedFrame],
        format: Callable[[], StreamFormat],
    ) -> None:
        """Touches nothing yet.

        Args:
            controls: Of an open node.
            read: The next frame of the running stream.
            format: Of these frames.
        """
        self._controls = controls
        self._read = read
        self._format = format
        self._saved: dict[int, tuple[Control, int]] = {}
        self._locked: dict[int, Held] = {}
        self._check: LightCheck | None = None
        self._fresh = True
        self._warnings: list[str] = []

    def lock(self, profile: CameraProfile, fresh: bool) -> tuple[tuple[ControlReport, ...], tuple[str, ...]]:
        """Sets everything; (reports, warnings).

        Args:
            profile: What is asked.
            fresh: The stream has just begun: what the driver says of its controls may not be true any more.
        """
        self._fresh = fresh or not self._locked
        self._warnings = []
        earlier = dict(self._locked)
        known = self._controls.all()
        for control in known.values():
            if control.id not in self._saved and (value := self._controls.get(control)) is not None:
                self._saved[control.id] = (control, value)
        before = self._exposure()
        self._lock_mains(known, profile.mains_hz)
        values = self._open_settings(profile, known, earlier)
        target = self._find(values, known, profile) if values["exposure_s"] is None else None
        if target is None and None in values.values():
            self._find(values, known, profile)
        self._automatics_off(known)
        for identity, neutral in NEUTRAL.items():
            if identity in known:
                self._hold(identity, own_name(known[identity]), neutral(known[identity]), None)
        for name in SETTINGS:
            self._lock_setting(name, values[name], profile, known)
        self._settle_down()
        if target is not None:
            self._match_light(target, profile)
        if self._fresh or self._exposure() != before:
            self._check = self._verify()
        reports = self._reports(profile, known, self._check)
        for locked in self._locked.values():
            self._controls.subscribe(locked.control)
        self._controls.changes()
        return reports, tuple(self._warnings)

    def check(self) -> tuple[ControlReport, ...]:
        """Controls that are not what the lock left, or were not for a while."""
        changes = self._controls.changes()
        drifted = []
        for identity, locked in self._locked.items():
            value = self._controls.get(locked.control)
            held = locked.in_profile(locked.wanted)
            found = None if value is None else locked.in_profile(value)
            if value is not None and value != locked.wanted:
                note = f"changed from {held:g} to {found:g} behind our back"
            elif changes.get(identity, locked.wanted) != locked.wanted:
                note = f"was changed to {locked.in_profile(changes[identity]):g} and back"
            else:
                continue
            drifted.append(ControlReport(name=locked.name, requested=held, read_back=found, note=note))
        return tuple(drifted)

    def restore(self) -> tuple[str, ...]:
        """Puts back what was found: values first, while no automatic holds them, automatics last."""
        if not self._locked:
            return ()
        automatics = [one for one in (v4l2.CID_EXPOSURE_AUTO, *AUTOMATICS) if one in self._locked]
        for identity in automatics:
            self._release_from(identity)
        values = [identity for identity in self._locked if identity not in automatics]
        order = [identity for identity in (*values, *reversed(automatics)) if identity in self._saved]
        failures = [failure for identity in order if (failure := self._put_back(identity))]
        self._locked.clear()
        self._check = None
        return tuple(failures)

    # ------------------------------------------------------------------------------ the steps of a lock

    def _open_settings(
        self, profile: CameraProfile, known: dict[int, Control], earlier: dict[int, Held]
    ) -> dict[str, float | None]:
        """Name -> value in the report's unit; None = to be found by the automatics."""
        values: dict[str, float | None] = {}
        for name in SETTINGS:
            values[name] = asks(profile, name)
            control = self._control_of(name, known)
            if values[name] is None and not self._fresh and control and control.id in earlier:
                values[name] = from_device(name, earlier[control.id].wanted)
        return values

    def _find(
        self, values: dict[str, float | None], known: dict[int, Control], profile: CameraProfile
    ) -> float | None:
        """Lets the automatics of the open settings run; fills their values in; the light they settled at."""
        wanted = {name for name, value in values.items() if value is None and self._control_of(name, known)}
        finders = {identity for name in wanted for identity in FINDERS[name] if identity in known}
        for identity in finders:
            automatic = known[identity]
            is_menu = identity == v4l2.CID_EXPOSURE_AUTO
            entry = automatic_exposure(automatic) if is_menu else automatic.maximum
            if entry is not None:
                self._controls.set(automatic, entry)
        if not wanted:
            return None
        light = self._settled_light() if finders else float(mean_light(self._read, self._format).mean())
        for name in wanted:
            control = self._control_of(name, known)
            value = None if control is None else self._controls.get(control)
            if value is not None:
                values[name] = from_device(name, value)
        return light

    def _settled_light(self) -> float:
        """Mean linear light once it does not change any more, or after a few seconds."""
        last = 0.0
        for _ in range(_LOOKS):
            for _ in range(_FRAMES_BETWEEN):
                self._read()
            light = float(mean_light(self._read, self._format, 2).mean())
            if abs(light - last) <= _SETTLED * max(light, 1e-6):
                return light
            last = light
        return last

    def _automatics_off(self, known: dict[int, Control]) -> None:
        if control := known.get(v4l2.CID_EXPOSURE_AUTO):
            manual = manual_exposure(control)
            if manual is None:
                self._warn("The camera's exposure cannot be set by hand; its automatic stays on.")
            else:
                self._force_manual(control, manual)
                self._hold(control.id, own_name(control), manual, None, write=False)
        for identity in AUTOMATICS:
            if identity in known:
                self._hold(identity, own_name(known[identity]), known[identity].minimum, None)

    def _force_manual(self, control: Control, manual: int) -> None:
        """Manual mode that the device has, too: a driver that believes it is set would not send it again."""
        other = automatic_exposure(control)
        if self._fresh and other is not None and self._controls.get(control) == manual:
            self._controls.set(control, other)
        if self._fresh or self._controls.get(control) != manual:
            self._controls.set(control, manual)

    def _lock_setting(
        self, name: str, value: float | None, profile: CameraProfile, known: dict[int, Control]
    ) -> None:
        asked = asks(profile, name)
        control = self._control_of(name, known)
        if control is None or not control.writable:
            if asked is not None:
                self._warn(f"{name} cannot be set to {asked:g}: the camera has no control for it.")
            return
        if value is None:  # the device does not tell what its automatic has found
            if name in LEFT_ALONE:
                return
            value = from_device(name, control.default)
        found = asked is None
        if name == "exposure_s" and found:
            value = without_banding(value, profile.mains_hz)
        note = AS_LEFT if found and self._fresh else ""
        write = not (found and name in LEFT_ALONE)
        self._hold(control.id, name, to_device(name, value), asked, note=note, write=write)

    def _lock_mains(self, known: dict[int, Control], mains_hz: int | None) -> None:
        control = known.get(v4l2.CID_POWER_LINE_FREQUENCY)
        if control is None or mains_hz is None:
            return
        if POWER_LINE[mains_hz] not in control.menu:
            self._warn(f"mains_hz cannot be set to {mains_hz}: the camera's filter has no such entry.")
            return
        self._hold(control.id, "mains_hz", POWER_LINE[mains_hz], mains_hz)

    def _hold(
        self,
        identity: int,
        name: str,
        value: float,
        asked: float | None,
        note: str = "",
        write: bool = True,
    ) -> None:
        """Writes a control with the flags it has now, and remembers it."""
        control = self._controls.query(identity)
        if control is None:
            return
        number = control.nearest(value)
        notes = [note] if note else []
        if abs(number - value) > 1e-6 * abs(value) and asked is not None:
            notes.append(why_not(control, value, number, name))
        differs = write and (self._fresh or self._controls.get(control) != number)
        if differs and (refusal := self._controls.set(control, number)):
            notes.append(f"refused: {refusal}")
        self._locked[identity] = Held(control, name, number, asked, "; ".join(notes))

    def _settle_down(self) -> None:
        """A second try for what did not stay: some cameras lose a write while they change mode."""
        for locked in self._locked.values():
            if (
                self._controls.get(locked.control) not in (None, locked.wanted)
                and "as the" not in locked.note
            ):
                self._controls.set(locked.control, locked.wanted)
        skip_latency(self._read)

    def _match_light(self, target: float, profile: CameraProfile) -> None:
        """Corrects a frozen exposure until the picture has the light that the automatic gave it.

        What a driver reads back in automatic mode may be an old value; the light is not.
        """
        locked = self._locked.get(v4l2.CID_EXPOSURE_ABSOLUTE)
        if locked is None:
            return
        first = locked.wanted
        for _ in range(_MATCHES):
            light = float(mean_light(self._read, self._format).mean())
            factor = target / max(light, 1e-4)
            if 1 / _SAME_LIGHT <= factor <= _SAME_LIGHT:
                break
            wanted_s = from_device("exposure_s", locked.wanted * min(max(factor, 0.1), 10.0))
            number = locked.control.nearest(
                to_device("exposure_s", without_banding(wanted_s, profile.mains_hz))
            )
            if number == locked.wanted:
                break
            locked.wanted = number
            self._controls.set(locked.control, number)
            skip_latency(self._read)
        if locked.wanted != first:
            locked.note = f"{MATCHED}, which said {from_device('exposure_s', first):g} s"

    def _verify(self) -> LightCheck | None:
        """The light's word on the exposure; after a failure manual mode is set anew and it is asked again."""
        locked = self._locked.get(v4l2.CID_EXPOSURE_ABSOLUTE)
        if locked is None:
            return None
        check = self._verify_once(locked)
        automatic = self._locked.get(v4l2.CID_EXPOSURE_AUTO)
        if check.verified is False and automatic is not None:
            self._fresh = True
            if (other := automatic_exposure(automatic.control)) is not None:
                self._controls.set(automatic.control, other)
            self._controls.set(automatic.control, automatic.wanted)
            for held in list(self._locked.values()):
                if held is not automatic and not held.found:
                    self._controls.set(held.control, held.wanted)
            skip_latency(self._read)
            check = self._verify_once(locked)
        return check

    def _verify_once(self, locked: Held) -> LightCheck:
        def set_exposure(exposure_s: float) -> float:
            number = locked.control.nearest(to_device("exposure_s", exposure_s))
            self._controls.set(locked.control, number)
            value = self._controls.get(locked.control)
            return from_device("exposure_s", number if value is None else value)

        check = verify_exposure(
            self._read, self._format, set_exposure, from_device("exposure_s", locked.wanted)
        )
        skip_latency(self._read)
        return check

    # ----------------------------------------------------------------------------------- what it says

    def _reports(
        self, profile: CameraProfile, known: dict[int, Control], check: LightCheck | None
    ) -> tuple[ControlReport, ...]:
        reports = []
        for locked in self._locked.values():
            report, trouble = locked.report(self._controls.get(locked.control), check)
            reports.append(report)
            if trouble:
                self._warn(f"{locked.name}: {trouble}.")
        for name in SETTINGS:
            asked = asks(profile, name)
            if asked is not None and all(report.name != name for report in reports):
                note = "the camera has no control for it"
                reports.append(ControlReport(name=name, requested=asked, read_back=None, note=note))
        for identity, control in known.items():
            if identity not in self._locked and identity & 0xFFFF < _DRIVERS_OWN:
                value = self._controls.get(control)
                found = None if value is None else float(value)
                reports.append(ControlReport(name=own_name(control), requested=None, read_back=found))
        return tuple(reports)

    # ---------------------------------------------------------------------------------- small matters

    def _control_of(self, name: str, known: dict[int, Control]) -> Control | None:
        return next((known[identity] for identity in SETTINGS[name] if identity in known), None)

    def _exposure(self) -> int | None:
        locked = self._locked.get(v4l2.CID_EXPOSURE_ABSOLUTE)
        return None if locked is None else locked.wanted

    def _release_from(self, identity: int) -> None:
        """An automatic off again, should somebody have switched it on, so that values can be put back."""
        locked = self._locked.get(identity)
        if locked is not None and self._controls.get(locked.control) != locked.wanted:
            self._controls.set(locked.control, locked.wanted)

    def _put_back(self, identity: int) -> str:
        """Empty, or a sentence."""
        earlier, value = self._saved[identity]
        control = self._controls.query(identity) or earlier
        if not control.writable or self._controls.get(control) == value:
            return ""
        refusal = self._controls.set(control, value)
        if earlier.inactive or earlier.flags & v4l2.CTRL_FLAG_VOLATILE:
            return ""  # it was what an automatic made of it, and will be again
        if refusal:
            return f"{own_name(control)} could not be put back to {value}: {refusal}."
        found = self._controls.get(control)
        if found not in (None, value):
            return f"{own_name(control)} could not be put back to {value}; the device has {found}."
        return ""

    def _warn(self, sentence: str) -> None:
        self._warnings.append(sentence)
