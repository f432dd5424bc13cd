"""F tagging: which frames the flash lit, out of the pictures alone.

    accumulator = ProfileAccumulator(width, height, transfer="srgb")
    for frame, pts_s in video:
        accumulator.add(frame, pts_s)
    result = tag(accumulator.profiles())

`docs/tagging.md` tells how it works.
"""

from capture.tagging.config import TaggingConfig
from capture.tagging.expected import predicted_lit_fraction
from capture.tagging.profiles import FrameProfiles, ProfileAccumulator
from capture.tagging.result import FlashPrior, FrameTag, PriorCheck, Pulse, TagResult
from capture.tagging.sequences import tag_frames, tag_session
from capture.tagging.stream import StreamTagger
from capture.tagging.stream_summary import StreamResult
from capture.tagging.tagger import tag
from capture.tagging.watch import PulseStatus

__all__ = [
    "FlashPrior",
    "FrameProfiles",
    "FrameTag",
    "PriorCheck",
    "ProfileAccumulator",
    "Pulse",
    "PulseStatus",
    "StreamResult",
    "StreamTagger",
    "TagResult",
    "TaggingConfig",
    "predicted_lit_fraction",
    "tag",
    "tag_frames",
    "tag_session",
]
