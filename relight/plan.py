"""What a fit of a session runs and what it skips: decided beforehand, each with its reason.

A decision is one of

    run     the step is needed
    skip    the scene does not need it; the same result without
    given   the session brings the step's result
    refuse  the fit cannot be done as the session is; the reason says what to add

Where both ways are possible the decision can be forced (`FORCEABLE`). Only steps that this version has are
decided.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

import cv2
import numpy as np

from capture.cameras import Camera
from capture.frame_record import EXCLUDING_REASONS, FrameRecord
from capture.ply import PointCloud, read_ply
from capture.session import Session
from relight.errors import PlanError
from relight.view_redundancy import redundant_views

FORCEABLE = ("undistortion", "redundant_views", "room_shading")
"""Decisions that `--force NAME=run|skip` may turn round."""

NORMAL_FLASH_VIEWS = 3
"""Three light directions are what a normal needs at least (Woodham 1980); an albedo needs one."""

DARK_ROOM = 0.01
"""Room light below this share of the flash-lit radiance is under the quantisation of an 8-bit frame."""

STRAIGHT_PX = 0.1
"""Distortion that moves no pixel further than this is below what poses and points are known to."""

DARK_FRAMES = 12
"""Unlit frames that a dark room is still seen in: every part of the head is in several of them."""

_SAMPLED_FRAMES = 5  # of each kind, for the dark-room test: their mean is known to well under DARK_ROOM
_SECONDS_PER_POINT_AND_FRAME = 0.9e-6  # photometric solve on two cores, see docs/results.md
_SECONDS_PER_FRAME_PIXEL = 2.5e-7  # reading and linearising a frame


class Action(StrEnum):
    """What becomes of a step."""

    RUN = "run"
    SKIP = "skip"
    GIVEN = "given"
    REFUSE = "refuse"


@dataclass(frozen=True)
class Decision:
    """What becomes of one step, and why.

    Attributes:
        name: The step.
        action: What becomes of it.
        reason: For a person, one sentence without its full stop.
        saving: What a skip spares, where that is known.
        forced: Whether the user turned it round.
    """

    name: str
    action: Action
    reason: str
    saving: str = ""
    forced: bool = False


@dataclass(frozen=True)
class Plan:
    """The decisions for one session, and the frames that the fit will use.

    Attributes:
        decisions: In the order of the work.
        frames: Indices of the frames to fit, in capture order.
        left_out: Per frame index that is not fitted, why.
        estimated_s: Seconds that the fit should take on two cores.
    """

    decisions: tuple[Decision, ...]
    frames: tuple[int, ...]
    left_out: Mapping[int, str] = field(default_factory=dict)
    estimated_s: float = 0.0

    def decision(self, name: str) -> Decision:
        """The decision of that name."""
        return next(decision for decision in self.decisions if decision.name == name)

    def runs(self, name: str) -> bool:
        """Whether the step is done."""
        return self.decision(name).action is Action.RUN

    def check(self) -> None:
        """Does nothing for a session that can be fitted.

        Raises:
            PlanError: It cannot; the message names what is missing first.
        """
        refusals = [decision for decision in self.decisions if decision.action is Action.REFUSE]
        if refusals:
            more = f" ({len(refusals) - 1} more: see `relight plan`)" if len(refusals) > 1 else ""
            raise PlanError(f"{refusals[0].reason}{more}.")

    def as_json(self) -> dict[str, Any]:
        """For plan.json and `relight plan --json`."""
        return {
            "decisions": [
                {
                    "name": decision.name,
                    "action": decision.action.value,
                    "reason": decision.reason,
                    "saving": decision.saving,
                    "forced": decision.forced,
                }
                for decision in self.decisions
            ],
            "frames": list(self.frames),
            "left_out": {str(index): why for index, why in self.left_out.items()},
            "estimated_s": round(self.estimated_s, 1),
        }


def parse_forced(texts: list[str]) -> dict[str, Action]:
    """The meaning of `--force NAME=run|skip` options.

    Raises:
        PlanError: Not of that form, or not a decision that can be forced.
    """
    forced = {}
    for text in texts:
        name, _, action = text.partition("=")
        if name not in FORCEABLE or action not in (Action.RUN, Action.SKIP):
            names = ", ".join(FORCEABLE)
            raise PlanError(f"--force {text} must be NAME=run or NAME=skip with NAME one of {names}.")
        forced[name] = Action(action)
    return forced


def make_plan(session: Session, forced: Mapping[str, Action] | None = None) -> Plan:
    """Looks at a session and decides; nothing is written, and only a few frames are read.

    Raises:
        SessionError: A part of the session cannot be read.
    """
    forced = forced or {}
    poses = session.load_scene_cameras() if session.cameras_dir.is_dir() else {}
    cloud = read_ply(session.points_path) if session.points_path.is_file() else None
    fitted, left_out = _select(session.frames, poses)

    redundant = redundant_views(
        {record.index: poses[record.index] for record in fitted if record.index in poses},
        _centre(cloud),
    )
    views = _redundancy(redundant, len(fitted), forced)
    if views.action is Action.SKIP:
        left_out |= {index: f"same view as frame {twin}" for index, twin in redundant.items()}
        fitted = [record for record in fitted if record.index not in redundant]
    room, spare = _room_shading(session, fitted, forced)
    left_out |= {record.index: "dark" for record in spare}
    fitted = [record for record in fitted if record not in spare]

    decisions = (
        _frames(session.frames, fitted, left_out),
        _flash(session.frames, fitted),
        _poses(session.frames, poses),
        views,
        _undistortion(poses, forced),
        _cloud(cloud),
        _normals(cloud),
        _masks(session, fitted),
        room,
    )
    return Plan(
        decisions,
        tuple(record.index for record in fitted),
        dict(sorted(left_out.items())),
        _estimate(fitted, cloud),
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


def _frames(frames: list[FrameRecord], fitted: list[FrameRecord], left_out: Mapping[int, str]) -> Decision:
    counts = Counter("same view as another" if "same view" in why else why for why in left_out.values())
    without = ", ".join(f"{count} {why.replace('_', ' ')}" for why, count in counts.most_common())
    reason = f"{len(fitted)} of {len(frames)} frames" + (f"; left out: {without}" if without else "")
    return Decision("frames", Action.RUN if fitted else Action.REFUSE, reason)


def _flash(frames: list[FrameRecord], fitted: list[FrameRecord]) -> Decision:
    lit = sum(record.flash == 1 for record in fitted)
    unlit = len(fitted) - lit
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


def _poses(frames: list[FrameRecord], poses: Mapping[int, Camera]) -> Decision:
    if not poses:
        return Decision(
            "poses",
            Action.REFUSE,
            "the session has no camera poses; import with `--poses cameras.json` or from a COLMAP model "
            "(finding them by structure from motion is still to come)",
        )
    kept = sum(record.usable for record in frames)
    return Decision(
        "poses", Action.GIVEN, f"poses of {len(poses)} frames ({kept} usable)", "structure from motion"
    )


def _redundancy(redundant: Mapping[int, int], count: int, forced: Mapping[str, Action]) -> Decision:
    name = "redundant_views"
    if not redundant:
        return Decision(name, Action.RUN, "every view is its own")
    if forced.get(name) is Action.RUN:
        return Decision(name, Action.RUN, f"{len(redundant)} views are repeated, kept as told", forced=True)
    return Decision(
        name,
        Action.SKIP,
        f"{len(redundant)} of {count} views repeat one that is kept",
        f"{100 * len(redundant) / count:.0f} % of the solve",
    )


def _undistortion(poses: Mapping[int, Camera], forced: Mapping[str, Action]) -> Decision:
    name = "undistortion"
    furthest = max((_distortion_px(camera) for camera in poses.values()), default=0.0)
    moved = (
        "the lens moves no pixel" if furthest == 0 else f"the lens moves pixels by up to {furthest:.2g} px"
    )
    action = Action.RUN if furthest > STRAIGHT_PX else Action.SKIP
    if name in forced and forced[name] is not action:
        return Decision(name, forced[name], f"{moved}, forced", forced=True)
    return Decision(name, action, moved, "resampling every frame" if action is Action.SKIP else "")


def _cloud(cloud: PointCloud | None) -> Decision:
    if cloud is None:
        return Decision(
            "cloud",
            Action.REFUSE,
            "the session has no point cloud; import with `--points points.ply` "
            "(making one by dense stereo is still to come)",
        )
    return Decision("cloud", Action.GIVEN, f"{len(cloud.points):,} points", "dense stereo")


def _normals(cloud: PointCloud | None) -> Decision:
    seen = "from each point's neighbours, refined by the flash"
    if cloud is not None and cloud.normals is not None:
        seen += "; the cloud's own say which side is out"
    return Decision("normals", Action.RUN, seen)


def _masks(session: Session, fitted: list[FrameRecord]) -> Decision:
    masked = sum(session.mask_path(record.index).is_file() for record in fitted)
    if masked:
        seen = f"masks of {masked} of {len(fitted)} frames clean the cloud"
        return Decision("masks", Action.GIVEN, seen, "segmentation")
    return Decision("masks", Action.SKIP, "none given: every point of the cloud is taken for the head")


def _room_shading(
    session: Session, fitted: list[FrameRecord], forced: Mapping[str, Action]
) -> tuple[Decision, list[FrameRecord]]:
    """Whether there is a room to solve for, and the unlit frames that are not needed where there is none."""
    name = "room_shading"
    lit = [record for record in fitted if record.flash == 1]
    unlit = [record for record in fitted if record.flash == 0]
    if not lit or not unlit:
        return Decision(name, Action.RUN, "cannot be told without both kinds of frames"), []
    share = _mean_radiance(session, unlit) / max(_mean_radiance(session, lit), 1e-9)
    seen = f"the room gives {100 * share:.2g} % of the radiance of flash frames"
    action = Action.RUN if share > DARK_ROOM else Action.SKIP
    wanted = forced.get(name, action)
    if wanted is Action.RUN:
        return Decision(name, wanted, seen, forced=wanted is not action), []
    kept = {record.index for record in _evenly(unlit, max(DARK_FRAMES, len(lit)))}
    spare = [record for record in unlit if record.index not in kept]
    saving = f"{len(spare)} unlit frames that would show the dark again" if spare else ""
    return Decision(name, wanted, seen, saving, forced=wanted is not action), spare


def _mean_radiance(session: Session, records: list[FrameRecord]) -> float:
    sample = _evenly(records, _SAMPLED_FRAMES)
    return float(np.mean([session.load_radiance(record)[::8, ::8].mean() for record in sample]))


def _evenly(records: list[FrameRecord], count: int) -> list[FrameRecord]:
    """At most `count` of the records, spread over all of them."""
    picks = np.linspace(0, len(records) - 1, min(count, len(records))).round().astype(int)
    return [records[pick] for pick in picks]


def _distortion_px(camera: Camera) -> float:
    """How far the lens moves the pixel that it moves most, of those along the border and the diagonals."""
    if not camera.distortion.any():
        return 0.0
    across, down = np.linspace(0, camera.width, 33), np.linspace(0, camera.height, 33)
    pixels = np.concatenate(
        [
            np.stack([across, np.zeros(33)], 1),
            np.stack([across, np.full(33, camera.height)], 1),
            np.stack([np.zeros(33), down], 1),
            np.stack([np.full(33, camera.width), down], 1),
            np.stack([across, down], 1),
        ]
    )
    rays = (pixels - camera.K[:2, 2]) / camera.K.diagonal()[:2]
    straight = np.concatenate([rays, np.ones((len(rays), 1))], 1)
    bent, _ = cv2.projectPoints(straight, np.zeros(3), np.zeros(3), camera.K, camera.distortion)
    return float(np.linalg.norm(bent.reshape(-1, 2) - pixels, axis=1).max())


def _centre(cloud: PointCloud | None) -> np.ndarray | None:
    return None if cloud is None else np.median(cloud.points, axis=0)


def _estimate(fitted: list[FrameRecord], cloud: PointCloud | None) -> float:
    points = 0 if cloud is None else len(cloud.points)
    pixels = sum(record.width * record.height for record in fitted)
    return points * len(fitted) * _SECONDS_PER_POINT_AND_FRAME + pixels * _SECONDS_PER_FRAME_PIXEL
