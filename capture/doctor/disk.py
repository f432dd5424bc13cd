"""Whether the disk takes a capture: free space, and how fast whole frames get onto it."""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from pathlib import Path

from capture.doctor.finding import Finding, Level
from capture.errors import SessionError

#: A minute of 1080p Motion-JPEG of a good webcam, thirty frames of 400 kB a second.
_MINUTE_BYTES = 60 * 30 * 400_000
_FRAME_BYTES = 400_000
_TRIAL_FRAMES = 60
_WANTED_HZ = 30.0


def look_at_disk(folder: Path) -> list[Finding]:
    """Free space of the disk that `folder` is on, and frames a second that are synced there one by one.

    Raises:
        SessionError: The folder is not there or cannot be written to.
    """
    folder = Path(folder)
    try:
        free = shutil.disk_usage(folder).free
        frames_hz = _frames_hz(folder)
    except OSError as cause:
        raise SessionError(f"{folder} cannot be written to: {cause.strerror or cause}.") from cause
    space = Finding(
        "disk",
        Level.GOOD if free > _MINUTE_BYTES + (300 << 20) else Level.BAD,
        f"{folder.resolve()} has {free / 1e9:.1f} GB free; a minute of 1080p Motion-JPEG takes about "
        f"{_MINUTE_BYTES / 1e9:.1f} GB.",
        "" if free > _MINUTE_BYTES + (300 << 20) else "Make room, or record to another disk (--out).",
    )
    enough = frames_hz >= _WANTED_HZ
    speed = Finding(
        "disk",
        Level.GOOD if enough else Level.BAD,
        f"It takes {frames_hz:.0f} frames of {_FRAME_BYTES / 1e3:.0f} kB a second, each safe on its own.",
        "" if enough else "Record to a faster disk, or lower the frame rate (--fps) or the size (--size).",
    )
    return [space, speed]


def _frames_hz(folder: Path) -> float:
    content = os.urandom(_FRAME_BYTES)
    with tempfile.TemporaryDirectory(dir=folder, prefix=".relight-doctor-") as trial:
        started_s = time.monotonic()
        for number in range(_TRIAL_FRAMES):
            with (Path(trial) / str(number)).open("wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
        return _TRIAL_FRAMES / max(time.monotonic() - started_s, 1e-6)
