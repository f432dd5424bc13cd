"""Tags in the lines of a session's log."""

from __future__ import annotations

from dataclasses import replace

from capture.frame_record import FrameRecord
from capture.tagging.result import FrameTag


def with_tag(record: FrameRecord, tag: FrameTag) -> FrameRecord:
    """The record with what the tag says, its remarks behind those that are there."""
    return replace(
        record,
        flash=tag.flash,
        lit_fraction=tag.lit_fraction,
        confidence=tag.confidence,
        reasons=tuple(dict.fromkeys((*record.reasons, *tag.reasons))),
    )
