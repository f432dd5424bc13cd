"""The controls of the fake V4L2 driver: what the driver remembers, and what the device does."""

from __future__ import annotations

import errno
import os
from dataclasses import dataclass

from capture.devices.v4l2 import structs as v4l2
from capture.devices.v4l2.fake_quirks import Quirks
from capture.devices.v4l2.fake_sensor import SensorState, gain_factor

_INTEGER, _BOOLEAN, _MENU = v4l2.CTRL_TYPE_INTEGER, v4l2.CTRL_TYPE_BOOLEAN, v4l2.CTRL_TYPE_MENU
#: Mean linear light that the automatic aims at, and the share of the way that it goes with a frame.
_AIM, _SPEED = 0.18, 0.25
_ROOM_K = 4000.0
#: What `ignores_exposure` exposes for, 100 us.
_FIXED_EXPOSURE = 100.0


@dataclass(frozen=True)
class Spec:
    """One control as the driver lists it."""

    id: int
    name: str
    old_name: str
    kind: int
    minimum: int
    maximum: int
    step: int
    default: int
    menu: tuple[tuple[int, str], ...] = ()


_SPECS = (
    Spec(v4l2.CID_BRIGHTNESS, "Brightness", "Brightness", _INTEGER, 0, 255, 1, 128),
    Spec(v4l2.CID_CONTRAST, "Contrast", "Contrast", _INTEGER, 0, 255, 1, 128),
    Spec(v4l2.CID_SATURATION, "Saturation", "Saturation", _INTEGER, 0, 255, 1, 128),
    Spec(
        v4l2.CID_AUTO_WHITE_BALANCE,
        "White Balance, Automatic",
        "White Balance Temperature, Auto",
        _BOOLEAN,
        0,
        1,
        1,
        1,
    ),
    Spec(v4l2.CID_GAIN, "Gain", "Gain", _INTEGER, 0, 255, 1, 0),
    Spec(
        v4l2.CID_POWER_LINE_FREQUENCY,
        "Power Line Frequency",
        "Power Line Frequency",
        _MENU,
        0,
        2,
        1,
        2,
        ((0, "Disabled"), (1, "50 Hz"), (2, "60 Hz")),
    ),
    Spec(
        v4l2.CID_WHITE_BALANCE_TEMPERATURE,
        "White Balance Temperature",
        "White Balance Temperature",
        _INTEGER,
        2000,
        6500,
        10,
        4000,
    ),
    Spec(v4l2.CID_SHARPNESS, "Sharpness", "Sharpness", _INTEGER, 0, 255, 1, 128),
    Spec(
        v4l2.CID_BACKLIGHT_COMPENSATION,
        "Backlight Compensation",
        "Backlight Compensation",
        _INTEGER,
        0,
        1,
        1,
        1,
    ),
    Spec(
        v4l2.CID_EXPOSURE_AUTO,
        "Auto Exposure",
        "Exposure, Auto",
        _MENU,
        0,
        3,
        1,
        3,
        ((1, "Manual Mode"), (3, "Aperture Priority Mode")),
    ),
    Spec(
        v4l2.CID_EXPOSURE_ABSOLUTE,
        "Exposure Time, Absolute",
        "Exposure (Absolute)",
        _INTEGER,
        3,
        2047,
        1,
        250,
    ),
    Spec(
        v4l2.CID_EXPOSURE_AUTO_PRIORITY,
        "Exposure, Dynamic Framerate",
        "Exposure, Auto Priority",
        _BOOLEAN,
        0,
        1,
        1,
        1,
    ),
    Spec(v4l2.CID_FOCUS_ABSOLUTE, "Focus, Absolute", "Focus (absolute)", _INTEGER, 0, 250, 5, 0),
    Spec(v4l2.CID_FOCUS_AUTO, "Focus, Automatic Continuous", "Focus, Auto", _BOOLEAN, 0, 1, 1, 1),
)
#: Control -> the automatic that holds it. The gain is held by none, as in uvcvideo.
_HELD_BY = {
    v4l2.CID_EXPOSURE_ABSOLUTE: v4l2.CID_EXPOSURE_AUTO,
    v4l2.CID_WHITE_BALANCE_TEMPERATURE: v4l2.CID_AUTO_WHITE_BALANCE,
    v4l2.CID_FOCUS_ABSOLUTE: v4l2.CID_FOCUS_AUTO,
}


