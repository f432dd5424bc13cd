"""What is known of each frame of a video before its picture is written, and its flash."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from capture.cameras import PosedFrame
from capture.controls import Controls
from capture.errors import TaggingError
from capture.frame_record import FrameRecord
from capture.importers.flash_list import read_flash_list
from capture.importers.options import ImportOptions
from capture.importers.recording_parts import Recording
from capture.importers.sidecar_evidence import Evidence, FrameTimes
from capture.importers.video_survey import Survey
from capture.tagging import FlashPrior, TaggingConfig, TagResult, tag
from capture.tagging.given_readout import with_given_readout
from capture.tagging.records import with_tag

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
    first = records[0]
    live = Controls(width=first.width, height=first.height, rate_hz=1.0 / survey.profiles.interval_s)
    config = with_given_readout(TaggingConfig(), options.calibration, live)
    result = _tag_with_prior(survey, times.prior, config, warnings)
    warnings += result.warnings
    tagged = list(records)
    sound = [record.index for record in records if "unreadable" not in record.reasons]
    for index, frame in zip(sound, result.frames, strict=True):
        tagged[index] = with_tag(records[index], frame)
    return tagged, result


def _tag_with_prior(
    survey: Survey, prior: FlashPrior | None, config: TaggingConfig, warnings: list[str]
) -> TagResult:
    """Tags with a sidecar's prior; one that contradicts the pictures is left out, and a warning says so."""
    if prior is None:
        return tag(survey.profiles, config=config)
    try:
        return tag(survey.profiles, schedule=prior, config=config)
    except TaggingError as contradiction:
        result = tag(survey.profiles, config=config)
        warnings.append(f"The sidecar was left out: {contradiction}")
        return result
