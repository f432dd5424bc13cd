"""When a capture stops by itself, and the sentence that it says."""

from __future__ import annotations

import shutil
from collections import deque
from pathlib import Path

import numpy as np

from capture.controller.config import CaptureConfig
from capture.devices.camera import CameraDevice, ControlReport
from capture.tagging.watch import PulseStatus

#: Without a frame for so long the camera is given up.
SILENCE_S = 3.0
_LOOK_S = 1.0  # from one look at controls and disk to the next
_DRIFTED_LOOKS = 2  # in a row: a single read-back may be stale
_PULSES_WAITED_FOR = 4
_PULSES_UNREPORTED = 9  # more patience where nothing but the light tells, as with a lamp switched by hand
_LEAD_S = 2.0
_CLIPPED_S = 1.0
_CLIPPED_SHARE = 0.5  # of the picture, as `TaggingConfig.hopeless_share`
_DARK_S = 2.0
_DARK_LEVEL = 4e-4  # of linear light, 1 = white: a tenth of an 8-bit code in sRGB


class StopRules:
    """Looks at the capture as it goes; each rule gives a sentence, or None while all is well."""

    def __init__(self, config: CaptureConfig, folder: Path, fps: float) -> None:
        """Of a capture into `folder`."""
        self._config, self._folder = config, folder
        self._clipped: deque[float] = deque(maxlen=max(3, round(_CLIPPED_S * fps)))
        self._levels: deque[float] = deque(maxlen=max(3, round(_DARK_S * fps)))
        self._looked_s = float("-inf")
        self._drifted = 0

    def of_light(self, level: float, clipped: float) -> str | None:
        """After each frame.

        Args:
            level: Mean linear light, 1 = white.
            clipped: Share of the picture at white.
        """
        self._clipped.append(clipped)
        self._levels.append(level)
        if (
            len(self._clipped) == self._clipped.maxlen
            and (share := float(np.median(self._clipped))) > _CLIPPED_SHARE
        ):
            return (
                f"{share:.0%} of the picture is clipped to white, more than {_CLIPPED_SHARE:.0%}; lower the "
                "exposure (--exposure), the gain (--gain) or the room's light."
            )
        if len(self._levels) == self._levels.maxlen and max(self._levels) < _DARK_LEVEL:
            return (
                f"The picture has been black for {_DARK_S:g} s, flashes included; take off the lens cap, or "
                "raise the exposure (--exposure)."
            )
        return None

    def of_pulses(self, status: PulseStatus, recorded_s: float) -> str | None:
        """After each frame.

        Args:
            status: What is seen of the flash, and what it has reported.
            recorded_s: How long frames have been coming; counts where a flash reports nothing.
        """
        remedy = (
            "point the lamp at the subject, see that it is connected and lights up, darken the room or "
            "shorten the exposure."
        )
        if status.unseen >= _PULSES_WAITED_FOR:
            return f"The last {status.unseen} flashes are not seen in the frames; {remedy}"
        patience_s = _LEAD_S + _PULSES_UNREPORTED * self._config.period_s
        if status.expected == 0 and status.seen == 0 and recorded_s > patience_s:
            return f"No flash has been seen for {recorded_s:.0f} s; {remedy}"
        return None

    def of_devices(self, camera: CameraDevice, now_s: float) -> str | None:
        """Once a second: the camera's controls and the disk.

        Raises:
            CameraError: The camera does not answer.
        """
        if now_s < self._looked_s + _LOOK_S:
            return None
        self._looked_s = now_s
        changed = camera.check()
        self._drifted = self._drifted + 1 if changed else 0
        if self._drifted >= _DRIFTED_LOOKS:
            return (
                f"The camera's {_told(changed)} by itself or by another program; close what else uses the "
                "camera, and lock it anew by starting again."
            )
        free = shutil.disk_usage(self._folder).free
        if free < self._config.reserve_bytes:
            return (
                f"{self._folder} has {free / 1e6:.0f} MB left, less than the "
                f"{self._config.reserve_bytes / 1e6:.0f} MB that are kept free; make room and go on with "
                "--resume."
            )
        return None


def _told(changed: tuple[ControlReport, ...]) -> str:
    """ "gain went from 1 to 4 and exposure_s from ..."."""
    parts = [
        f"{control.name} went from {_number(control.requested)} to {_number(control.read_back)}"
        for control in changed
    ]
    return " and its ".join(parts)


def _number(value: float | None) -> str:
    return "unknown" if value is None else f"{value:g}"
