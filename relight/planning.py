"""Looks at a session and decides what a fit of it runs and what it skips.

Each step has one function that returns its `Decision`; those of the geometry are in `relight.geometry_plan`.
Only steps that this version has are decided.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

import numpy as np

from capture.cameras import Camera
from capture.frame_record import EXCLUDING_REASONS, FrameRecord
from capture.ply import PointCloud, read_ply
from capture.session import Session
from relight.geometry_plan import GeometryConfig, plan_geometry
from relight.lens import distortion_px
from relight.plan import Action, Decision, Plan
from relight.stage_cache import StageCache
from relight.view_redundancy import redundant_views

NORMAL_FLASH_VIEWS = 3
"""Three light directions are what a normal needs at least (Woodham 1980); an albedo needs one."""

DARK_ROOM = 0.01
"""Room light below this share of the flash-lit radiance is under the quantisation of an 8-bit frame."""

STRAIGHT_PX = 0.1
"""Distortion that moves no pixel further than this is below what poses and points are known to."""

FEWEST_UNLIT = 12
"""Unlit frames that a dark room, or a short time, leaves: every part of the head is in several of them."""

_CALIBRATED = {
    "intrinsics": "lens",
    "response": "response",
    "dark": "dark level",
    "noise_read": "noise",
    "flat_field": "flat field",
    "colour": "colour",
    "flash_offset_cam_m": "the flash's place",
    "flash_axis": "its beam",
    "flash_falloff": "its beam",
    "flash_strength": "its strength",
}
"""Entries of a calibration that a fit uses, in words."""

Narrowing = tuple[Decision, dict[int, str]]
"""A decision that leaves frames out, and why each of them is."""

_SAMPLED_FRAMES = 5  # of each kind, for the dark-room test: their mean is known to well under DARK_ROOM

# Seconds on two idle cores, in round numbers: solve and pictures, the cloud, and each frame.
_SECONDS = 8.0
_SECONDS_PER_POINT = 3e-5
_SECONDS_PER_FRAME = 0.08
_POINTS_FOUND = 150_000  # of a cloud that is still to be found


def make_plan(
    session: Session,
    forced: Mapping[str, Action] | None = None,
    max_seconds: float | None = None,
    geometry: GeometryConfig | None = None,
) -> Plan:
    """Looks at a session and decides; nothing is written, and only a few frames are looked into.

    Args:
        session: What is to be fitted.
        forced: Decisions to turn round.
        max_seconds: Time that the fit may take; unlit frames are left out until it should do.
        geometry: How poses, cloud and masks are found where they are not given.

    Raises:
        SessionError: A part of the session cannot be read.
    """
    forced = forced or {}
    cache = StageCache(session)
    poses = session.load_scene_cameras() if cache.is_whole("poses") else {}
    cloud = read_ply(session.points_path) if cache.is_whole("cloud") else None
    found = plan_geometry(session, cache, geometry or GeometryConfig(), poses, cloud, forced)
    if found.poses.action is Action.RUN:
        poses = {}  # what lies there is out of date
    if found.cloud.action is Action.RUN:
        cloud = None
    fitted, left_out = _select(session.frames, poses)

    narrowing = []
    for decide in (
        lambda frames: _redundant_views(frames, poses, cloud, forced),
        lambda frames: _room_shading(frames, session, forced),
        lambda frames: _time(frames, cloud, max_seconds),
    ):
        decision, spare = decide(fitted)
        narrowing.append(decision)
        left_out |= spare
        fitted = [record for record in fitted if record.index not in spare]
    views, room, time = narrowing

    return Plan(
        decisions=(
            _frames(session, fitted, left_out),
            _flash(session.frames, fitted),
            found.poses,
            found.cloud,
            found.masks,
            found.scale,
            _calibration(session),
            views,
            _undistortion(poses, forced),
            _normals(cloud),
            room,
            _face_prior(forced),
            time,
        ),
        frames=tuple(record.index for record in fitted),
        left_out=dict(sorted(left_out.items())),
        estimated_s=found.estimated_s + _estimated_s(fitted, cloud),
    )


def _select(
    frames: list[FrameRecord], poses: Mapping[int, Camera]
) -> tuple[list[FrameRecord], dict[int, str]]:
    """The frames that can be fitted, and why each other one cannot."""
    fitted, left_out = [], {}
    for record in frames:
        excluding = [reason for reason in record.reasons if reason in EXCLUDING_REASONS]
        if excluding:
            left_out[record.index] = excluding[0]
        elif record.file is None:
            left_out[record.index] = "not_kept"
        elif record.flash is None:
            left_out[record.index] = "flash_unknown"
        elif record.split == "val":
            left_out[record.index] = "kept_for_validation"
        elif poses and record.index not in poses:
            left_out[record.index] = "no_pose"
        else:
            fitted.append(record)
    return fitted, left_out


def _frames(session: Session, fitted: list[FrameRecord], left_out: Mapping[int, str]) -> Decision:
    counts = Counter("same view as another" if "same view" in why else why for why in left_out.values())
    without = ", ".join(f"{count} {why.replace('_', ' ')}" for why, count in counts.most_common())
    reason = f"{len(fitted)} of {len(session.frames)} frames" + (f"; left out: {without}" if without else "")
    if (
        not fitted
        and session.info.get("source", {}).get("kind") == "capture"
        and session.status != "complete"
    ):
        reason += "; the capture is not whole, go on with it: `relight-capture --resume`"
    return Decision("frames", Action.RUN if fitted else Action.REFUSE, reason)


def _flash(frames: list[FrameRecord], fitted: list[FrameRecord]) -> Decision:
    lit, unlit = (len(records) for records in _by_flash(fitted))
    if not any(record.flash == 1 for record in frames):
        return Decision(
            "flash",
            Action.REFUSE,
            "no frame is fully lit by the flash; film with a blinking flash, or say which frames are lit "
            "with `relight import --flash-list`",
        )
    if unlit == 0:
        return Decision(
            "flash",
            Action.REFUSE,
            f"all {lit} frames are lit by the flash; frames without it are needed to tell the room apart",
        )
    seen = f"{lit} lit and {unlit} unlit frames by their tags"
    if lit < NORMAL_FLASH_VIEWS:
        seen += f"; under {NORMAL_FLASH_VIEWS} lit ones leave the normals as the cloud has them"
    return Decision("flash", Action.GIVEN, seen)


def _calibration(session: Session) -> Decision:
    """What of the calibration is applied; what is not known has a fallback, which is not named here."""
    name = "calibration"
    entries, warning = session.read_calibration()
    known = [words for entry, words in _CALIBRATED.items() if entry in entries]
    applied = ", ".join(dict.fromkeys(known))
    left_out = "" if warning is None else f"; {warning[0].lower()}{warning[1:].rstrip('.')}"
    if not known:
        return Decision(name, Action.SKIP, f"nothing is known of camera and flash{left_out}")
    return Decision(name, Action.GIVEN, f"{applied}{left_out}")


def _redundant_views(
    fitted: list[FrameRecord],
    poses: Mapping[int, Camera],
    cloud: PointCloud | None,
    forced: Mapping[str, Action],
) -> Narrowing:
    name = "redundant_views"
    centre = None if cloud is None else np.median(cloud.points, axis=0)
    cameras = {record.index: poses[record.index] for record in fitted if record.index in poses}
    redundant = redundant_views(cameras, centre)
    if not redundant:
        return Decision(name, Action.RUN, "every view is its own"), {}
    if forced.get(name) is Action.RUN:
        seen = f"{len(redundant)} views are repeated, kept as told"
        return Decision(name, Action.RUN, seen, forced=True), {}
    seen = f"{len(redundant)} of {len(fitted)} views repeat one that is kept"
    saving = f"{100 * len(redundant) / len(fitted):.0f} % of the frames"
    left_out = {index: f"same view as frame {twin}" for index, twin in redundant.items()}
    return Decision(name, Action.SKIP, seen, saving), left_out


def _undistortion(poses: Mapping[int, Camera], forced: Mapping[str, Action]) -> Decision:
    name = "undistortion"
    furthest = max((distortion_px(camera) for camera in poses.values()), default=0.0)
    moved = (
        "the lens moves no pixel" if furthest == 0 else f"the lens moves pixels by up to {furthest:.2g} px"
    )
    action = Action.RUN if furthest > STRAIGHT_PX else Action.SKIP
    if name in forced and forced[name] is not action:
        return Decision(name, forced[name], f"{moved}, forced", forced=True)
    return Decision(name, action, moved, "resampling every frame" if action is Action.SKIP else "")


def _normals(cloud: PointCloud | None) -> Decision:
    seen = "from each point's neighbours, refined by the flash"
    if cloud is not None and cloud.normals is not None:
        seen += "; the cloud's own say which side is out"
    return Decision("normals", Action.RUN, seen)


def _room_shading(fitted: list[FrameRecord], session: Session, forced: Mapping[str, Action]) -> Narrowing:
    """Whether there is a room to solve for, and the unlit frames that are not needed where there is none."""
    name = "room_shading"
    lit, unlit = _by_flash(fitted)
    if not lit or not unlit:
        return Decision(name, Action.RUN, "cannot be told without both kinds of frames"), {}
    share = _mean_radiance(session, unlit) / max(_mean_radiance(session, lit), 1e-9)
    seen = f"the room gives {100 * share:.2g} % of the radiance of flash frames"
    found = Action.RUN if share > DARK_ROOM else Action.SKIP
    action = forced.get(name, found)
    if action is Action.RUN:
        return Decision(name, action, seen, forced=action is not found), {}
    left_out = _all_but(unlit, max(FEWEST_UNLIT, len(lit)), "dark")
    saving = f"{len(left_out)} unlit frames that show the dark again" if left_out else ""
    return Decision(name, action, seen, saving, forced=action is not found), left_out


def _face_prior(forced: Mapping[str, Action]) -> Decision:
    """Whether a face is looked for; whether there is one is known when the surface is solved."""
    name = "face_prior"
    if forced.get(name) is Action.SKIP:
        return Decision(name, Action.SKIP, "not wanted", forced=True)
    return Decision(name, Action.RUN, "looked for on the solved surface; dropped where there is no face")


def _time(fitted: list[FrameRecord], cloud: PointCloud | None, max_seconds: float | None) -> Narrowing:
    """What the fit should take, and the unlit frames that a limit leaves no time for."""
    name = "time"
    estimated_s = _estimated_s(fitted, cloud)
    if max_seconds is None or estimated_s <= max_seconds:
        return Decision(name, Action.RUN, f"about {estimated_s:.0f} s on two cores"), {}
    lit, unlit = _by_flash(fitted)
    kept = len(unlit)
    while kept > FEWEST_UNLIT and _estimated_s([*lit, *unlit[:kept]], cloud) > max_seconds:
        kept -= 1
    left_out = _all_but(unlit, kept, "no_time")
    saved_s = estimated_s - _estimated_s([*lit, *unlit[:kept]], cloud)
    seen = f"about {estimated_s - saved_s:.0f} s on two cores, {max_seconds:g} s allowed"
    if not left_out:
        return Decision(name, Action.RUN, f"{seen}; there is nothing left to leave out"), {}
    return Decision(name, Action.SKIP, seen, f"{len(left_out)} unlit frames, {saved_s:.0f} s"), left_out


def _by_flash(fitted: list[FrameRecord]) -> tuple[list[FrameRecord], list[FrameRecord]]:
    """Lit and unlit frames."""
    return [record for record in fitted if record.flash == 1], [
        record for record in fitted if record.flash == 0
    ]


def _all_but(records: list[FrameRecord], count: int, why: str) -> dict[int, str]:
    """Leaves all out but some that are spread over all of them."""
    kept = {record.index for record in _evenly(records, count)}
    return {record.index: why for record in records if record.index not in kept}


def _mean_radiance(session: Session, records: list[FrameRecord]) -> float:
    sample = _evenly(records, _SAMPLED_FRAMES)
    return float(np.mean([session.load_radiance(record)[::8, ::8].mean() for record in sample]))


def _evenly(records: list[FrameRecord], count: int) -> list[FrameRecord]:
    """At most `count` of the records, spread over all of them."""
    picks = np.linspace(0, len(records) - 1, min(count, len(records))).round().astype(int)
    return [records[pick] for pick in picks]


def _estimated_s(fitted: list[FrameRecord], cloud: PointCloud | None) -> float:
    points = _POINTS_FOUND if cloud is None else len(cloud.points)
    return _SECONDS + _SECONDS_PER_POINT * points + _SECONDS_PER_FRAME * len(fitted)
