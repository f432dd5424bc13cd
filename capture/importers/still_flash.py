"""The flash of pictures that do not say it: tagged from what they show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture.errors import ImageError, SourceError
from capture.images import read_image
from capture.importers.options import Progress
from capture.importers.source_frame import SourceFrame
from capture.tagging import ProfileAccumulator
from capture.tagging.stills import StillTags, tag_stills
from capture.transfer import to_display


def tag_source_frames(
    frames: Sequence[SourceFrame], transfer: str, progress: Progress
) -> tuple[list[SourceFrame], StillTags]:
    """The frames with the flash that their pictures show, in the order in which they were taken.

    Frames without a picture stay unknown.

    Raises:
        TaggingError: the pictures do not show it.
        SourceError: a picture cannot be read.
    """
    shown = [place for place, frame in enumerate(frames) if frame.picture is not None]
    width, height = frames[shown[0]].size
    accumulator = ProfileAccumulator(width, height, transfer=transfer)
    for done, place in enumerate(shown):
        accumulator.add(_display_values(frames[place], transfer), float(done))
        progress("tagging", (done + 1) / len(shown))
    result = tag_stills(accumulator.profiles())
    tagged = [replace(frame, flash=None) for frame in frames]
    for place, tag in zip(shown, result.frames, strict=True):
        tagged[place] = replace(
            tagged[place], flash=tag.flash, confidence=tag.confidence, remarks=tag.reasons
        )
    return tagged, result


def _display_values(frame: SourceFrame, transfer: str) -> NDArray[Any]:
    """A picture as the tagger takes it; linear float pictures are encoded first."""
    assert frame.picture is not None
    try:
        image = read_image(frame.picture)
    except ImageError as cause:
        raise SourceError(f"Frame {frame.index}: {cause}") from cause
    if image.dtype != np.float32:
        return image
    return np.asarray(to_display(np.clip(np.nan_to_num(image), 0.0, 1.0), transfer))
