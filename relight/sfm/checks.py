"""Whether a reconstruction can be believed: what a wrong one would show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from relight.sfm.matching import Pair
from relight.sfm.sparse import Sparse
from relight.sfm.survey import Look
from relight.sfm.world import look_point

Floats = NDArray[np.float64]

MOST_ERROR_PX = 1.5
LEAST_POINTS = 60
LEAST_TRACK = 2.5
LEAST_ANGLE_DEG = 1.5
LEAST_FAN_DEG = 8.0  # from less no head can be made, and what is near trades with what is small
LEAST_AGREEING_PAIRS = 0.7

_PAIR_ERROR_PX = 2.5
_PAIR_INLIERS = 30
_MOST_JUMPS = 0.1  # share of the frames
_JUMP = (8.0, 2.0, 0.03)  # times the median deviation, times the median step, share of the distance


@dataclass(frozen=True, eq=False)
class Assessment:
    """What was measured of a reconstruction.

    Attributes:
        numbers: Plain numbers for the report.
        complaints: Why it cannot be believed; none = it can.
        jumps: Positions of frames that stand apart from the path of those before and after.
        parallax: Whether the cameras moved enough around the scene.
    """

    numbers: dict[str, float]
    complaints: tuple[str, ...]
    jumps: tuple[int, ...]
    parallax: bool


def assess(sparse: Sparse, looks: Sequence[Look], pairs: Sequence[Pair]) -> Assessment:
    """Measures a reconstruction by itself and by the pairs that it was made from.

    Args:
        sparse: The reconstruction.
        looks: The frames that were mapped, in the order of capture.
        pairs: Compared frames with their inliers.
    """
    complaints = []
    error = float(np.median(sparse.error_px)) if len(sparse.points) else float("inf")
    if len(sparse.points) < LEAST_POINTS:
        complaints.append(f"only {len(sparse.points)} points (needed: {LEAST_POINTS})")
    elif not error <= MOST_ERROR_PX:
        complaints.append(f"a reprojection error of {error:.2f} px (limit: {MOST_ERROR_PX})")
    track = float(sparse.track_length.mean()) if len(sparse.points) else 0.0
    if track < LEAST_TRACK:
        complaints.append(f"points seen by {track:.1f} frames on average (needed: {LEAST_TRACK})")
    angle, fan = triangulation_angle_deg(sparse), fan_deg(sparse)
    parallax = angle >= LEAST_ANGLE_DEG and fan >= LEAST_FAN_DEG
    if not parallax:
        complaints.append(
            f"almost no parallax (points are seen under {angle:.1f} degrees, the cameras fan over {fan:.1f}; "
            f"needed: {LEAST_ANGLE_DEG} and {LEAST_FAN_DEG})"
        )
    agreement = pair_agreement(sparse, looks, pairs)
    if agreement < LEAST_AGREEING_PAIRS:
        complaints.append(
            f"only {100 * agreement:.0f} % of the compared pairs of frames agree with it "
            f"(needed: {100 * LEAST_AGREEING_PAIRS:.0f} %)"
        )
    jumps = path_jumps(sparse)
    if len(jumps) > max(1, _MOST_JUMPS * len(sparse.cameras)):
        complaints.append(f"a path of the camera that jumps at {len(jumps)} of {len(sparse.cameras)} frames")
    numbers = {
        "frames_mapped": float(len(sparse.cameras)),
        "points": float(len(sparse.points)),
        "observations": float(len(sparse.observations)),
        "median_error_px": error if np.isfinite(error) else -1.0,
        "mean_track_length": track,
        "median_triangulation_angle_deg": angle,
        "fan_deg": fan,
        "agreeing_pairs": agreement,
        "path_jumps": float(len(jumps)),
    }
    return Assessment(numbers, tuple(complaints), tuple(jumps), parallax)


def triangulation_angle_deg(sparse: Sparse) -> float:
    """Median over the points of the widest angle between the ray of their first view and the others'."""
    if not len(sparse.observations):
        return 0.0
    centres = np.full((max(sparse.cameras) + 1, 3), np.nan)
    for position, camera in sparse.cameras.items():
        centres[position] = camera.centre_world
    rays = sparse.points[sparse.observations[:, 2]] - centres[sparse.observations[:, 0]]
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
    _, first, which = np.unique(sparse.observations[:, 2], return_index=True, return_inverse=True)
    chord = np.linalg.norm(rays - rays[first][which], axis=1)
    widest = np.zeros(len(first))
    np.maximum.at(widest, which, chord)
    return float(np.degrees(2.0 * np.arcsin(np.clip(np.median(widest) / 2.0, 0.0, 1.0))))


