"""What a camera was set to, and whether two sets of settings are the same as far as both are known.

A dark level holds for one gain, a colour matrix for one white balance, a flat field for one focus and picture
size. So each measured entry of calibration.json says what it was made with, under "made_with", and is applied
only to frames that were taken so:

    {"value": [...], "unit": "1", ..., "made_with": {"width": 1920, "height": 1080, "gain": 4.0}}

A setting that is not known on one of the two sides is no contradiction.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields
from itertools import pairwise
from statistics import median
from typing import Any

from capture.frame_record import FrameRecord
from capture.json_fields import Fields

#: What must agree for an entry to hold; entries that are not named here hold for the camera as it is.
MATTERING: Mapping[str, tuple[str, ...]] = {
    "intrinsics": ("camera", "focus"),
    "response": ("camera",),
    "dark": ("camera", "exposure_s", "gain"),
    "noise_read": ("camera", "gain", "white_balance_k"),
    "noise_shot": ("camera", "gain", "white_balance_k"),
    "flat_field": ("camera", "width", "height", "focus"),
    "colour": ("camera", "white_balance_k"),
    "room_white": ("camera", "white_balance_k"),
    "flash_strength": ("camera", "exposure_s", "gain", "white_balance_k"),
    "readout_s": ("camera", "width", "height", "rate_hz"),
}

_LONGEST_STEP_S = 1 / 12  # frames of a film; less often they are stills
_TOLERANCE = 0.02  # relative: what a read-back rounds, and less than one sees
_WORDS = {
    "camera": "the camera is {1}, not {0}",
    "width": "the frames are {1:g} pixels wide, not {0:g}",
    "height": "the frames are {1:g} pixels high, not {0:g}",
    "exposure_s": "the exposure is {1:.3g} s, not {0:.3g} s",
    "gain": "the gain is {1:.3g}, not {0:.3g}",
    "white_balance_k": "the white balance is {1:.0f} K, not {0:.0f} K",
    "focus": "the focus is {1:g}, not {0:g}",
    "rate_hz": "the camera takes {1:.4g} frames a second, not {0:.4g}",
}


@dataclass(frozen=True, kw_only=True)
class Controls:
    """Settings of a camera; None = not known, or not the same for all frames.

    Attributes:
        camera: its name, where a capture drove it.
        width: of the frames, pixels.
        height: pixels.
        exposure_s: exposure time of a row.
        gain: in the device's own units, or sensitivity over ISO 100.
        white_balance_k: colour temperature, kelvin.
        focus: in the device's own units.
        rate_hz: frames a second of a film.
    """

    camera: str | None = None
    width: int | None = None
    height: int | None = None
    exposure_s: float | None = None
    gain: float | None = None
    white_balance_k: float | None = None
    focus: float | None = None
    rate_hz: float | None = None

    def differences(self, live: Controls, names: Iterable[str]) -> list[str]:
        """Clauses on those of the named settings that are known on both sides and are not the same."""
        said = []
        for name in names:
            made, now = getattr(self, name), getattr(live, name)
            if made is not None and now is not None and not _same(made, now):
                said.append(_WORDS[name].format(made, now))
        return said

    def mattering(self, name: str) -> Controls:
        """Those that must agree for an entry of calibration.json to hold."""
        return Controls(**{field: getattr(self, field) for field in MATTERING.get(name, ())})

    def to_json(self) -> dict[str, Any]:
        """The known ones."""
        return {name: value for name, value in asdict(self).items() if value is not None}

    @classmethod
    def from_json(cls, entry: Fields) -> Controls:
        """The settings of a "made_with" entry."""
        known = {field.name for field in fields(cls)}
        if unknown := sorted(entry.values.keys() - known):
            raise entry.fail(f"the setting {unknown[0]!r} is unknown (known: {', '.join(sorted(known))}).")
        numbers = {name: entry.number(name, None) for name in known - {"camera", "width", "height"}}
        return cls(
            camera=entry.text("camera", None),
            width=entry.integer("width", None, low=1),
            height=entry.integer("height", None, low=1),
            **numbers,
        )


#: Nothing is known.
UNKNOWN = Controls()


def common_controls(several: Iterable[Controls]) -> Controls:
    """The settings that all of several have; what differs between them, or some do not tell, is None."""
    sets = list(several)
    if not sets:
        return UNKNOWN
    found = {}
    for field in fields(Controls):
        values = [getattr(one, field.name) for one in sets]
        if all(value is not None and _same(value, values[0]) for value in values):
            found[field.name] = values[0]
    return Controls(**found)


def controls_of_session(info: Mapping[str, Any], frames: Iterable[FrameRecord]) -> Controls:
    """The settings of a session: what its device read back, else what its kept frames say.

    Args:
        info: of `capture.session.Session`.
        frames: its records.
    """
    device = info.get("device") or {}
    image = info["image"]
    told = _told(device)
    records = list(frames)
    kept = [record for record in records if record.file is not None]
    by_frame = common_controls(Controls(exposure_s=record.exposure_s, gain=record.gain) for record in kept)
    exposure_s = told.get("exposure_s") if by_frame.exposure_s is None else by_frame.exposure_s
    return Controls(
        camera=_name(device),
        width=int(image["width"]),
        height=int(image["height"]),
        exposure_s=exposure_s,
        gain=told.get("gain") if by_frame.gain is None else by_frame.gain,
        white_balance_k=told.get("white_balance_k"),
        focus=told.get("focus"),
        rate_hz=_rate_of(device, records),
    )


def _told(device: Mapping[str, Any]) -> dict[str, float]:
    """What a lock read back, or a phone's settings file says."""
    told: dict[str, Any] = {"exposure_s": device.get("exposure_s")}
    if isinstance(iso := device.get("iso"), int | float):
        told["gain"] = iso / 100.0
    settings = device.get("settings")
    if isinstance(settings, Mapping) and settings.get("preference_white_balance") == "manual":
        told["white_balance_k"] = _number(settings.get("preference_white_balance_temperature"))
    controls = device.get("controls")
    for control in controls if isinstance(controls, list) else []:
        if isinstance(control, Mapping) and isinstance(name := control.get("name"), str):
            read_back = control.get("read_back")
            told[name] = control.get("requested") if read_back is None else read_back
    return {
        name: float(value)
        for name, value in told.items()
        if isinstance(value, int | float) and not isinstance(value, bool)
    }


def _rate_of(device: Mapping[str, Any], records: list[FrameRecord]) -> float | None:
    """Frames a second: by the times of neighbouring frames, else what the camera's stream promises."""
    steps_s = [
        after.pts_s - before.pts_s
        for before, after in pairwise(records)
        if before.pts_s is not None and after.pts_s is not None and after.index == before.index + 1
    ]
    if steps_s and 0 < (usual_s := median(steps_s)) <= _LONGEST_STEP_S:
        return 1.0 / usual_s
    stream = device.get("stream")
    promised = stream.get("fps") if isinstance(stream, Mapping) else None
    return float(promised) if isinstance(promised, int | float) and promised > 0 else None


def _number(text: Any) -> float | None:
    try:
        return float(text)
    except (TypeError, ValueError):
        return None


def _name(device: Mapping[str, Any]) -> str | None:
    """The name of a camera that a capture drove; other sources name the same camera in other words."""
    camera = device.get("camera")
    name = camera.get("name") if isinstance(camera, Mapping) else None
    return name if isinstance(name, str) else None


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, str) or isinstance(other, str) or isinstance(one, int):
        return bool(one == other)
    return abs(one - other) <= _TOLERANCE * max(abs(one), abs(other))
