"""Finds what a session does not bring: poses, cloud, masks and the unit of length, each saved as it is found.

    scene/cameras/       poses, as a COLMAP text model
    scene/sparse.ply     the points that they were found with
    scene/dense.ply      the cloud as stereo leaves it
    scene/points.ply     the part of it that is the subject
    scene/masks/         the subject in every frame
    scene/stages.json    what was found from what, how, and how good it is (`relight.stage_cache`)

What the plan calls given or kept is not touched.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from calib.calibration import session_calibration
from capture.cameras import Camera
from capture.frame_record import FrameRecord
from capture.ply import PointCloud, read_ply, write_ply
from capture.session import Session
from relight.alignment import Similarity
from relight.cloud import spacing_and_noise
from relight.errors import GeometryError
from relight.geometry_plan import GEOMETRY_STAGES, GeometryConfig, candidates, stage_key
from relight.masks import find_masks
from relight.plan import Plan
from relight.scale import Scale, find_scale
from relight.scale_from_flash import flash_samples
from relight.scene import load_scene
from relight.sfm import find_poses
from relight.stage_cache import StageCache
from relight.stages import Progress, Stages, no_progress
from relight.stereo import DenseCloud, dense_cloud
from relight.stereo.completion import complete_with_masks

_POINTS_FOR_SCALE = 60_000  # a head's breadth needs no more, and memory goes with points times frames


def derive_scene(
    session: Session,
    plan: Plan,
    config: GeometryConfig,
    device: torch.device,
    stages: Stages,
    progress: Progress = no_progress,
) -> None:
    """Does what the plan says has to be run.

    Args:
        session: Its scene folder is written to.
        plan: Its decisions on poses, cloud, masks and scale count.
        config: How.
        device: Where tensors are computed with.
        stages: Gets times and memory.
        progress: Told (stage, fraction).

    Raises:
        GeometryError: Something cannot be found; what was found before it is kept.
    """
    cache = StageCache(session)
    finder = _Finder(session, cache, config, device, stages, progress)
    frames = candidates(session.frames)
    for stage in GEOMETRY_STAGES:
        if plan.runs(stage):
            getattr(finder, stage)(frames)


class _Finder:
    """The stages over one session, each with the key under which its result is kept."""

    def __init__(
        self,
        session: Session,
        cache: StageCache,
        config: GeometryConfig,
        device: torch.device,
        stages: Stages,
        progress: Progress,
    ) -> None:
        self._session = session
        self._cache = cache
        self._config = config
        self._device = device
        self._stages = stages
        self._progress = progress

    def poses(self, frames: Sequence[FrameRecord]) -> None:
        """Structure from motion."""
        self._forget_found_masks()
        with self._stages.stage("poses"):
            result = find_poses(self._session, frames, self._config.sfm, self._progress)
        self._cache.begin("poses")
        self._session.save_scene_cameras(result.cameras)
        write_ply(self._session.sparse_path, PointCloud(result.points_world, colors=result.colors))
        report = {**result.report, "metric": result.metric, "scale_source": result.scale_source}
        self._store("poses", frames, report, result.warnings)

    def cloud(self, frames: Sequence[FrameRecord]) -> None:
        """Multi-view stereo."""
        self._forget_found_masks()
        cameras = self._cameras(frames)
        sparse = self._session.sparse_path
        points = read_ply(sparse).points if sparse.is_file() else np.zeros((0, 3))
        with self._stages.stage("stereo"):
            result = dense_cloud(
                self._session, cameras, points, self._config.stereo, self._device, self._progress
            )
        found = PointCloud(result.points.astype(np.float64), normals=result.normals_world)
        self._cache.begin("cloud")
        write_ply(self._session.dense_path, found)
        write_ply(self._session.points_path, found)
        self._store("cloud", frames, {**result.report, "points": len(result.points)}, result.warnings)

    def masks(self, frames: Sequence[FrameRecord]) -> None:
        """Foreground of every frame; what of a found cloud is not the subject goes."""
        session, cameras = self._session, self._cameras(frames)
        given = self._cache.is_given("cloud")
        cloud = read_ply(session.points_path if given else session.dense_path)
        folder = session.scene_dir / "masks.part"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        with self._stages.stage("masks"):
            result = find_masks(
                session, cameras, cloud.points, cloud.normals, folder, self._config.masks, self._progress
            )
        self._cache.begin("masks", *(() if given else ("cloud",)))
        shutil.rmtree(session.masks_dir, ignore_errors=True)
        folder.rename(session.masks_dir)
        report = dict(result.report)
        if not given:
            report |= self._clean(cameras, cloud, result.keep)
            self._cache.moved("cloud")
        self._store("masks", frames, report, result.warnings)

    def _clean(
        self, cameras: Mapping[int, Camera], cloud: PointCloud, keep: NDArray[np.bool_]
    ) -> dict[str, int]:
        """Leaves the subject in points.ply, with what its outlines tell of where stereo saw too little."""
        if not keep.any():
            raise GeometryError(
                "No point of the cloud lies on the subject in enough frames; check that the head keeps still "
                "and fills a good part of the picture."
            )
        assert cloud.normals is not None  # of a cloud that was found
        points = cloud.points[keep].astype(np.float32)
        kept = DenseCloud(points, cloud.normals[keep], np.ones(len(points), np.float32))
        with self._stages.stage("masks"):
            whole = complete_with_masks(self._session, cameras, kept)
        write_ply(
            self._session.points_path,
            PointCloud(whole.points.astype(np.float64), normals=whole.normals_world),
        )
        return {"points_left": len(points), "points_from_outlines": len(whole.points) - len(points)}

    def scale(self, frames: Sequence[FrameRecord]) -> None:
        """Metres, for a world that has none yet."""
        poses = self._cache.record("poses")
        if poses is None or poses.report.get("metric"):
            return
        session = self._session
        with self._stages.stage("scale"):
            result = _scale_of(session, self._cameras(frames), self._progress)
        to_metres = Similarity(result.metres_per_unit, np.eye(3), np.zeros(3))
        ours = ("poses",) if self._cache.is_given("cloud") else ("poses", "cloud")
        self._cache.begin(*ours)
        every = session.load_scene_cameras()
        session.save_scene_cameras({index: to_metres.camera(camera) for index, camera in every.items()})
        for path in (session.sparse_path, session.points_path, session.dense_path):
            if path.is_file():
                cloud = read_ply(path)
                write_ply(path, replace(cloud, points=to_metres.points(cloud.points)))
        self._cache.moved(*ours)
        self._store("scale", frames, result.as_json(), ())

    def _forget_found_masks(self) -> None:
        """Takes masks away that are found anew later: poses and stereo use given ones, and only those."""
        if not self._cache.is_given("masks"):
            shutil.rmtree(self._session.masks_dir, ignore_errors=True)

    def _cameras(self, frames: Sequence[FrameRecord]) -> dict[int, Camera]:
        """Cameras of those frames that have one."""
        cameras = self._session.load_scene_cameras()
        return {record.index: cameras[record.index] for record in frames if record.index in cameras}

    def _store(
        self, stage: str, frames: Sequence[FrameRecord], report: dict[str, object], warnings: Sequence[str]
    ) -> None:
        name = "stereo" if stage == "cloud" else stage
        key, settings = stage_key(stage, self._cache, self._config, frames)
        self._cache.store(
            stage,
            key,
            settings=settings,
            report=report,
            warnings=warnings,
            seconds=self._stages.seconds.get(name, 0.0),
            peak_memory_mb=self._stages.memory_mb.get(name),
        )


def _scale_of(session: Session, cameras: Mapping[int, Camera], progress: Progress) -> Scale:
    """Metres per unit, from the cloud, what the flash adds to it, and where the flash is known to be."""
    cloud = read_ply(session.points_path)
    assert cloud.normals is not None  # of a cloud that was found
    scene = load_scene(session, frames=sorted(cameras), progress=progress)
    some = slice(None, None, -(-len(cloud.points) // _POINTS_FOR_SCALE))
    points, normals = cloud.points[some], cloud.normals[some]
    spacing, _ = spacing_and_noise(points)
    flash = flash_samples(scene, points, normals, spacing, progress)
    offset = session_calibration(session).flash_offset_cam_m
    # What the flash says is known of a few of the points; a nose needs all of them.
    _, nearest = cKDTree(flash.points).query(points, workers=-1)
    return find_scale(
        points,
        normals,
        np.repeat(flash.albedo[nearest][:, None], 3, axis=1),
        cameras,
        flash=flash,
        flash_offset_cam_m=None if offset is None else np.asarray(offset.value),
        rotation_deg=session.info["image"]["rotation_deg"],
    )