class FakeControls:
    """Driver and device.

    Attributes:
        specs: By id, in the order of ids.
        device: What the device does, by id: floats, moved by its automatics.
    """

    def __init__(self, quirks: Quirks) -> None:
        """Everything at its default."""
        self._quirks = quirks
        low, high, step = quirks.exposure_limits
        chosen = []
        for spec in _SPECS if quirks.controls else ():
            if spec.id == v4l2.CID_EXPOSURE_ABSOLUTE:
                default = low + (min(spec.default, high) - low) // step * step
                spec = Spec(spec.id, spec.name, spec.old_name, spec.kind, low, high, step, default)
            chosen.append(spec)
        self.specs = {spec.id: spec for spec in sorted(chosen, key=lambda spec: spec.id)}
        self._cache = {spec.id: spec.default for spec in self.specs.values()}
        self.device = {spec.id: float(spec.default) for spec in _SPECS}
        self._pending: list[tuple[int, int, int]] = []

    def name(self, spec: Spec) -> str:
        """As this kernel calls it."""
        return spec.old_name if self._quirks.old_names else spec.name

    def flags(self, identity: int) -> int:
        """CTRL_FLAG_..."""
        return v4l2.CTRL_FLAG_INACTIVE if self._inactive(identity) else 0

    def get(self, identity: int) -> int:
        """What the driver answers."""
        spec = self._spec(identity)
        automatic = _HELD_BY.get(identity)
        moving = identity == v4l2.CID_GAIN and self._cache[v4l2.CID_EXPOSURE_AUTO] != v4l2.EXPOSURE_MANUAL
        if not self._quirks.stale_cache and (moving or (automatic is not None and self._inactive(identity))):
            return round(min(max(self.device[identity], spec.minimum), spec.maximum))
        return self._cache[identity]

    def set(self, identity: int, value: int, frame: int) -> int:
        """Clamps and rounds without a word; the value shows `latency_frames` after `frame`.

        Returns:
            What was taken.

        Raises:
            OSError: EINVAL, EACCES.
        """
        spec = self._spec(identity)
        if self._inactive(identity) and self._quirks.refuses_inactive:
            raise OSError(errno.EACCES, os.strerror(errno.EACCES))
        if spec.menu and value not in dict(spec.menu):
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
        clamped = min(max(value, spec.minimum), spec.maximum)
        taken = spec.minimum + round((clamped - spec.minimum) / spec.step) * spec.step
        taken = min(taken, spec.maximum - (spec.maximum - spec.minimum) % spec.step)
        unsent = self._quirks.forgets_manual and identity in (v4l2.CID_EXPOSURE_AUTO,)
        if not (unsent and self._cache[identity] == taken):
            self._pending.append((frame + self._quirks.latency_frames, identity, taken))
        self._cache[identity] = taken
        return taken

    def meddle(self, identity: int, value: int) -> None:
        """Another program sets a control."""
        self._cache[identity] = value
        self.device[identity] = float(value)

    def stream_starts(self) -> None:
        """What was written while nothing streamed is in force; forgetful firmware is in automatic mode."""
        for _, identity, value in self._pending:
            self._take(identity, value)
        self._pending.clear()
        if self._quirks.forgets_manual:
            self.device[v4l2.CID_EXPOSURE_AUTO] = float(v4l2.EXPOSURE_APERTURE_PRIORITY)
            self.device[v4l2.CID_AUTO_WHITE_BALANCE] = 1.0

    def frame_begins(self, frame: int, interval_s: float) -> tuple[SensorState, float]:
        """What the sensor does in a frame, and the time until the next one begins, seconds."""
        due = [entry for entry in self._pending if entry[0] <= frame]
        self._pending = [entry for entry in self._pending if entry[0] > frame]
        for _, identity, value in due:
            self._take(identity, value)
        exposure = self.device[v4l2.CID_EXPOSURE_ABSOLUTE]
        if self._quirks.rolls_over_at and exposure > self._quirks.rolls_over_at:
            exposure = 0.1 * (exposure % self._quirks.rolls_over_at) + 1
        if self._quirks.ignores_exposure:
            exposure = _FIXED_EXPOSURE
        if self._may_slow_down and exposure * 1e-4 > interval_s:
            interval_s *= 2
        state = SensorState(
            exposure_s=min(exposure * 1e-4, interval_s),
            gain=self.device[v4l2.CID_GAIN],
            white_balance_k=self.device[v4l2.CID_WHITE_BALANCE_TEMPERATURE],
        )
        return state, interval_s

    def frame_ends(self, mean_light: float, interval_s: float) -> None:
        """The device's automatics look at what came out."""
        factor = (_AIM / max(mean_light, 1e-3)) ** _SPEED
        if self.device[v4l2.CID_EXPOSURE_AUTO] != v4l2.EXPOSURE_MANUAL:
            spec_low, spec_high, _ = self._quirks.exposure_limits
            longest = min(spec_high, interval_s * 1e4 * (2 if self._may_slow_down else 1))
            exposure = self.device[v4l2.CID_EXPOSURE_ABSOLUTE] * factor
            self.device[v4l2.CID_EXPOSURE_ABSOLUTE] = min(max(exposure, spec_low), longest)
            if exposure > longest or (factor < 1.0 and self.device[v4l2.CID_GAIN] > 0):
                self._turn_gain(factor)
        elif self._quirks.gain_creeps:
            self._turn_gain(factor)
        if self.device[v4l2.CID_AUTO_WHITE_BALANCE]:
            temperature = self.device[v4l2.CID_WHITE_BALANCE_TEMPERATURE]
            self.device[v4l2.CID_WHITE_BALANCE_TEMPERATURE] = temperature + 0.3 * (_ROOM_K - temperature)

    @property
    def _may_slow_down(self) -> bool:
        automatic = self.device[v4l2.CID_EXPOSURE_AUTO] != v4l2.EXPOSURE_MANUAL
        return self._quirks.slow_in_dark and automatic and bool(self.device[v4l2.CID_EXPOSURE_AUTO_PRIORITY])

    def _turn_gain(self, factor: float) -> None:
        brighter = gain_factor(self.device[v4l2.CID_GAIN]) / gain_factor(0) * factor
        self.device[v4l2.CID_GAIN] = min(max(64.0 * (brighter - 1.0), 0.0), 255.0)

    def _take(self, identity: int, value: int) -> None:
        """The device takes a value, unless one of its automatics holds it."""
        automatic = _HELD_BY.get(identity)
        if automatic is not None and not self._manual(automatic, self.device[automatic]):
            return
        self.device[identity] = float(value)

    def _inactive(self, identity: int) -> bool:
        automatic = _HELD_BY.get(identity)
        return automatic is not None and not self._manual(automatic, self._cache[automatic])

    def _manual(self, automatic: int, value: float) -> bool:
        return value == (v4l2.EXPOSURE_MANUAL if automatic == v4l2.CID_EXPOSURE_AUTO else 0)

    def _spec(self, identity: int) -> Spec:
        if identity not in self.specs:
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
        return self.specs[identity]
