"""Tagging of frames at hand: any iterable of frames, and the pictures of a session."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from capture.errors import TaggingError
from capture.frame_record import FrameRecord
from capture.session import Session
from capture.tagging.config import TaggingConfig
from capture.tagging.profiles import FrameProfiles, ProfileAccumulator
from capture.tagging.result import FlashPrior, TagResult
from capture.tagging.split import BLOCKS, split_frames
from capture.tagging.tagger import tag

# Frames at least so often are a video, in which pulses have edges; fewer are stills.
_VIDEO_HZ = 12.0
# Stills have no time; the split gets them at this pace, which makes a still's nearest neighbours its
# reference.
_STILL_INTERVAL_S = 1 / 6
# Scores between these are neither lit nor unlit.
_UNLIT, _LIT = 0.3, 0.7
# Half of the stills may be lit: a flash and a no-flash picture from each place.
_MOST_LIT = 0.6


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
    order in which they were taken are split by their light against their neighbours'; there are no rows'
    times to see a partial flash by.

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
    tagged = (
        _tag_video(kept, accumulator.profiles(), config)
        if video
        else _tag_stills(kept, accumulator.profiles(), config)
    )
    known = {old.index: new if old.flash is None else old for old, new in zip(kept, tagged, strict=True)}
    return [known.get(record.index, record) for record in session.frames]


def _tag_video(
    records: list[FrameRecord], profiles: FrameProfiles, config: TaggingConfig
) -> list[FrameRecord]:
    return [
        replace(
            record,
            flash=frame.flash,
            lit_fraction=frame.lit_fraction,
            confidence=frame.confidence,
            reasons=tuple(dict.fromkeys((*record.reasons, *frame.reasons))),
        )
        for record, frame in zip(records, tag(profiles, config=config).frames, strict=True)
    ]


def _tag_stills(
    records: list[FrameRecord], profiles: FrameProfiles, config: TaggingConfig
) -> list[FrameRecord]:
    split = split_frames(profiles.pts_s, profiles.blocks(BLOCKS, BLOCKS), config, most_lit=_MOST_LIT)
    out = []
    for record, score in zip(records, split.score, strict=True):
        flash = 0 if score < _UNLIT else 1 if score > _LIT else None
        # distance from the middle in spreads, as odds
        confidence = 1 / (1 + float(np.exp(-min(abs(score - 0.5) / max(split.spread, 0.02), 50.0))))
        reasons = record.reasons if flash is not None else (*record.reasons, "flash_uncertain")
        lit = None if flash is None else float(flash)
        out.append(replace(record, flash=flash, lit_fraction=lit, confidence=confidence, reasons=reasons))
    return out
