"""What becomes of each frame of a video: its flash, whether it is kept, and why not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from capture.cameras import PosedFrame
from capture.errors import TaggingError
from capture.importers.flash_list import read_flash_list
from capture.importers.options import ImportOptions
from capture.importers.recording_parts import Recording
from capture.importers.sidecar_evidence import Evidence, FrameTimes
from capture.importers.video_survey import Survey
from capture.selection import Candidate, find_blurred, select_frames
from capture.session import EXCLUDING_REASONS, FrameRecord
from capture.tagging import FlashPrior, TagResult, tag

_GAP = 1.6  # of the usual frame interval, from which frames are missing before a frame


def blank_records(
    recording: Recording,
    survey: Survey,
    times: FrameTimes,
    evidence: Evidence,
    posed: Mapping[int, PosedFrame],
) -> list[FrameRecord]:
    """A record of every frame, before tagging and without pictures."""
    video = recording.parts[0].video
    pts_s = np.array([frame.pts_s for frame in survey.frames])
    steps_s = np.diff(pts_s, prepend=pts_s[0])
    usual_s = float(np.median(steps_s[1:])) if len(pts_s) > 1 else np.inf
    records = []
    for index, frame in enumerate(survey.frames):
        remarks = ("dropped_before",) if steps_s[index] > _GAP * usual_s else ()
        records.append(
            FrameRecord(
                index=index,
                file=None,
                width=video.width,
                height=video.height,
                pts_s=round(frame.pts_s, 9),
                device_timestamp_ns=times.device_ns[index],
                exposure_s=evidence.settings.exposure_s if evidence.settings else None,
                reasons=(*remarks, "unreadable") if frame.damaged else remarks,
                split=posed[index].split if index in posed else None,
                sharpness=float(f"{frame.sharpness:.4g}"),
                source=recording.parts[frame.part].video.path.name,
            )
        )
    return records


def tag_records(
    records: Sequence[FrameRecord],
    survey: Survey,
    times: FrameTimes,
    options: ImportOptions,
    warnings: list[str],
) -> tuple[list[FrameRecord], TagResult | None]:
    """The flash of every frame: from the user's list, or from the pictures, checked against the sidecars.

    Raises:
        TaggingError: the pictures show no blinking flash.
    """
    if options.flash_list is not None:
        flags = read_flash_list(options.flash_list, [f"{record.index:06d}" for record in records])
        listed = zip(records, flags, strict=True)
        return [
            replace(record, flash=flag, reasons=(*record.reasons, *(("untagged",) if flag is None else ())))
            for record, flag in listed
        ], None
    result = _tag_with_prior(survey, times.prior, warnings)
    warnings += result.warnings
    tagged = list(records)
    sound = [record.index for record in records if "unreadable" not in record.reasons]
    for index, frame in zip(sound, result.frames, strict=True):
        tagged[index] = replace(
            records[index],
            flash=frame.flash,
            lit_fraction=frame.lit_fraction,
            confidence=frame.confidence,
            reasons=tuple(dict.fromkeys((*records[index].reasons, *frame.reasons))),
        )
    return tagged, result


def _tag_with_prior(survey: Survey, prior: FlashPrior | None, warnings: list[str]) -> TagResult:
    """Tags with a sidecar's prior; one that contradicts the pictures is left out, and a warning says so."""
    if prior is None:
        return tag(survey.profiles)
    try:
        return tag(survey.profiles, schedule=prior)
    except TaggingError as contradiction:
        result = tag(survey.profiles)
        warnings.append(f"The sidecar was left out: {contradiction}")
        return result


def select_records(
    records: Sequence[FrameRecord], posed: Mapping[int, PosedFrame], options: ImportOptions
) -> list[FrameRecord]:
    """The records with the names of the pictures to keep, and with the reason where a frame is not kept."""
    candidates = [
        Candidate(
            pts_s=record.pts_s or 0.0,
            flash=None if "unreadable" in record.reasons else record.flash,
            sharpness=record.sharpness or 0.0,
            sound=EXCLUDING_REASONS.isdisjoint(record.reasons),
            posed=record.index in posed,
        )
        for record in records
    ]
    kept = select_frames(candidates, options.kept_rate_hz, options.max_frames)
    blurred = find_blurred(candidates, kept)
    selected = []
    for record in records:
        if record.index in kept:
            remark = ("blurred",) if record.index in blurred else ()
            file = f"frames/{record.index:06d}.png"
            selected.append(replace(record, file=file, reasons=(*record.reasons, *remark)))
        elif EXCLUDING_REASONS.isdisjoint(record.reasons):
            selected.append(replace(record, reasons=(*record.reasons, "not_selected")))
        else:
            selected.append(record)
    return selected
