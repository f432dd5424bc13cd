"""The session folder of a capture: made, taken up again, and given what a rig knows of its scene."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from capture.calibration_file import Quantity, read_calibration_entries, write_calibration_entries
from capture.cameras import Camera
from capture.controller.config import CaptureConfig
from capture.controller.edge_log import drop_edges_after
from capture.controller.looking import FrameLooker
from capture.controller.time_axis import RESUMED_AFTER_S
from capture.devices.camera import CameraDevice, KnowsScene, LockReport
from capture.devices.flash import FlashDevice
from capture.errors import SessionError
from capture.ply import write_ply
from capture.session import Session


def create_folder(
    out: Path, camera: CameraDevice, flash: FlashDevice, lock: LockReport, config: CaptureConfig
) -> Session:
    """A new session that says from which devices it comes and how they were locked.

    Raises:
        SessionError: `out` is in use.
        CalibrationError: The calibration that it shall carry is missing or malformed.
    """
    stream = camera.format
    given = None if config.calibration is None else read_calibration_entries(config.calibration)
    session = Session.create(
        out,
        source={"kind": "capture", "camera": camera.info.url, "flash": flash.info.url},
        width=stream.width,
        height=stream.height,
        transfer=stream.transfer,
        rotation_deg=stream.rotation_deg,
        device={
            "camera": asdict(camera.info),
            "stream": asdict(stream),
            "controls": [control.to_json() for control in lock.controls],
            "flash": {**asdict(flash.info), "capabilities": flash.capabilities.to_json()},
        },
        flash_schedule={
            "period_s": config.period_s,
            "phase_step": config.phase_step,
            "on_s": config.on_s,
            "level": config.level,
        },
    )
    if given is not None:
        entries = {name: value for name, value in given.values.items() if name not in ("schema", "version")}
        write_calibration_entries(session.calibration_path, entries)
    return session


def resume_folder(out: Path, camera: CameraDevice, looker: FrameLooker, on_s: float) -> tuple[Session, float]:
    """An interrupted capture to go on with.

    Frames that were never tagged, because the capture was killed, are looked at again, so that they are
    tagged with the new ones.

    Returns:
        The session and the time on its axis of the next frame.

    Raises:
        SessionError: It is no interrupted capture, or of other pictures than the camera gives.
    """
    session = Session.open(out)
    kind, image = session.info.get("source", {}).get("kind"), session.info["image"]
    if kind != "capture":
        raise SessionError(f"{out} was made from {kind}, not by a capture; it cannot be gone on with.")
    if session.status == "complete":
        raise SessionError(f"{out} is complete; record into another folder.")
    stream = camera.format
    was = (image["width"], image["height"], image["transfer"], image["rotation_deg"])
    now = (stream.width, stream.height, stream.transfer, stream.rotation_deg)
    if was != now:
        raise SessionError(
            f"{out} has pictures of {was[0]} x {was[1]} ({was[2]}, turned by {was[3]} degrees), the camera "
            f"gives {now[0]} x {now[1]} ({now[2]}, {now[3]} degrees); set it as before "
            "(--size), or record anew."
        )
    for record in session.frames:
        if record.file is None or record.flash is not None or record.lit_fraction is not None:
            continue
        if record.pts_s is not None and not {"unreadable", "missing_file"} & set(record.reasons):
            looker.look_again(record, _eight_bits(session.load_image(record)))
    last_s = max((record.pts_s for record in session.frames if record.pts_s is not None), default=None)
    looker.expect(drop_edges_after(session.path, -math.inf if last_s is None else last_s), on_s)
    return session, 0.0 if last_s is None else last_s + RESUMED_AFTER_S


def save_scene(session: Session, camera: CameraDevice, poses: Mapping[int, Camera]) -> None:
    """Poses, cloud and flash position, from a rig that knows them."""
    scene = camera.known_scene() if isinstance(camera, KnowsScene) else None
    if scene is None:
        return
    kept = {record.index for record in session.frames if record.file is not None}
    known = {index: pose for index, pose in poses.items() if index in kept}
    if session.cameras_dir.is_dir():
        known = {**session.load_scene_cameras(), **known}
    if known:
        session.save_scene_cameras(known)
    if scene.cloud is not None:
        session.points_path.parent.mkdir(parents=True, exist_ok=True)
        write_ply(session.points_path, scene.cloud)
    offset = Quantity.of(scene.flash_offset_cam_m, "m", "stated by the rig")
    write_calibration_entries(session.calibration_path, {"flash_offset_cam_m": offset.to_json()})


def _eight_bits(picture: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    return picture if picture.dtype == np.uint8 else (picture >> 8).astype(np.uint8)
