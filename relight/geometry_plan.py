"""Decides which parts of a scene's geometry are given, kept from an earlier run, or to be found.

Poses, cloud, masks and the unit of length, in this order: what comes later depends on what comes before, so a
part that is found anew has those after it found anew too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from capture.cameras import Camera
from capture.frame_record import FrameRecord
from capture.ply import PointCloud
from capture.session import Session
from relight.face import FaceConfig
from relight.masks import MaskConfig
from relight.plan import Action, Decision
from relight.sfm import SfmConfig
from relight.stage_cache import StageCache, hash_files
from relight.stereo import StereoConfig

GEOMETRY_STAGES = ("poses", "cloud", "masks", "scale")
"""In the order of the work."""

FEWEST_POSES = 8
"""Frames under which a path around a head has no two neighbours that see the same part of it."""

_STANDING = (Action.GIVEN, Action.KEPT)  # what is built on them need not be built again

HEAD_SHARE = 0.6
"""A given cloud whose points all lie within this share of the cameras' distance holds no room."""

# Seconds on two idle cores, in round numbers (docs/results.md).
_SECONDS_PER_POSE = 0.6
_SECONDS_PER_DEPTH_MAP = 14.0  # and megapixel
_SECONDS_PER_MASK = 0.3
_SECONDS_FOR_SCALE = 5.0


@dataclass(frozen=True)
class GeometryConfig:
    """Settings of all that is found from the frames."""

    sfm: SfmConfig = field(default_factory=SfmConfig)
    stereo: StereoConfig = field(default_factory=StereoConfig)
    masks: MaskConfig = field(default_factory=MaskConfig)
    face: FaceConfig = field(default_factory=FaceConfig)


@dataclass(frozen=True, eq=False)
class GeometryPlan:
    """Decisions on poses, cloud, masks and scale.

    Attributes:
        poses: Where the cameras come from.
        cloud: Where the points come from.
        masks: Where the masks come from, or why there are none.
        scale: What the unit of length is.
    """

    poses: Decision
    cloud: Decision
    masks: Decision
    scale: Decision

    @property
    def estimated_s(self) -> float:
        """What is to be found should take this long."""
        return sum(each.estimated_s for each in (self.poses, self.cloud, self.masks, self.scale))


def candidates(frames: Sequence[FrameRecord]) -> list[FrameRecord]:
    """The frames that geometry is found in: sound, kept and tagged, and none that is kept for validation.

    Which of them a fit uses is decided later, and does not change what was found from all of them.
    """
    return [
        record for record in frames if record.usable and record.flash is not None and record.split != "val"
    ]


def stage_key(
    stage: str, cache: StageCache, config: GeometryConfig, frames: Sequence[FrameRecord]
) -> tuple[str, dict[str, Any]]:
    """Key and settings of a stage, from what the stages before it have left by now."""
    settings, inputs = {
        "poses": (asdict(config.sfm), ()),
        "cloud": (asdict(config.stereo), ("poses",)),
        "masks": (asdict(config.masks), ("poses", "cloud")),
        "scale": ({}, ("poses", "cloud", "masks")),
    }[stage]
    identities = [cache.identity(name) for name in inputs]
    if stage in ("poses", "cloud") and cache.is_given("masks"):
        identities.append(cache.identity("masks"))  # given masks help to find both
    if stage == "masks" and config.masks.u2net:
        identities.append(hash_files([Path(config.masks.u2net)]))
    return cache.key(stage, settings, frames, identities), settings


def plan_geometry(
    session: Session,
    cache: StageCache,
    config: GeometryConfig,
    poses: Mapping[int, Camera],
    cloud: PointCloud | None,
    forced: Mapping[str, Action],
) -> GeometryPlan:
    """Looks at what is there; nothing is computed.

    Args:
        session: What is to be fitted.
        cache: Of this session.
        config: How its geometry would be found.
        poses: The session's cameras, as far as there are.
        cloud: The session's points, as far as there are.
        forced: Decisions to turn round.
    """
    frames = candidates(session.frames)

    def is_current(stage: str) -> bool:
        record = cache.record(stage)
        return record is not None and record.key == stage_key(stage, cache, config, frames)[0]

    posed = _poses(session, cache, config, frames, poses, is_current("poses"))
    standing = posed.action in _STANDING
    points = _cloud(cache, config, frames, posed, cloud, standing and is_current("cloud"))
    standing = standing and points.action in _STANDING
    current = standing and is_current("masks")
    masks = _masks(session, cache, config, frames, poses, cloud, points, current, forced.get("masks"))
    standing = standing and masks.action is not Action.RUN
    return GeometryPlan(posed, points, masks, _scale(cache, posed, standing and is_current("scale")))


