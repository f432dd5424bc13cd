"""The first pass over a video: every frame is looked at, and nearly nothing of it stays in memory."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from capture.errors import SourceError
from capture.importers.options import Progress
from capture.importers.recording_parts import Recording
from capture.selection import measure_sharpness
from capture.tagging import FrameProfiles, ProfileAccumulator
from capture.video import decode_video
from capture.video.colour import Pixels, full_scale_planes, luma_levels

_SHARPNESS_SIDE = 480  # the plane on which sharpness is measured has at least so many rows and columns


@dataclass(frozen=True, slots=True)
class SeenFrame:
    """What is remembered of a frame after the first pass, beside its profile."""

    part: int
    pts_s: float
    sharpness: float
    damaged: bool


@dataclass(frozen=True, eq=False)
class Survey:
    """The first pass."""

    frames: list[SeenFrame]
    profiles: FrameProfiles  # of the undamaged frames
    problems: list[str]


def survey_recording(recording: Recording, transfer: str, progress: Progress) -> Survey:
    """Looks at every frame of a recording.

    Raises:
        SourceError: no undamaged frame, or parts that overlap.
    """
    first = recording.parts[0].video
    accumulator = ProfileAccumulator(
        first.width,
        first.height,
        transfer=transfer,
        levels=luma_levels(first.colour, first.bits),
        matrix=first.colour.matrix,
    )
    frames: list[SeenFrame] = []
    problems: list[str] = []
    end_s = recording.parts[-1].end_s
    for number, part in enumerate(recording.parts):
        last_s = frames[-1].pts_s if frames else -np.inf
        for frame in decode_video(part.video, problems):
            pts_s = part.shift_s + frame.pts_s
            if pts_s <= last_s:
                raise SourceError(
                    f"{part.video.path.name} starts before {recording.parts[number - 1].video.path.name} "
                    "ends; they are no consecutive parts of one capture."
                )
            luma, *chroma = full_scale_planes(frame.picture)
            if not frame.damaged:
                accumulator.add(luma, pts_s, chroma=(chroma[0], chroma[1]))
            frames.append(SeenFrame(number, pts_s, _sharpness(luma), frame.damaged))
            progress("looking at every frame", min(pts_s / max(end_s, 1e-9), 1.0))
    if all(frame.damaged for frame in frames):
        raise SourceError(f"{first.path} holds no undamaged frame; copy it again from the phone.")
    return Survey(frames, accumulator.profiles(), problems)


def _sharpness(luma: Pixels) -> float:
    factor = max(1, min(luma.shape) // _SHARPNESS_SIDE)
    size = (luma.shape[1] // factor, luma.shape[0] // factor)
    small: Pixels = luma if factor == 1 else cv2.resize(luma, size, interpolation=cv2.INTER_AREA)  # type: ignore[assignment]
    return measure_sharpness(small)
