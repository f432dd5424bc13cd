"""An exposure sweep driven through a camera: exposure times in turn, and at the end the first one again."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calib.errors import ResponseError
from calib.response.groups import SweepFrame
from calib.stills import EXPOSURE_LIST
from capture.atomic import atomic_write
from capture.devices.camera import CameraDevice, CameraProfile, CapturedFrame
from capture.devices.light_check import skip_latency
from capture.devices.pixel_formats import FrameDataError, decode_rgb
from capture.errors import CameraError
from capture.images import write_png
from capture.terminal import StageProgress

_TIMEOUT_S = 2.0
_NEAR_TIMES = 1.02  # exposures that the camera rounds to nearly the same are taken once
_TRIES = 8


@dataclass(frozen=True)
class SweepPlan:
    """What to take.

    Attributes:
        shortest_s: exposure time.
        longest_s: likewise; the camera may stop short of both.
        steps: exposure times, evenly by their ratio.
        frames: pictures of each.
    """

    shortest_s: float
    longest_s: float
    steps: int
    frames: int


def drive_sweep(
    camera: CameraDevice, profile: CameraProfile, plan: SweepPlan, progress: StageProgress
) -> Iterator[SweepFrame]:
    """Locks the camera to one exposure after the other and yields the pictures; restores it at the end.

    The time of a frame is what the frame says, else what the device read back.

    Raises:
        CameraError: the camera fails, or does not take exposure times.
    """
    times = np.geomspace(plan.shortest_s, plan.longest_s, plan.steps)
    taken: list[float] = []
    try:
        # The first one again at the end: a scene or a light that changed meanwhile is seen by it.
        for number, wish in enumerate([*times, times[len(times) // 2]]):
            report = camera.lock(replace(profile, exposure_s=float(wish)))
            exposure_s = report.value("exposure_s")
            if exposure_s is None:
                raise CameraError(
                    f"{camera.info.name} does not tell its exposure time; film a sweep by hand, and give the "
                    f"pictures with an {EXPOSURE_LIST}."
                )
            again = number == len(times)
            if not again and any(1 / _NEAR_TIMES < exposure_s / other < _NEAR_TIMES for other in taken):
                continue
            taken.append(exposure_s)
            skip_latency(lambda: camera.read(_TIMEOUT_S))
            for count, frame in enumerate(_sound_frames(camera, plan.frames)):
                light_s = frame.exposure_s or exposure_s
                name = f"{1e3 * light_s:.3f} ms{' again' if again else ''}, picture {count + 1}"
                yield SweepFrame(name, light_s, decode_rgb(frame.data, camera.format))
            progress("exposure sweep", (number + 1) / (len(times) + 1))
    finally:
        camera.restore()


def keep_sweep(frames: list[SweepFrame], folder: Path) -> None:
    """Writes the pictures of a sweep and the list of their exposures, for `relight calibrate response`.

    Raises:
        ResponseError: the folder is not empty.
    """
    if folder.is_dir() and any(folder.iterdir()):
        raise ResponseError(f"{folder} is not empty; name another folder to keep the sweep in.")
    folder.mkdir(parents=True, exist_ok=True)
    rows = io.StringIO()
    table = csv.writer(rows)
    table.writerow(["picture", "exposure_s"])
    for number, frame in enumerate(frames):
        write_png(folder / f"{number:03d}.png", frame.image)
        table.writerow([f"{number:03d}.png", repr(frame.exposure_s)])
    atomic_write(folder / EXPOSURE_LIST, rows.getvalue().encode())


def _sound_frames(camera: CameraDevice, count: int) -> Iterator[CapturedFrame]:
    left = count
    for _ in range(count + _TRIES):
        frame = camera.read(_TIMEOUT_S)
        if frame.damaged:
            continue
        try:
            decode_rgb(frame.data, camera.format)
        except FrameDataError:
            continue
        yield frame
        left -= 1
        if not left:
            return
    raise CameraError(
        f"Of {count + _TRIES} frames too few were whole; use a shorter cable or a smaller picture."
    )
