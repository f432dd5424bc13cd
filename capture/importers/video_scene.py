"""What a scene brings along with its video: poses by time, points, and where the flash sits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from capture.calibration_file import Quantity, write_calibration_entries
from capture.cameras import PosedFrame, PosedSet, load_posed_set
from capture.errors import SourceError
from capture.importers.options import ImportOptions
from capture.ply import PointCloud, read_ply, write_ply
from capture.session import Session
from capture.video import VideoInfo


@dataclass(frozen=True, eq=False)
class VideoScene:
    """Poses and points that the user gave; None = not given."""

    poses: PosedSet | None
    cloud: PointCloud | None


def read_video_scene(options: ImportOptions, video: VideoInfo) -> VideoScene:
    """Reads and checks what the options name, before the long work starts.

    Raises:
        SourceError: malformed, without times, or of another picture size.
    """
    poses = load_posed_set(options.poses) if options.poses is not None else None
    if poses is not None:
        timed = [frame for frame in poses.frames if frame.pts_s is not None]
        if not timed:
            raise SourceError(
                f"{options.poses} gives no pts_s to any frame; poses of a video need the time of their frame."
            )
        for frame in timed:
            size = (frame.camera.width, frame.camera.height)
            if size != (video.width, video.height):
                raise SourceError(
                    f"{options.poses}: the camera of frame {frame.index} is {size[0]} x {size[1]} pixels, "
                    f"the video {video.width} x {video.height}; give the poses of the pictures as they are "
                    "stored, unrotated."
                )
        if poses.flash_offset_cam_m is not None and poses.units != "metres":
            raise SourceError(
                f"{options.poses}: a flash position needs poses in metres, not arbitrary units."
            )
    cloud = read_ply(options.points) if options.points is not None else None
    return VideoScene(poses, cloud)


def match_poses(scene: VideoScene, pts_s: NDArray[np.float64], warnings: list[str]) -> dict[int, PosedFrame]:
    """The pose of each frame that has one, by the frame's place in `pts_s`.

    A pose belongs to the frame next to it in time, within half of the usual frame interval.

    Raises:
        SourceError: no pose belongs to any frame.
    """
    if scene.poses is None:
        return {}
    timed = [frame for frame in scene.poses.frames if frame.pts_s is not None]
    times_s = np.array([frame.pts_s for frame in timed])
    reach_s = 0.5 * float(np.median(np.diff(pts_s))) if len(pts_s) > 1 else np.inf
    nearest = np.searchsorted(0.5 * (pts_s[1:] + pts_s[:-1]), times_s)
    distance_s = np.abs(pts_s[nearest] - times_s)
    matched: dict[int, PosedFrame] = {}
    for entry in np.argsort(distance_s, kind="stable"):
        if distance_s[entry] <= reach_s:
            matched.setdefault(int(nearest[entry]), timed[entry])
    if not matched:
        raise SourceError(
            f"None of the {len(timed)} poses ({times_s.min():.3f} to {times_s.max():.3f} s) belongs to a "
            f"frame of the video ({pts_s[0]:.3f} to {pts_s[-1]:.3f} s); give the video's own times as pts_s."
        )
    if len(matched) < len(timed):
        warnings.append(f"{len(timed) - len(matched)} of {len(timed)} poses belong to no frame of the video.")
    return matched


def save_video_scene(
    scene: VideoScene, matched: dict[int, PosedFrame], kept: Sequence[int], session: Session
) -> None:
    """Writes poses of the kept frames, points and the flash position into a session."""
    cameras = {index: matched[index].camera for index in kept if index in matched}
    if cameras:
        session.save_scene_cameras(cameras)
    if scene.cloud is not None:
        session.points_path.parent.mkdir(parents=True, exist_ok=True)
        write_ply(session.points_path, scene.cloud)
    if scene.poses is not None and scene.poses.flash_offset_cam_m is not None:
        source = f"stated by the cameras.json of {scene.poses.name!r}"
        offset = Quantity.of(scene.poses.flash_offset_cam_m, "m", source)
        write_calibration_entries(session.calibration_path, {"flash_offset_cam_m": offset.to_json()})
