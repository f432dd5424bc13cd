"""The head in a cloud: its plane of symmetry, its frame, and whether it has a face."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture.cameras import Camera
from relight.face.decision import FaceDecision, decide
from relight.face.frame import HeadFrame, head_frame
from relight.face.head_part import head_floor
from relight.face.plane import Floats, Plane
from relight.face.samples import Samples, take_samples
from relight.face.symmetry import Symmetry, find_symmetry, refine_plane
from relight.upright import upright_camera


@dataclass(frozen=True, eq=False)
class HeadFound:
    """A head's geometry as the cloud tells it.

    Attributes:
        decision: Whether it is a face's.
        symmetry: None where the cloud is too small.
        frame: None where nothing is symmetric.
        samples: The head, thinned; None where the cloud is too small.
    """

    decision: FaceDecision
    symmetry: Symmetry | None
    frame: HeadFrame | None
    samples: Samples | None


def find_head(
    points: Floats,
    normals: Floats,
    albedo: Floats | None,
    cameras: Mapping[int, Camera],
    confidence: Floats | None = None,
    rotation_deg: int = 0,
) -> HeadFound:
    """The head's plane of symmetry and frame from the cloud alone, and whether it is a face's."""
    up, towards = up_and_towards(points, cameras, rotation_deg)
    samples = take_samples(points, normals, albedo, confidence)
    if samples is None:
        return HeadFound(decide(None, None), None, None, None)
    floor = head_floor(samples.points, up, towards)
    with np.errstate(invalid="ignore"):
        kept = points @ up > floor
    samples = take_samples(
        points[kept],
        normals[kept],
        None if albedo is None else albedo[kept],
        None if confidence is None else confidence[kept],
    )
    if samples is None:
        return HeadFound(decide(None, None), None, None, None)
    symmetry = find_symmetry(samples, up)
    frame = head_frame(samples.points, samples.normals, symmetry.plane, up, towards)
    return HeadFound(decide(symmetry, frame), symmetry, frame, samples)


def up_and_towards(
    points: Floats, cameras: Mapping[int, Camera], rotation_deg: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean up of the upright cameras, and the horizontal way from the points to the cameras; [3] unit."""
    upright = [upright_camera(camera, rotation_deg) for camera in cameras.values()]
    up = -np.mean([camera.cam_from_world[1, :3] for camera in upright], axis=0)
    up /= max(float(np.linalg.norm(up)), 1e-12)
    finite = points[np.isfinite(points).all(axis=1)]
    middle = np.median(finite, axis=0) if len(finite) else np.zeros(3)
    ways = np.stack([camera.centre_world - middle for camera in upright])
    ways /= np.maximum(np.linalg.norm(ways, axis=1, keepdims=True), 1e-12)
    towards = ways.mean(axis=0)
    towards -= (towards @ up) * up
    length = float(np.linalg.norm(towards))
    if length < 0.05:  # all round the head: no side is the front; the nose will tell
        towards = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
        length = float(np.linalg.norm(towards))
    return np.asarray(up), np.asarray(towards / max(length, 1e-12))


def head_report(head: HeadFound) -> dict[str, Any]:
    """What is known of a head, in plain numbers."""
    report: dict[str, Any] = {"found": head.decision.found, "reason": head.decision.reason}
    if head.symmetry is not None:
        symmetry = head.symmetry
        report |= {
            "agreement": round(symmetry.agreement, 4),
            "overlap": round(symmetry.overlap, 4),
            "rival": round(symmetry.rival, 4),
            "sigma_deg": round(float(np.degrees(symmetry.sigma_rad)), 4),
            "sigma_offset": symmetry.sigma_offset * symmetry.radius,
        }
    if head.frame is not None:
        report |= {
            "breadth": head.frame.breadth,
            "nose_height": round(head.frame.nose_height, 4),
            "nose_tip": list(head.frame.nose_tip),
            "plane_normal": list(head.frame.plane.normal),
            "plane_offset": head.frame.plane.offset,
            "forward": list(head.frame.forward),
            "up": list(head.frame.up),
        }
    return report


def head_on_plane(
    points: Floats,
    normals: Floats,
    albedo: Floats | None,
    cameras: Mapping[int, Camera],
    plane: Plane,
    up: NDArray[np.float64],
    frames: int,
) -> HeadFound:
    """The head whose plane landmarks tell roughly: refined on the cloud where it agrees with itself."""
    samples = take_samples(points, normals, albedo)
    if samples is None:
        return HeadFound(decide(None, None), None, None, None)
    _, towards = up_and_towards(points, cameras, 0)
    floor = head_floor(samples.points, up, towards)
    with np.errstate(invalid="ignore"):
        kept = points @ up > floor
    samples = take_samples(points[kept], normals[kept], None if albedo is None else albedo[kept]) or samples
    refined = refine_plane(samples, plane)
    if np.degrees(refined.angle_to(plane)) < 5.0:
        plane = refined
    frame = head_frame(samples.points, samples.normals, plane, up, towards)
    decision = FaceDecision(True, f"a landmark model found the face in {frames} frames")
    return HeadFound(decision, None, frame, samples)
