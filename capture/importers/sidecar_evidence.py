"""What the sidecars of a recording say about it, checked against its videos.

A sidecar is help, not truth: one that is damaged or contradicts the video is left out, and a warning says so.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from capture.errors import SourceError
from capture.importers.open_camera_settings import CameraSettings, read_settings
from capture.importers.recording_parts import Recording
from capture.importers.sidecars import (
    Subtitles,
    find_sidecars,
    read_clock_log,
    read_subtitles,
    tie_frame_clock,
)
from capture.tagging import FlashPrior

_ON_S = 0.1  # how long Open Camera and OpenCamera-Sensors leave the torch on
_SUBTITLE_SLACK_S = 2.0  # cues are a second long and the last may outlast the video

_Content = TypeVar("_Content")


@dataclass(frozen=True, eq=False)
class Evidence:
    """The readable sidecars of a recording; lists have one entry a part, None = that part has none.

    Attributes:
        files: names of those that are used.
        settings: of the app.
        subtitles: date, time and place.
        frame_logs_ns: clock of each frame.
        flash_logs_ns: clock of each torch-on command.
        warnings: a sentence for each that is not used, and for each setting that harms the capture.
    """

    files: tuple[str, ...]
    settings: CameraSettings | None
    subtitles: tuple[Subtitles | None, ...]
    frame_logs_ns: tuple[NDArray[np.int64] | None, ...]
    flash_logs_ns: tuple[NDArray[np.int64] | None, ...]
    warnings: tuple[str, ...]

    @property
    def flash_schedule(self) -> dict[str, Any] | None:
        """What the flash was asked to do, for session.json; None = not known."""
        period_s = self.settings.flash_period_s if self.settings else None
        if period_s is None and all(log is None for log in self.flash_logs_ns):
            return None
        return {"kind": "open_camera", "period_s": period_s, "on_s": _ON_S}

    @property
    def controls(self) -> dict[str, Any]:
        """The camera's locked controls by the settings file, for session.json."""
        if self.settings is None:
            return {}
        return {
            "exposure_s": self.settings.exposure_s,
            "iso": self.settings.iso,
            "settings": dict(self.settings.values),
        }


@dataclass(frozen=True, eq=False)
class FrameTimes:
    """What the clock logs say of the frames.

    Attributes:
        device_ns: clock of each frame of the recording; None where it is not known.
        prior: when the flash was asked to be on; None = not known.
        warnings: what did not fit.
    """

    device_ns: tuple[int | None, ...]
    prior: FlashPrior | None
    warnings: tuple[str, ...]


def gather_evidence(recording: Recording) -> Evidence:
    """Reads all sidecars of a recording."""
    used: list[str] = []
    warnings: list[str] = []

    def read(path: Path | None, reader: Callable[[Path], _Content]) -> _Content | None:
        if path is None:
            return None
        try:
            content = reader(path)
        except SourceError as error:
            warnings.append(f"The sidecar was left out: {error}")
            return None
        used.append(path.name)
        return content

    found = [find_sidecars(part.video.path) for part in recording.parts]
    settings_file = found[0].settings
    settings = read(settings_file, read_settings)
    if settings is not None and settings_file is not None:
        warnings += [f"By the settings {settings_file.name}, {problem}." for problem in settings.problems]
    subtitles = tuple(read(files.subtitles, read_subtitles) for files in found)
    frame_logs_ns = tuple(read(files.frame_times, read_clock_log) for files in found)
    flash_logs_ns = tuple(read(files.flash_times, read_clock_log) for files in found)
    for part, text in zip(recording.parts, subtitles, strict=True):
        video = part.video
        if text is not None and text.end_s > video.start_s + video.duration_s + _SUBTITLE_SLACK_S:
            warnings.append(
                f"{video.path.stem}.srt is {text.end_s:.0f} s long and {video.path.name} "
                f"{video.duration_s:.0f} s: the video was cut, or they do not belong together."
            )
    return Evidence(tuple(used), settings, subtitles, frame_logs_ns, flash_logs_ns, tuple(warnings))


def tie_frame_times(
    recording: Recording, evidence: Evidence, pts_s: Sequence[NDArray[np.float64]]
) -> FrameTimes:
    """Ties the clock logs to the frames.

    Args:
        recording: the videos.
        evidence: of `gather_evidence`.
        pts_s: times of the frames of each part, on the capture's time axis.
    """
    device_ns: list[int | None] = []
    flash_times_s: list[float] = []
    sources: list[str] = []
    warnings: list[str] = []
    for part, times_s, frame_log, flash_log in zip(
        recording.parts, pts_s, evidence.frame_logs_ns, evidence.flash_logs_ns, strict=True
    ):
        name = part.video.path.name
        clock = tie_frame_clock(frame_log, times_s) if frame_log is not None else None
        device_ns += clock.frame_ns if clock is not None else [None] * len(times_s)
        if frame_log is not None and clock is None:
            warnings.append(
                f"The frame times logged for {name} ({len(frame_log)} lines) contradict its own "
                f"({len(times_s)} frames); the log was left out."
            )
        if flash_log is None or not len(times_s):
            continue
        if clock is not None:
            asked_s = clock.pts_of(flash_log)
            sources.append("flash log")
        else:
            # Without a common clock only the rhythm is known; the app's first pulse comes when recording
            # starts.
            asked_s = (flash_log - flash_log[0]) * 1e-9 + times_s[0]
            sources.append("flash log of unknown offset")
        inside = asked_s[(asked_s > times_s[0] - 1.0) & (asked_s < times_s[-1] + 1.0)]
        if len(inside) < len(asked_s):
            warnings.append(
                f"{len(asked_s) - len(inside)} of {len(asked_s)} flashes logged for {name} lie outside of it."
            )
        flash_times_s += inside.tolist()
    prior = None
    if flash_times_s:
        prior = FlashPrior(tuple(sorted(flash_times_s)), _ON_S, ", ".join(sorted(set(sources))))
    return FrameTimes(tuple(device_ns), prior, tuple(warnings))
