"""Tagging of frames at hand: any iterable of frames, and the pictures of a session."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from capture.errors import TaggingError
from capture.frame_record import FrameRecord
from capture.session import Session
from capture.tagging.config import TaggingConfig
from capture.tagging.profiles import ProfileAccumulator
from capture.tagging.records import with_tag
from capture.tagging.result import FlashPrior, TagResult
from capture.tagging.stills import tag_stills
from capture.tagging.tagger import tag

# Frames at least so often are a video, in which pulses have edges; fewer are stills.
_VIDEO_HZ = 12.0
# Stills have no time; their order is what counts.
_STILL_INTERVAL_S = 1.0


def tag_frames(
    frames: Iterable[tuple[NDArray[np.generic], float]],
    *,
    transfer: str = "srgb",
    schedule: FlashPrior | None = None,
    config: TaggingConfig | None = None,
) -> TagResult:
    """Tag frames that come one by one.

    Args:
        frames: (picture, time) pairs in order; pictures as in `ProfileAccumulator.add`.
        transfer: of the pictures.
        schedule: see `tag`.
        config: see `tag`.

    Raises:
        TaggingError: see `tag`.
    """
    accumulator: ProfileAccumulator | None = None
    for picture, pts_s in frames:
        if accumulator is None:
            accumulator = ProfileAccumulator(
                picture.shape[1], picture.shape[0], transfer=transfer, config=config
            )
        accumulator.add(picture, pts_s)
    if accumulator is None:
        raise TaggingError("There are no frames to tag; give at least 8, with and without flash.")
    return tag(accumulator.profiles(), schedule=schedule, config=config)


def tag_session(session: Session, *, config: TaggingConfig | None = None) -> list[FrameRecord]:
    """The records of a session with the flash filled in where it was unknown; nothing is written.

    A session of a video (many frames a second, all with their pictures) is tagged as one. Stills in the
    order in which they were taken are tagged by their light against their neighbours' (`stills`).

    Raises:
        TaggingError: the classes cannot be told apart.
    """
    config = config or TaggingConfig()
    kept = [
        record for record in session.frames if record.file is not None and "unreadable" not in record.reasons
    ]
    if all(record.flash is not None for record in kept):
        return session.frames
    transfer = str(session.info["image"]["transfer"])
    first = kept[0]
    accumulator = ProfileAccumulator(first.width, first.height, transfer=transfer, config=config)
    times = np.array([np.nan if record.pts_s is None else record.pts_s for record in kept])
    video = len(kept) > 1 and bool(np.all(np.diff(times) > 0)) and np.median(np.diff(times)) <= 1 / _VIDEO_HZ
    for number, record in enumerate(kept):
        accumulator.add(
            session.load_image(record), float(times[number]) if video else _STILL_INTERVAL_S * number
        )
    profiles = accumulator.profiles()
    tags = tag(profiles, config=config).frames if video else tag_stills(profiles, config).frames
    tagged = [with_tag(record, frame) for record, frame in zip(kept, tags, strict=True)]
    known = {old.index: new if old.flash is None else old for old, new in zip(kept, tagged, strict=True)}
    return [known.get(record.index, record) for record in session.frames]