def fan_deg(sparse: Sparse) -> float:
    """Widest angle between two cameras, seen from where they look."""
    if len(sparse.cameras) < 2:
        return 0.0
    centres = np.array([camera.centre_world for camera in sparse.cameras.values()])
    axes = np.array([camera.cam_from_world[2, :3] for camera in sparse.cameras.values()])
    directions = centres - look_point(centres, axes, sparse.points)
    directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-12)
    return float(np.degrees(np.arccos(np.clip((directions @ directions.T).min(), -1.0, 1.0))))


def pair_agreement(sparse: Sparse, looks: Sequence[Look], pairs: Sequence[Pair]) -> float:
    """Share of the pairs whose own matches obey the epipolar geometry of the poses; 1 without pairs.

    A reconstruction that was folded, or put together wrongly where two places look alike, contradicts many.
    """
    agreeing = total = 0
    straight: dict[int, Floats] = {}
    for pair in pairs:
        i, j = pair.first, pair.second
        inliers = pair.inliers
        if len(inliers) < _PAIR_INLIERS or i not in sparse.cameras or j not in sparse.cameras:
            continue
        for position in (i, j):
            if position not in straight:
                straight[position] = _normalised(sparse, looks[position], position)
        focal = 0.5 * (_focal_px(sparse, looks[i], i) + _focal_px(sparse, looks[j], j))
        first, second = straight[i][inliers[:, 0]], straight[j][inliers[:, 1]]
        relative = sparse.cameras[j].cam_from_world @ np.linalg.inv(sparse.cameras[i].cam_from_world)
        error = focal * np.median(sampson_distance(first, second, relative))
        agreeing += int(error < _PAIR_ERROR_PX)
        total += 1
    return agreeing / total if total else 1.0


def sampson_distance(first: Floats, second: Floats, second_from_first: Floats) -> Floats:
    """[N] first-order distance to the epipolar geometry (Sampson 1982), in units of the focal length.

    Args:
        first: [N, 2] x/z, y/z in the first camera.
        second: [N, 2] in the second.
        second_from_first: [4, 4].
    """
    t = second_from_first[:3, 3] / max(float(np.linalg.norm(second_from_first[:3, 3])), 1e-12)
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    essential = cross @ second_from_first[:3, :3]
    a = np.column_stack([first, np.ones(len(first))])
    b = np.column_stack([second, np.ones(len(second))])
    lines_b, lines_a = a @ essential.T, b @ essential
    steepness = (lines_b[:, :2] ** 2).sum(axis=1) + (lines_a[:, :2] ** 2).sum(axis=1)
    distance: Floats = np.abs((lines_b * b).sum(axis=1)) / np.sqrt(np.maximum(steepness, 1e-18))
    return distance


def path_jumps(sparse: Sparse) -> list[int]:
    """Positions of frames that stand far from the straight line between those before and after them."""
    positions = sorted(sparse.cameras)
    if len(positions) < 5:
        return []
    centres = np.array([sparse.cameras[position].centre_world for position in positions])
    axes = np.array([sparse.cameras[position].cam_from_world[2, :3] for position in positions])
    distance = float(np.median(np.linalg.norm(centres - look_point(centres, axes, sparse.points), axis=1)))
    times = np.array(positions, np.float64)
    share = (times[1:-1] - times[:-2]) / (times[2:] - times[:-2])
    between = centres[:-2] + share[:, None] * (centres[2:] - centres[:-2])
    deviation = np.linalg.norm(centres[1:-1] - between, axis=1)
    step = float(np.median(np.linalg.norm(np.diff(centres, axis=0), axis=1)))
    limit = max(_JUMP[0] * float(np.median(deviation)), _JUMP[1] * step, _JUMP[2] * distance)
    found = []
    for k in np.flatnonzero(deviation > limit):
        # The neighbours of a frame that is off deviate half as much; the one that is off, most.
        if deviation[k] >= deviation[max(0, k - 1) : k + 2].max():
            found.append(positions[k + 1])
    return found


def _normalised(sparse: Sparse, look: Look, position: int) -> Floats:
    """[N, 2] features of a frame as x/z, y/z without distortion."""
    camera = sparse.cameras[position]
    places = look.features.places_px * [camera.width / look.size[0], camera.height / look.size[1]]
    if not camera.distortion.any():
        return (places - camera.K[:2, 2]) / np.diag(camera.K)[:2]
    return np.asarray(cv2.undistortPoints(places[:, None], camera.K, camera.distortion), np.float64).reshape(
        -1, 2
    )


def _focal_px(sparse: Sparse, look: Look, position: int) -> float:
    """Focal length at the size at which the frame was looked at."""
    camera = sparse.cameras[position]
    return float(camera.K[0, 0]) * look.size[0] / camera.width
