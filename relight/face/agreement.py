"""How well a cloud agrees with its own mirror image about many planes at once.

A point's mirror image says something only where the cloud was observed: beyond its edge there is nothing to
agree or disagree with (Thrun and Wegbreit 2005, "Shape from symmetry", treat it as hidden). The edge is told
from the way to the nearest sample: across its surface it is a disagreement, along it the image lies off the
observed part.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from relight.face.plane import Floats
from relight.face.samples import Samples

BEYOND_CELLS = 2.5
"""Cells along the surface from the nearest sample, from which on a place counts as not observed."""

ALBEDO_TOLERANCE = 0.35
_UNSEEN_PRICE = 0.35  # what a mirror image that cannot be checked costs, of one that disagrees
_CHUNK = 400_000  # images at a time


@dataclass(frozen=True, eq=False)
class Agreement:
    """Of M planes.

    Attributes:
        score: [M] 0..1, mean agreement; images that cannot be checked count against it a little.
        agreement: [M] 0..1, mean over those that can.
        overlap: [M] 0..1, share of the images that can be checked.
    """

    score: NDArray[np.float64]
    agreement: NDArray[np.float64]
    overlap: NDArray[np.float64]


def mirror_agreement(
    samples: Samples, which: NDArray[np.int64], normals: Floats, offsets: Floats, tolerance: float
) -> Agreement:
    """Scores planes.

    Args:
        samples: The cloud.
        which: [S] ids of the samples whose images are looked at.
        normals: [M, 3], unit, of the planes.
        offsets: [M].
        tolerance: Distance across the surface that still agrees (standard deviation), world units.
    """
    step = max(1, _CHUNK // max(1, len(which)))
    parts = [
        _scored(samples, which, normals[start : start + step], offsets[start : start + step], tolerance)
        for start in range(0, len(normals), step)
    ]
    score, agreement, overlap = (np.concatenate(values) for values in zip(*parts, strict=True))
    return Agreement(score, agreement, overlap)


def _scored(
    samples: Samples, which: NDArray[np.int64], normals: Floats, offsets: Floats, tolerance: float
) -> tuple[NDArray[np.float64], ...]:
    points, directions = samples.points[which], samples.normals[which]
    height = points @ normals.T - offsets  # [S, M]
    images = points[:, None] - 2.0 * height[..., None] * normals
    turned = directions[:, None] - 2.0 * (directions @ normals.T)[..., None] * normals
    ids = samples.ids_near(images)
    way = images - samples.points[ids]
    facing = samples.normals[ids]
    across = (way * facing).sum(axis=-1)
    along = np.sqrt(np.maximum((way * way).sum(axis=-1) - across**2, 0.0))
    seen = (along < BEYOND_CELLS * samples.cell) | (np.abs(across) > along)
    alike = np.exp(-0.5 * (across / tolerance) ** 2) * np.clip((turned * facing).sum(axis=-1), 0.0, 1.0) ** 2
    alike *= along < BEYOND_CELLS * samples.cell
    alike *= samples.albedo_agreement(which[:, None], ids, ALBEDO_TOLERANCE)
    checked = seen.sum(axis=0)
    agreeing = (seen * alike).sum(axis=0)
    unseen = len(which) - checked
    return (
        agreeing / np.maximum(checked + _UNSEEN_PRICE * unseen, 1e-12),
        agreeing / np.maximum(checked, 1e-12),
        checked / max(1, len(which)),
    )
