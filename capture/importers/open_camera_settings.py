"""Open Camera's exported settings: what they say about a capture, and what is wrong with them for relighting.

The app exports (Settings > Save settings) only what the user has ever changed, as

    <open_camera_prefs><boolean key="preference_video_flash" value="true"/> ... </open_camera_prefs>

so a missing key stands for the app's default.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

from capture.errors import SourceError
from capture.transfer import OPEN_CAMERA_PROFILES

_LARGEST_FILE = 1 << 22
_KINDS = ("boolean", "string", "int", "long", "float")
_GAMMA = re.compile(r"[1-9](?:\.\d{1,3})?")

#: Key -> the app's default. Only these are ever looked at or recorded.
_DEFAULTS = {
    "preference_camera_api": "",  # the default depends on the phone
    "preference_video_flash": "false",
    "preference_strobe_freq": "",
    "preference_iso": "auto",
    "preference_exposure_time": "33333333",
    "preference_white_balance": "auto",
    "preference_white_balance_temperature": "5000",
    "preference_video_log": "off",
    "preference_video_profile_gamma": "2.2",
    "preference_video_stabilization": "false",
    "preference_video_output_format": "preference_video_output_format_default",
    "preference_video_fps": "default",
    "preference_record_audio": "true",
    "preference_edge_mode": "default",
    "preference_noise_reduction_mode": "default",
}
_FOCUS_KEY = re.compile(r"focus_value_\w{1,8}_true")
_STILL_FOCUS = ("locked", "manual2", "infinity", "fixed")


@dataclass(frozen=True)
class CameraSettings:
    """What matters of a settings file.

    Attributes:
        values: the keys that matter, with the app's default where the file is silent.
        transfer: name of the picture profile's curve; None = the phone's own, unknown curve.
        exposure_s: exposure time when it is manual.
        iso: sensitivity when it is manual.
        flash_period_s: of the blinking flash, when it is on.
        problems: one sentence for each setting that harms the capture.
    """

    values: Mapping[str, str]
    transfer: str | None
    exposure_s: float | None
    iso: int | None
    flash_period_s: float | None
    problems: tuple[str, ...]


def read_settings(path: Path) -> CameraSettings:
    """Reads a BACKUP_OC_*.xml file.

    Raises:
        SourceError: unreadable, no XML, or not Open Camera's.
    """
    found = _read_preferences(path)
    values = {key: found.get(key, default) for key, default in _DEFAULTS.items()}
    values |= {key: value for key, value in found.items() if _FOCUS_KEY.fullmatch(key)}
    manual_exposure = values["preference_iso"] != "auto"
    exposure_ns = _whole_number(values["preference_exposure_time"])
    return CameraSettings(
        values=values,
        transfer=_profile_transfer(values),
        exposure_s=exposure_ns * 1e-9 if manual_exposure and exposure_ns else None,
        iso=_whole_number(values["preference_iso"]),
        flash_period_s=_flash_period_s(values),
        problems=tuple(_problems(values)),
    )


def _problems(values: Mapping[str, str]) -> list[str]:
    """What to change in the app, most harmful first."""
    checks = [
        (
            values["preference_video_flash"] != "true",
            'the blinking flash is off; switch "Flash while recording video" on',
        ),
        (
            values["preference_camera_api"] == "preference_camera_api_old",
            "the old camera interface is in use; choose Camera2 API, which can lock exposure and colours",
        ),
        (values["preference_iso"] == "auto", "the exposure is automatic; set ISO and exposure time by hand"),
        (
            values["preference_white_balance"] == "auto",
            "the white balance is automatic; choose manual and a temperature",
        ),
        (
            values["preference_video_stabilization"] == "true",
            "video stabilisation is on, which warps every frame; switch it off",
        ),
        (
            values["preference_video_log"] == "off",
            "no picture profile is set and the phone's own tone curve is unknown; choose sRGB, Rec709 or "
            "gamma, or calibrate the response",
        ),
        (
            values["preference_video_log"] == "gamma"
            and not _GAMMA.fullmatch(values["preference_video_profile_gamma"]),
            "the gamma of the picture profile is no number; set it again",
        ),
        (
            values["preference_record_audio"] == "true",
            "sound is recorded, for which some phones add or drop frames; switch it off",
        ),
    ]
    problems = [sentence for wrong, sentence in checks if wrong]
    moving = [
        key for key, value in values.items() if _FOCUS_KEY.fullmatch(key) and not value.endswith(_STILL_FOCUS)
    ]
    if moving:
        problems.append("the focus is automatic and may hunt at every flash; lock it")
    return problems


def _profile_transfer(values: Mapping[str, str]) -> str | None:
    profile = values["preference_video_log"]
    if profile == "gamma":
        gamma = values["preference_video_profile_gamma"]
        return f"gamma:{gamma}@64" if _GAMMA.fullmatch(gamma) else None
    return OPEN_CAMERA_PROFILES.get(profile)


def _flash_period_s(values: Mapping[str, str]) -> float | None:
    """1 s in Open Camera; OpenCamera-Sensors keeps a period in milliseconds under "strobe_freq"."""
    if values["preference_video_flash"] != "true":
        return None
    period_ms = _whole_number(values["preference_strobe_freq"])
    return period_ms * 1e-3 if period_ms else 1.0


def _whole_number(text: str) -> int | None:
    return int(text) if re.fullmatch(r"[0-9]{1,15}", text) else None


def _read_preferences(path: Path) -> dict[str, str]:
    try:
        if path.stat().st_size > _LARGEST_FILE:
            raise SourceError(f"{path} is larger than {_LARGEST_FILE >> 20} MiB, which no settings file is.")
        content = path.read_bytes()
    except OSError as error:
        raise SourceError(f"{path} cannot be read: {error.strerror}.") from error
    if b"<!" in content.replace(b"<!--", b""):
        # Entities could be made to grow without bound; the app writes none.
        raise SourceError(f"{path} declares document types or entities, which Open Camera never writes.")
    try:
        root = ElementTree.fromstring(content)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise SourceError(f"{path} is no valid XML: {error}.") from error
    if root.tag != "open_camera_prefs":
        raise SourceError(f"{path} is no settings file of Open Camera (its root is <{root.tag[:40]}>).")
    return {
        entry.attrib["key"]: entry.attrib["value"]
        for entry in root
        if entry.tag in _KINDS and {"key", "value"} <= entry.attrib.keys()
    }
