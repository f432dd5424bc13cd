"""F tagging: which frames the flash lit, out of the pictures alone.

    accumulator = ProfileAccumulator(width, height, transfer="srgb")
    for frame, pts_s in video:
        accumulator.add(frame, pts_s)
    result = tag(accumulator.profiles())

`docs/tagging.md` tells how it works.
"""

from capture.tagging.config import TaggingConfig
from capture.tagging.profiles import FrameProfiles, ProfileAccumulator
from capture.tagging.result import FlashPrior, FrameTag, PriorCheck, Pulse, TagResult
from capture.tagging.sequences import tag_frames, tag_session
from capture.tagging.tagger import tag

__all__ = [
    "FlashPrior",
    "FrameProfiles",
    "FrameTag",
    "PriorCheck",
    "ProfileAccumulator",
    "Pulse",
    "TagResult",
    "TaggingConfig",
    "tag",
    "tag_frames",
    "tag_session",
]
