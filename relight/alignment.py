"""From one world to another: the similarity that poses from frames alone leave open, and what they err by.

A reconstruction has a world of its own. Cameras that are known in both worlds tell the similarity between
them (Umeyama 1991, "Least-squares estimation of transformation parameters between two point patterns"); where
their centres lie on a line or in a point, their rotations decide what the centres cannot.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from capture.cameras import Camera, nearest_rotation
from relight.errors import GeometryError

Floats = NDArray[np.float64]

FEWEST_CAMERAS = 3
"""Fewer common cameras leave the scale to chance."""

_ROUNDS = 4  # of leaving outliers out
_OUTLIER = 6.0  # times the median distance
_LINE = 0.02  # second singular value of the centres, relative to the first, that still turns about their line


@dataclass(frozen=True, eq=False)
class Similarity:
    """x_to = scale * rotation @ x_from + translation.

    Attributes:
        scale: Length in the new world of a unit of the old.
        rotation: [3, 3].
        translation: [3], in the new world.
    """

    scale: float
    rotation: Floats
    translation: Floats

    def points(self, points: Floats) -> Floats:
        """Points [P, 3] of the old world in the new one."""
        moved: Floats = self.scale * points @ self.rotation.T + self.translation
        return moved

    def directions(self, directions: Floats) -> Floats:
        """Directions [P, 3] of the old world in the new one; their lengths stay."""
        turned: Floats = directions @ self.rotation.T
        return turned

    def camera(self, camera: Camera) -> Camera:
        """A camera of the old world in the new one: it takes the same picture there."""
        rotation = camera.cam_from_world[:3, :3] @ self.rotation.T
        cam_from_world = np.eye(4)
        cam_from_world[:3, :3] = rotation
        cam_from_world[:3, 3] = -rotation @ self.points(camera.centre_world[None])[0]
        return replace(camera, cam_from_world=cam_from_world)


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """How far found cameras are from the true ones, after alignment; one number a common camera.

    Attributes:
        rotation_deg: [N] angle between the orientations.
        centre: [N] distance of the centres, in the unit of the true world.
    """

    rotation_deg: Floats
    centre: Floats


def align_cameras(found: Mapping[int, Camera], true: Mapping[int, Camera]) -> Similarity:
    """The similarity that takes the world of the found cameras to that of the true ones.

    Cameras that disagree with the others (a frame that was registered wrongly) are left out by their
    distance.

    Args:
        found: By frame.
        true: By frame; those that both have count.

    Raises:
        GeometryError: Fewer than three are common, or all of them stand in one place.
    """
    common = sorted(found.keys() & true.keys())
    if len(common) < FEWEST_CAMERAS:
        raise GeometryError(
            f"{len(common)} cameras are known in both worlds; {FEWEST_CAMERAS} are needed to bring them "
            "together."
        )
    source = np.array([found[index].centre_world for index in common])
    target = np.array([true[index].centre_world for index in common])
    turns = np.array(
        [true[index].cam_from_world[:3, :3].T @ found[index].cam_from_world[:3, :3] for index in common]
    )
    kept = np.ones(len(common), dtype=bool)
    similarity = _fit(source, target, turns)
    for _ in range(_ROUNDS):
        distances = np.linalg.norm(similarity.points(source) - target, axis=1)
        within = distances <= _OUTLIER * max(float(np.median(distances)), 1e-12)
        if within.sum() < FEWEST_CAMERAS or np.array_equal(within, kept):
            break
        kept = within
        similarity = _fit(source[kept], target[kept], turns[kept])
    return similarity


def pose_errors(
    found: Mapping[int, Camera], true: Mapping[int, Camera], similarity: Similarity
) -> PoseErrors:
    """Errors of the cameras that both worlds have, in the order of their indices.

    Args:
        found: By frame, in their own world.
        true: By frame.
        similarity: True world from found world.
    """
    rotations, centres = [], []
    for index in sorted(found.keys() & true.keys()):
        moved, truth = similarity.camera(found[index]), true[index]
        difference = moved.cam_from_world[:3, :3] @ truth.cam_from_world[:3, :3].T
        # Of small angles the arc cosine knows nothing; the chord does.
        chord = np.linalg.norm(difference - np.eye(3)) / (2.0 * np.sqrt(2.0))
        rotations.append(np.degrees(2.0 * np.arcsin(min(1.0, chord))))
        centres.append(np.linalg.norm(moved.centre_world - truth.centre_world))
    return PoseErrors(np.array(rotations), np.array(centres))


def _fit(source: Floats, target: Floats, turns: Floats) -> Similarity:
    """Least squares over centres [N, 3]; turns [N, 3, 3] are what each camera alone says of the rotation."""
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    a, b = source - source_mean, target - target_mean
    covariance = b.T @ a
    left, singular, right = np.linalg.svd(covariance)
    spread = float((a * a).sum())
    if not np.isfinite(covariance).all() or spread <= 1e-18 * max(1.0, float((source_mean**2).sum())):
        raise GeometryError("The cameras all stand in one place, which leaves the scale of the scene open.")
    if singular[1] > _LINE**2 * singular[0]:
        # A path in a plane, as on a half circle, leaves the third direction open; a reflection it is not.
        rotation = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    else:
        rotation = nearest_rotation(turns.sum(axis=0))
    scale = float((b * (a @ rotation.T)).sum() / spread)
    return Similarity(scale, rotation, target_mean - scale * rotation @ source_mean)