def _poses(
    session: Session,
    cache: StageCache,
    config: GeometryConfig,
    frames: Sequence[FrameRecord],
    poses: Mapping[int, Camera],
    current: bool,
) -> Decision:
    name = "poses"
    if poses and cache.is_given(name):
        kept = sum(record.usable for record in session.frames)
        return Decision(
            name, Action.GIVEN, f"poses of {len(poses)} frames ({kept} usable)", "structure from motion"
        )
    if current:
        return Decision(name, Action.KEPT, _found_poses(cache), "structure from motion")
    if len(frames) < FEWEST_POSES:
        return Decision(
            name,
            Action.REFUSE,
            f"{len(frames)} usable frames are too few to find the camera poses in; film for twenty seconds "
            f"while you walk around the head ({FEWEST_POSES} frames are needed at least), or import poses",
        )
    return Decision(
        name,
        Action.RUN,
        f"none given: structure from motion over {len(frames)} frames",
        estimated_s=_SECONDS_PER_POSE * len(frames),
        settings=asdict(config.sfm),
    )


def _cloud(
    cache: StageCache,
    config: GeometryConfig,
    frames: Sequence[FrameRecord],
    posed: Decision,
    cloud: PointCloud | None,
    current: bool,
) -> Decision:
    name = "cloud"
    if cloud is not None and cache.is_given(name):
        if posed.action in _STANDING:
            return Decision(name, Action.GIVEN, f"{len(cloud.points):,} points", "dense stereo")
        return Decision(
            name,
            Action.REFUSE,
            f"a cloud of {len(cloud.points):,} points is given without the poses it belongs to; import "
            "both, or neither",
        )
    if cloud is not None and current:
        found = f"{len(cloud.points):,} points found before from the same frames"
        return Decision(name, Action.KEPT, found, "dense stereo")
    maps = min(config.stereo.references, len(frames))
    pixels = max((record.width * record.height for record in frames), default=0)
    megapixels = min(pixels, config.stereo.working_px**2) / 1e6
    return Decision(
        name,
        Action.RUN,
        f"none given: multi-view stereo of the head, {maps} depth maps",
        estimated_s=_SECONDS_PER_DEPTH_MAP * maps * megapixels,
        settings=asdict(config.stereo),
    )


def _found_poses(cache: StageCache) -> str:
    record = cache.record("poses")
    assert record is not None
    registered, error = record.report.get("registered"), record.report.get("reprojection_error_px")
    seen = f"{registered} frames" if registered is not None else "poses"
    if error is not None:
        seen += f", reprojection error {error:.2g} px,"
    return f"{seen} found before from the same frames"


def _masks(
    session: Session,
    cache: StageCache,
    config: GeometryConfig,
    frames: Sequence[FrameRecord],
    poses: Mapping[int, Camera],
    cloud: PointCloud | None,
    points: Decision,
    current: bool,
    forced: Action | None,
) -> Decision:
    name = "masks"
    if cache.is_given(name):
        masked = sum(session.mask_path(record.index).is_file() for record in frames)
        return Decision(
            name, Action.GIVEN, f"masks of {masked} of {len(frames)} frames clean the cloud", "segmentation"
        )
    if forced is Action.SKIP:
        return Decision(name, Action.SKIP, "every point of the cloud is taken for the head", forced=True)
    if points.action is Action.GIVEN and forced is not Action.RUN and _is_head_alone(cloud, poses):
        reason = "none given, and the given cloud is the head alone: every point of it is taken for the head"
        return Decision(name, Action.SKIP, reason, "segmentation")
    told = forced is Action.RUN
    if current:
        return Decision(name, Action.KEPT, "found before from the same frames", "segmentation", forced=told)
    return Decision(
        name,
        Action.RUN,
        "none given: what the flash lights, held together by the cloud",
        forced=told,
        estimated_s=_SECONDS_PER_MASK * len(frames),
        settings=asdict(config.masks),
    )


def _is_head_alone(cloud: PointCloud | None, poses: Mapping[int, Camera]) -> bool:
    if cloud is None or not poses or not len(cloud.points):
        return False
    centre = np.median(cloud.points, axis=0)
    reach = float(np.quantile(np.linalg.norm(cloud.points - centre, axis=1), 0.98))
    distance = float(np.median([np.linalg.norm(camera.centre_world - centre) for camera in poses.values()]))
    return reach < HEAD_SHARE * distance


def _scale(cache: StageCache, posed: Decision, current: bool) -> Decision:
    name = "scale"
    if posed.action is Action.GIVEN:
        return Decision(name, Action.GIVEN, "lengths as the given poses have them")
    record = cache.record("poses")
    if posed.action is Action.KEPT and record is not None and record.report.get("metric"):
        return Decision(name, Action.KEPT, f"metres by {record.report.get('scale_source', 'a known length')}")
    record = cache.record(name)
    if current and record is not None:
        return Decision(name, Action.KEPT, f"metres by {record.report.get('source', 'a typical head')}")
    return Decision(
        name,
        Action.RUN,
        "from markers of known size, the flash's offset or a typical head",
        estimated_s=_SECONDS_FOR_SCALE,
    )
