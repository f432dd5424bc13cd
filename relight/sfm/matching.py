"""Which features of two frames are the same, and which of these one rigid motion explains."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from relight.sfm.features import DESCRIPTOR_SCALE, Features

RATIO = 0.8
"""A match must be this much nearer than the next best (Lowe 2004)."""

LEAST_INLIERS = 15
"""Fewer agree by chance."""

_MOST_TRIALS = 1000  # 7 points without an outlier among half that are outliers
_MAX_DISTANCE = 0.7  # of unit descriptors, as COLMAP


@dataclass(frozen=True, eq=False)
class Pair:
    """Two frames that were compared.

    Attributes:
        first, second: Positions of the frames in the list of those compared.
        matches: [M, 2] features that look the same, before any geometry.
        geometry: What COLMAP made of it; None = too few matches.
    """

    first: int
    second: int
    matches: NDArray[np.uint32]
    geometry: pycolmap.TwoViewGeometry | None

    @property
    def inliers(self) -> NDArray[np.uint32]:
        """[I, 2] matches that one motion explains, empty where none does."""
        if self.geometry is None:
            return np.zeros((0, 2), np.uint32)
        return np.asarray(self.geometry.inlier_matches, np.uint32).reshape(-1, 2)

    @property
    def verified(self) -> bool:
        """Whether enough matches agree on a motion."""
        return len(self.inliers) >= LEAST_INLIERS


def match_descriptors(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> NDArray[np.uint32]:
    """[M, 2] pairs of descriptors that are each other's nearest and pass the ratio test from both sides."""
    if len(first) < 2 or len(second) < 2:
        return np.zeros((0, 2), np.uint32)
    a = first.astype(np.float32) * np.float32(1.0 / DESCRIPTOR_SCALE)
    b = second.astype(np.float32) * np.float32(1.0 / DESCRIPTOR_SCALE)
    rows = np.arange(len(a))
    likeness = a @ b.T
    nearest = likeness.argmax(axis=1)
    best = likeness[rows, nearest]
    back = likeness.argmax(axis=0)
    mutual = np.flatnonzero(back[nearest] == rows)
    likeness = likeness[mutual]  # the ratio is asked of these only
    likeness[np.arange(len(mutual)), nearest[mutual]] = -1.0
    runner_up = likeness.max(axis=1) if len(mutual) else np.zeros(0, np.float32)
    distance = np.sqrt(np.maximum(2.0 - 2.0 * best[mutual], 0.0))
    other = np.sqrt(np.maximum(2.0 - 2.0 * runner_up, 0.0))
    good = (distance < RATIO * other) & (distance < _MAX_DISTANCE)
    chosen = mutual[good]
    return np.stack([chosen, nearest[chosen]], axis=1).astype(np.uint32)


def match_labels(first: Features, second: Features) -> NDArray[np.uint32]:
    """[M, 2] printed corners that both frames show."""
    _, i, j = np.intersect1d(
        np.where(first.labels >= 0, first.labels, -1),
        np.where(second.labels >= 0, second.labels, -2),
        return_indices=True,
    )
    return np.stack([i, j], axis=1).astype(np.uint32)


def match_features(first: Features, second: Features) -> NDArray[np.uint32]:
    """[M, 2] by descriptor and by label."""
    return np.concatenate(
        [match_descriptors(first.descriptors, second.descriptors), match_labels(first, second)]
    )


def verify(
    first: Features,
    second: Features,
    cameras: tuple[pycolmap.Camera, pycolmap.Camera],
    matches: NDArray[np.uint32],
    max_error_px: float,
    seed: int,
) -> pycolmap.TwoViewGeometry | None:
    """The motion between two frames, robustly; None where there is none that enough matches agree on."""
    if len(matches) < LEAST_INLIERS:
        return None
    options = pycolmap.TwoViewGeometryOptions()
    options.min_num_inliers = LEAST_INLIERS
    options.ransac.max_error = max_error_px
    options.ransac.random_seed = seed
    options.ransac.max_num_trials = _MOST_TRIALS
    geometry = pycolmap.estimate_two_view_geometry(
        cameras[0], first.places_px, cameras[1], second.places_px, matches, options
    )
    return geometry if len(geometry.inlier_matches) >= LEAST_INLIERS else None
