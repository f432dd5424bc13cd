"""After the last frame: tags into the log, and which frames keep their pictures."""

from __future__ import annotations

from collections.abc import Mapping

from capture.controller.config import CaptureConfig
from capture.selection import select_records
from capture.session import Session
from capture.tagging import FrameTag
from capture.tagging.records import with_tag


def apply_tags(session: Session, tags: Mapping[int, FrameTag], config: CaptureConfig) -> None:
    """Writes tags and the choice of frames into the log, then removes the pictures that it no longer names.

    Frames without a tag here keep what the log says of them, and their pictures.

    Args:
        session: Open for writing.
        tags: By frame index.
        config: Of the capture.
    """
    tagged = {
        record.index: with_tag(record, tags[record.index])
        for record in session.frames
        if record.index in tags
    }
    if not config.keep_all:
        in_time = list(tagged.values())
        chosen = select_records(in_time, lambda record: record.file, rate_hz=config.kept_rate_hz)
        tagged = {record.index: record for record in chosen}
    before = {record.file for record in session.frames if record.file is not None}
    session.replace_frames([tagged.get(record.index, record) for record in session.frames])
    for file in before - {record.file for record in session.frames}:
        (session.path / file).unlink(missing_ok=True)
