"""Import of videos: every frame is looked at and tagged, the useful ones are kept as pictures.

Two passes over the files, each streaming, so that memory does not grow with the length of the capture:

1. look: decode at full rate, keep a thumbnail's worth of every frame for tagging and one number of sharpness;
   then tag the flash and choose the frames to keep;
2. write: decode again and write the chosen frames as PNG, and a line for every frame.

Frames are numbered through all parts of the capture, kept or not. Nothing is written before the second pass.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from capture.errors import SessionError, SourceError
from capture.importers.options import ImportOptions, Progress, no_progress
from capture.importers.recording_parts import Recording, open_recording
from capture.importers.sidecar_evidence import Evidence, FrameTimes, gather_evidence, tie_frame_times
from capture.importers.video_frames import write_frames
from capture.importers.video_records import blank_records, tag_records
from capture.importers.video_scene import VideoScene, match_poses, read_video_scene, save_video_scene
from capture.importers.video_survey import survey_recording
from capture.selection import select_records
from capture.session import Session
from capture.tagging import TagResult
from capture.transfer import canonical_transfer

logger = logging.getLogger(__name__)


def import_videos(
    sources: Sequence[Path],
    out: Path,
    options: ImportOptions,
    progress: Progress | None = None,
    *,
    join_split: bool = True,
) -> Session:
    """Makes a session of the videos of one capture.

    Args:
        sources: the files of the capture; the continuation of a single one is found (`recording_parts`).
        out: session folder to make; one that an interrupted import of the same source left is completed.
        options: what the files do not say.
        progress: is told what is done and how much of it.
        join_split: whether to look for the continuation of a single file.

    Raises:
        SourceError: a file that cannot be used.
        TaggingError: no flash can be told from the room.
        SessionError: `out` is in use.
    """
    progress = progress or no_progress
    out = Path(out)
    _check_options(options)
    recording = open_recording([Path(source) for source in sources], join_split=join_split)
    video = recording.parts[0].video
    scene = read_video_scene(options, video)
    evidence = gather_evidence(recording)
    source = _describe_source(recording, evidence, options)
    resumed = _open_interrupted(out, source)
    transfer, transfer_warnings = _choose_transfer(recording, evidence, scene, options)

    survey = survey_recording(recording, transfer, progress)
    pts_of_parts = [survey.times_of_part(number) for number in range(len(recording.parts))]
    times = tie_frame_times(recording, evidence, pts_of_parts)
    warnings = [
        *recording.warnings,
        *transfer_warnings,
        *evidence.warnings,
        *survey.problems,
        *times.warnings,
    ]
    posed = match_poses(scene, np.concatenate(pts_of_parts), warnings)
    progress("tagging", 0.0)
    records = blank_records(recording, survey, times, evidence, posed)
    records, tags = tag_records(records, survey, times, options, warnings)
    records = select_records(
        records,
        lambda record: f"frames/{record.index:06d}.png",
        rate_hz=options.kept_rate_hz,
        max_frames=options.max_frames,
        posed=posed,
    )
    progress("tagging", 1.0)

    session = resumed or Session.create(
        out,
        source=source,
        width=video.width,
        height=video.height,
        transfer=transfer,
        rotation_deg=video.rotation_deg,
        device={**video.device, **evidence.controls} or None,
        flash_schedule=evidence.flash_schedule,
    )
    with session:
        session.update_info(warnings=warnings, tagging=_describe_tags(tags, times) if tags else None)
        write_frames(session, recording, records, progress)
        kept = [record.index for record in records if record.file is not None]
        save_video_scene(scene, posed, kept, session)
        session.finish()
    return session


def _check_options(options: ImportOptions) -> None:
    if options.masks is not None:
        raise SourceError("--masks is for image sets; give a video's masks to the session after the import.")
    if not 0 < options.kept_rate_hz < math.inf:
        raise SourceError(
            f"{options.kept_rate_hz:g} frames a second cannot be kept; give a positive --rate, as 6."
        )
    if options.max_frames is not None and options.max_frames < 2:
        raise SourceError(
            f"At most {options.max_frames} frames are too few; one lit and one unlit are needed."
        )


def _open_interrupted(out: Path, source: dict[str, Any]) -> Session | None:
    """The session that an interrupted import of the same source left; None where there is nothing yet.

    Raises:
        SessionError: something else is there.
    """
    if not out.exists():
        return None
    if out.is_dir() and not any(out.iterdir()):
        return None
    if (out / "session.json").is_file():
        session = Session.open(out)
        if session.status == "interrupted" and session.info["source"] == source:
            logger.info("%s is completed; %d of its frames are there.", out, len(session.frames))
            return session
        raise SessionError(f"{out} holds a session already; name another folder with --out, or remove it.")
    raise SessionError(f"{out} exists already and is no empty folder; name another one with --out.")


def _choose_transfer(
    recording: Recording, evidence: Evidence, scene: VideoScene, options: ImportOptions
) -> tuple[str, list[str]]:
    """The curve of the pictures: the user's word, else the app's profile, else the stream's tag.

    The app's profile replaces the phone's tone curve, of which the tag knows nothing: phones tag BT.709 in
    any case.
    """
    colour = recording.parts[0].video.colour
    profile = evidence.settings.transfer if evidence.settings else None
    warnings = list(colour.warnings)
    if options.transfer is not None:
        chosen = canonical_transfer(options.transfer)
    elif profile is not None:
        chosen = profile
    else:
        chosen = colour.transfer
    if scene.poses is not None and scene.poses.transfer != chosen:
        warnings.append(
            f"The poses file says that its pictures have the transfer {scene.poses.transfer}; the video is "
            f"read with {chosen}."
        )
    return chosen, warnings


def _describe_source(recording: Recording, evidence: Evidence, options: ImportOptions) -> dict[str, Any]:
    """What session.json says of the source. Where it was filmed is said only when the user asks for it."""
    video = recording.parts[0].video
    colour = video.colour
    clock_texts = [subtitles.clock_text for subtitles in evidence.subtitles if subtitles is not None]
    source: dict[str, Any] = {
        "kind": "video",
        "files": [
            {"name": part.video.path.name, "bytes": part.video.path.stat().st_size, "shift_s": part.shift_s}
            for part in recording.parts
        ],
        "codec": video.codec,
        "bits": video.bits,
        "matrix": colour.matrix,
        "range": colour.color_range,
        "transfer_tag": colour.transfer,
        "primaries": colour.primaries,
        "started": recording.started.isoformat() if recording.started else None,
        "started_text": clock_texts[0] if clock_texts else None,
        "ended_utc": recording.ended.isoformat() if recording.ended else None,
        "sidecars": list(evidence.files),
        "kept_rate_hz": options.kept_rate_hz,
        "max_frames": options.max_frames,
    }
    if options.keep_location:
        places = [part.video.location for part in recording.parts]
        places += [subtitles.place_text for subtitles in evidence.subtitles if subtitles is not None]
        source["location"] = [place for place in places if place]
    return source


def _describe_tags(tags: TagResult, times: FrameTimes) -> dict[str, Any]:
    """What session.json says of the flash and the shutter as the pictures show them."""
    numbers = (
        "period_s",
        "period_sigma_s",
        "jitter_s",
        "readout_s",
        "readout_sigma_s",
        "exposure_s",
        "exposure_sigma_s",
        "flicker_hz",
        "flicker_depth",
    )
    pulse_numbers = ("t_on_s", "t_off_s", "t_on_sigma_s", "t_off_sigma_s", "gain")
    prior = None
    if times.prior is not None and tags.prior is not None:
        prior = {
            "source": times.prior.source,
            "offset_s": tags.prior.offset_s,
            "jitter_s": tags.prior.jitter_s,
            "matched": tags.prior.matched,
        }
    return {
        **{name: getattr(tags, name) for name in numbers},
        "missed_s": list(tags.missed_s),
        "prior": prior,
        "pulses": [{name: getattr(pulse, name) for name in pulse_numbers} for pulse in tags.pulses],
    }
