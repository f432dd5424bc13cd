"""Recording from a rig into a session: every frame is safe as it comes, and tagged at the end.

While it runs, each picture and its line are on the disk before the next frame is asked for, so a
power cut costs the frame in hand. Afterwards the flash of every frame is told from the pictures;
those that are neither lit nor the sharpest of their interval lose their picture, not their line.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2

from capture.calibration_file import Quantity, write_calibration_entries
from capture.cameras import Camera
from capture.frame_record import FrameRecord
from capture.importers.options import ImportOptions, Progress
from capture.importers.video_records import select_records
from capture.ply import write_ply
from capture.rig_devices import CaptureRig, RigDescription
from capture.selection import measure_sharpness
from capture.session import Session
from capture.tagging import ProfileAccumulator, TagResult, tag


def record(rig: CaptureRig, out: Path, source: dict[str, str], progress: Progress) -> Session:
    """Records everything that the rig gives.

    Args:
        rig: Ready to record.
        out: Session folder to make.
        source: Which devices, for session.json.
        progress: Told ("record" | "tag", fraction).

    Returns:
        The session, complete. One that was interrupted has all its frames, untagged.

    Raises:
        SessionError: `out` is in use.
        TaggingError: No flash can be told from the room.
    """
    about = rig.description
    session = Session.create(
        out,
        source={"kind": "capture", **source},
        width=about.width,
        height=about.height,
        transfer=about.transfer,
        rotation_deg=about.rotation_deg,
        device=about.device,
        flash_schedule=about.flash_schedule,
    )
    profiles = ProfileAccumulator(about.width, about.height, transfer=about.transfer)
    cameras: dict[int, Camera] = {}
    with session:
        expected = 0
        for index, frame in enumerate(rig.frames()):
            luma = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
            remarks = ("dropped_before",) if frame.sequence > expected else ()
            expected = frame.sequence + 1
            session.append_frame(
                FrameRecord(
                    index=index,
                    file=session.write_frame(index, frame.rgb),
                    width=about.width,
                    height=about.height,
                    pts_s=frame.pts_s,
                    sequence=frame.sequence,
                    sharpness=float(f"{measure_sharpness(luma):.4g}"),
                    reasons=remarks,
                )
            )
            profiles.add(frame.rgb, frame.pts_s)
            if frame.camera is not None:
                cameras[index] = frame.camera
            progress("record", min(1.0, frame.pts_s / about.duration_s))
        progress("tag", 0.0)
        tags = tag(profiles.profiles())
        _keep_what_serves(session, tags)
        session.update_info(warnings=list(tags.warnings))
        _save_scene(session, about, cameras)
        progress("tag", 1.0)
    return session


def _keep_what_serves(session: Session, tags: TagResult) -> None:
    """Writes tags and selection into the log, then removes the pictures that it no longer names."""
    pictures = {record.file for record in session.frames if record.file is not None}
    tagged = [
        replace(
            record,
            file=None,
            flash=frame.flash,
            lit_fraction=frame.lit_fraction,
            confidence=frame.confidence,
            reasons=(*record.reasons, *frame.reasons),
        )
        for record, frame in zip(session.frames, tags.frames, strict=True)
    ]
    selected = select_records(tagged, {}, ImportOptions())
    session.replace_frames(selected)
    for file in pictures - {record.file for record in selected}:
        (session.path / file).unlink()


def _save_scene(session: Session, about: RigDescription, cameras: dict[int, Camera]) -> None:
    """Poses, cloud and flash position, from a rig that knows them."""
    kept = {record.index for record in session.frames if record.file is not None}
    if cameras:
        session.save_scene_cameras({index: camera for index, camera in cameras.items() if index in kept})
    if about.cloud is not None:
        session.points_path.parent.mkdir(parents=True, exist_ok=True)
        write_ply(session.points_path, about.cloud)
    if about.flash_offset_cam_m is not None:
        offset = Quantity.of(about.flash_offset_cam_m, "m", "stated by the rig")
        write_calibration_entries(session.calibration_path, {"flash_offset_cam_m": offset.to_json()})
