"""The first pass over a video: every frame is looked at, and nearly nothing of it stays in memory."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from capture.errors import SourceError
from capture.importers.options import Progress
from capture.importers.recording_parts import Recording
from capture.selection import measure_sharpness
from capture.tagging import FrameProfiles, ProfileAccumulator
from capture.video import decode_video
from capture.video.colour import full_scale_planes, luma_levels

# Tagging and sharpness look at a plane of at least so many rows and columns, averaged once for both.
_SMALL_SIDE = 480


@dataclass(frozen=True, slots=True)
class SeenFrame:
    """What is remembered of a frame after the first pass, beside its profile.

    Attributes:
        part: number of the file it is in.
        pts_s: on the capture's time axis.
        sharpness: see `capture.selection`.
        damaged: the decoder patched over missing data.
    """

    part: int
    pts_s: float
    sharpness: float
    damaged: bool


@dataclass(frozen=True, eq=False)
class Survey:
    """The first pass.

    Attributes:
        frames: all of them, in order of time.
        profiles: of the undamaged ones.
        problems: what was wrong with the files, a sentence each.
    """

    frames: list[SeenFrame]
    profiles: FrameProfiles
    problems: list[str]

    def times_of_part(self, part: int) -> NDArray[np.float64]:
        """Times of the frames of one file, seconds."""
        return np.array([frame.pts_s for frame in self.frames if frame.part == part])


def survey_recording(recording: Recording, transfer: str, progress: Progress) -> Survey:
    """Looks at every frame of a recording.

    Raises:
        SourceError: no undamaged frame.
    """
    first = recording.parts[0].video
    width, height = _small_size(first.width, first.height)
    accumulator = ProfileAccumulator(
        width,
        height,
        transfer=transfer,
        levels=luma_levels(first.colour, first.bits),
        matrix=first.colour.matrix,
    )
    frames: list[SeenFrame] = []
    problems: list[str] = []
    end_s = recording.parts[-1].end_s
    for number, part in enumerate(recording.parts):
        shift_s = part.shift_s
        if frames and shift_s + part.video.start_s <= frames[-1].pts_s:
            shift_s = frames[-1].pts_s + part.video.frame_interval_s - part.video.start_s
            problems.append(
                f"The file before {part.video.path.name} is longer than it says; this one was put behind its "
                "last frame."
            )
        for frame in decode_video(part.video, problems):
            pts_s = shift_s + frame.pts_s
            luma, blue, red = full_scale_planes(frame.picture)
            small = cv2.resize(luma, (width, height), interpolation=cv2.INTER_AREA)
            if not frame.damaged:
                accumulator.add(small, pts_s, chroma=(blue, red))
            frames.append(SeenFrame(number, pts_s, measure_sharpness(small), frame.damaged))
            progress("looking at every frame", min(pts_s / max(end_s, 1e-9), 1.0))
    if all(frame.damaged for frame in frames):
        raise SourceError(f"{first.path} holds no undamaged frame; copy it again from the phone.")
    return Survey(frames, accumulator.profiles(), problems)


def _small_size(width: int, height: int) -> tuple[int, int]:
    """Size of the plane that is looked at: a whole fraction of the picture."""
    factor = max(1, min(width, height) // _SMALL_SIDE)
    return width // factor, height // factor
