"""Which controls a lock touches, and to what: by id, in the order that works on real cameras.

Automatics go first, because they hold the others; a control that one of them holds refuses to be written or
forgets what was. What changes the picture beyond exposure (backlight compensation, sharpening, effects) is
neutralised, and the tone controls get the device's defaults: the same pictures, whatever the program before
us has left behind.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from capture.devices.camera import CameraProfile
from capture.devices.v4l2 import structs as v4l2
from capture.devices.v4l2.controls import Control

#: Unit of CID_EXPOSURE_ABSOLUTE.
EXPOSURE_UNIT_S = 1e-4

#: Automatics that are switched off, in order; CID_EXPOSURE_AUTO comes before them and has a menu.
AUTOMATICS = (
    v4l2.CID_EXPOSURE_AUTO_PRIORITY,  # 1 lets the camera lower its frame rate in dim rooms
    v4l2.CID_AUTOGAIN,
    v4l2.CID_ISO_SENSITIVITY_AUTO,
    v4l2.CID_AUTO_WHITE_BALANCE,
    v4l2.CID_AUTO_N_PRESET_WHITE_BALANCE,
    v4l2.CID_FOCUS_AUTO,
    v4l2.CID_HUE_AUTO,
    v4l2.CID_AUTOBRIGHTNESS,
    v4l2.CID_CHROMA_AGC,
    v4l2.CID_WIDE_DYNAMIC_RANGE,
    v4l2.CID_IMAGE_STABILIZATION,
    v4l2.CID_SCENE_MODE,
)
#: Automatics that may run for a moment to find a setting that the profile leaves open.
FINDERS: Mapping[str, tuple[int, ...]] = {
    "exposure_s": (v4l2.CID_EXPOSURE_AUTO, v4l2.CID_AUTOGAIN),
    "gain": (v4l2.CID_EXPOSURE_AUTO, v4l2.CID_AUTOGAIN),
    "white_balance_k": (v4l2.CID_AUTO_WHITE_BALANCE,),
    "focus": (v4l2.CID_FOCUS_AUTO,),
}
#: The control of a setting: the first that the device has.
SETTINGS: Mapping[str, tuple[int, ...]] = {
    "exposure_s": (v4l2.CID_EXPOSURE_ABSOLUTE,),
    "gain": (v4l2.CID_GAIN, v4l2.CID_ANALOGUE_GAIN),
    "white_balance_k": (v4l2.CID_WHITE_BALANCE_TEMPERATURE,),
    "focus": (v4l2.CID_FOCUS_ABSOLUTE,),
}
#: id -> the value that takes it out of the picture.
NEUTRAL: Mapping[int, Callable[[Control], int]] = {
    v4l2.CID_BACKLIGHT_COMPENSATION: lambda control: control.minimum,
    v4l2.CID_SHARPNESS: lambda control: control.minimum,
    v4l2.CID_COLORFX: lambda control: 0,
    v4l2.CID_BRIGHTNESS: lambda control: control.default,
    v4l2.CID_CONTRAST: lambda control: control.default,
    v4l2.CID_SATURATION: lambda control: control.default,
    v4l2.CID_HUE: lambda control: control.default,
    v4l2.CID_GAMMA: lambda control: control.default,
}
#: Menu of CID_POWER_LINE_FREQUENCY.
POWER_LINE = {0: 0, 50: 1, 60: 2}


def manual_exposure(control: Control) -> int | None:
    """The entry of CID_EXPOSURE_AUTO under which the exposure time can be set; None = there is none."""
    wanted = (v4l2.EXPOSURE_MANUAL, v4l2.EXPOSURE_SHUTTER_PRIORITY)
    return next((entry for entry in wanted if entry in control.menu), None)


def automatic_exposure(control: Control) -> int | None:
    """The entry under which the camera finds its exposure; None = there is none."""
    wanted = (v4l2.EXPOSURE_APERTURE_PRIORITY, v4l2.EXPOSURE_AUTO)
    return next((entry for entry in wanted if entry in control.menu), None)


def to_device(name: str, value: float) -> float:
    """A profile's value in the device's unit."""
    return value / EXPOSURE_UNIT_S if name == "exposure_s" else value


def from_device(name: str, value: float) -> float:
    """A device's value in the profile's unit."""
    return round(value * EXPOSURE_UNIT_S, 7) if name == "exposure_s" else float(value)


def mains_of(entry: int) -> float | None:
    """Hertz of an entry of CID_POWER_LINE_FREQUENCY; None = the camera decides."""
    return next((float(hertz) for hertz, index in POWER_LINE.items() if index == entry), None)


def without_banding(exposure_s: float, mains_hz: int | None) -> float:
    """The longest exposure up to this one that is a multiple of the mains' half period.

    Lamps on the mains flicker at twice its frequency; rows that expose for whole periods of that all see the
    same light. An exposure shorter than one period stays as it is.
    """
    if not mains_hz:
        return exposure_s
    periods = int(exposure_s * 2 * mains_hz + 1e-6)
    return periods / (2 * mains_hz) if periods else exposure_s


def own_name(control: Control) -> str:
    """The device's name of a control, as a word: "Backlight Compensation" -> "backlight_compensation"."""
    words = "".join(letter if letter.isalnum() else " " for letter in control.name.lower()).split()
    return "_".join(words) or f"control_{control.id:#x}"


def asks(profile: CameraProfile, name: str) -> float | None:
    """What a profile says of a setting."""
    value: float | None = getattr(profile, name)
    return value
