"""After the last frame: tags into the log, and which frames keep their pictures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from capture.controller.config import CaptureConfig
from capture.importers.options import ImportOptions
from capture.importers.video_records import select_records
from capture.session import FrameRecord, Session
from capture.tagging import FrameTag


def apply_tags(session: Session, tags: Mapping[int, FrameTag], config: CaptureConfig) -> None:
    """Writes tags and the choice of frames into the log, then removes the pictures that it no longer names.

    Frames without a tag here keep what the log says of them.

    Args:
        session: Open for writing.
        tags: By frame index.
        config: Of the capture.
    """
    pictures = {record.index: record.file for record in session.frames if record.file is not None}
    tagged = [_with_tag(record, tags.get(record.index)) for record in session.frames]
    if config.keep_all:
        session.replace_frames(tagged)
        return
    old = [record for record in tagged if record.index not in tags]
    new = [replace(record, file=None) for record in tagged if record.index in tags]
    selected = select_records(new, {}, ImportOptions(kept_rate_hz=config.kept_rate_hz)) if new else []
    suffixes = {index: file.rsplit(".", 1)[1] for index, file in pictures.items()}
    kept = [
        record if record.file is None else replace(record, file=_picture(record, suffixes))
        for record in selected
    ]
    session.replace_frames(sorted([*old, *kept], key=lambda record: record.index))
    named = {record.file for record in session.frames}
    for file in pictures.values():
        if file not in named:
            (session.path / file).unlink(missing_ok=True)


def _picture(record: FrameRecord, suffixes: Mapping[int, str]) -> str | None:
    suffix = suffixes.get(record.index)
    return None if suffix is None else f"frames/{record.index:06d}.{suffix}"


def _with_tag(record: FrameRecord, tag: FrameTag | None) -> FrameRecord:
    if tag is None:
        return record
    return replace(
        record,
        flash=tag.flash,
        lit_fraction=tag.lit_fraction,
        confidence=tag.confidence,
        reasons=tuple(dict.fromkeys((*record.reasons, *tag.reasons))),
    )
