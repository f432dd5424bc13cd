"""The true camera of each frame of a session, for a truth whose world the session does not share."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from capture.cameras import Camera, PosedFrame, load_posed_set
from capture.session import Session
from relight.alignment import Similarity, align_cameras, pose_errors
from relight.errors import TruthError


def true_cameras(session: Session, truth: Path) -> dict[int, Camera]:
    """Cameras of a truth's cameras.json by the session's frame indices.

    Frames belong together by the name of their picture, or, in a video, by their time.

    Raises:
        TruthError: The truth has no cameras.json.
    """
    if not (truth / "cameras.json").is_file():
        raise TruthError(
            f"{truth} has no cameras.json with the true cameras of the captured frames; without it a session "
            "whose poses were found from its frames cannot be brought into the truth's world."
        )
    posed = load_posed_set(truth / "cameras.json").frames
    by_name = {frame.camera.name: frame for frame in posed}
    named = {
        record.index: by_name[Path(record.source).stem]
        for record in session.frames
        if record.source is not None and Path(record.source).stem in by_name
    }
    matched = named or _by_time(session, posed)
    return {index: frame.camera for index, frame in matched.items()}


def align_to_truth(session: Session, truth: Path) -> tuple[Similarity, dict[str, float]]:
    """The similarity from the session's world to the truth's, and what it leaves of the poses' errors.

    Raises:
        TruthError: The truth has no cameras.
        GeometryError: Too few frames are known in both.
    """
    found, true = session.load_scene_cameras(), true_cameras(session, truth)
    similarity = align_cameras(found, true)
    errors = pose_errors(found, true, similarity)
    distances = [np.linalg.norm(camera.centre_world) for camera in true.values()]
    return similarity, {
        "cameras": float(len(errors.centre)),
        "scale": similarity.scale,
        "rotation_median_deg": float(np.median(errors.rotation_deg)),
        "rotation_worst_deg": float(errors.rotation_deg.max()),
        "centre_median": float(np.median(errors.centre)),
        "centre_worst": float(errors.centre.max()),
        "centre_median_share": float(np.median(errors.centre) / max(np.median(distances), 1e-12)),
    }


def _by_time(session: Session, posed: tuple[PosedFrame, ...]) -> dict[int, PosedFrame]:
    timed = [frame for frame in posed if frame.pts_s is not None]
    records = [record for record in session.frames if record.pts_s is not None]
    if not timed or len(records) < 2:
        return {}
    times_s = np.array([frame.pts_s for frame in timed])
    reach_s = 0.5 * float(np.median(np.diff(np.sort([float(record.pts_s or 0.0) for record in records]))))
    matched = {}
    for record in records:
        nearest = int(np.argmin(np.abs(times_s - record.pts_s)))
        if abs(times_s[nearest] - record.pts_s) <= reach_s:
            matched[record.index] = timed[nearest]
    return matched
