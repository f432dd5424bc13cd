"""Features of one frame: places, descriptors, and what identifies printed corners.

SIFT (Lowe 2004) of OpenCV with the square root of L1-normalised descriptors (Arandjelovic & Zisserman 2012).
Its keypoints have integer pixel centres; half a pixel is added here, and the upsampling that shifts them by a
quarter of a pixel otherwise is avoided (`enable_precise_upscale`): with a fixed principal point such a shift
would turn every camera.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

DESCRIPTOR_SCALE = 512.0
"""Descriptors are kept as whole numbers up to 255 of this: a quarter of the memory, as COLMAP does."""

_EDGE_RATIO = 12.0
_ERODE_PX = 5  # no feature this close to pixels that are not finite


@dataclass(frozen=True)
class Recipe:
    """How features are looked for in one attempt.

    Attributes:
        picture: "local" or "clahe".
        contrast: Least response at an extremum (OpenCV's contrastThreshold).
        max_features: Most features, the strongest first.
    """

    picture: str = "local"
    contrast: float = 0.01
    max_features: int = 2000


@dataclass(frozen=True, eq=False)
class Features:
    """What was found in a frame.

    Attributes:
        places_px: [N, 2] float64, pixels of the frame as it was looked at; centres at 0.5.
        descriptors: [M, 128] uint8 of the first M places, M <= N; printed corners have none.
        labels: [N] int64, -1 or what identifies a printed corner in every frame.
        colors: [N, 3] float32 linear radiance.
    """

    places_px: NDArray[np.float64]
    descriptors: NDArray[np.uint8]
    labels: NDArray[np.int64]
    colors: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.places_px)


def detect_features(
    picture: NDArray[np.uint8], recipe: Recipe, usable: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Places [N, 2] and descriptors [N, 128] of a picture, strongest first.

    Args:
        picture: [h, w].
        recipe: Thresholds.
        usable: [h, w] pixels that may carry features.
    """
    allowed = None
    if not usable.all():
        kernel = np.ones((2 * _ERODE_PX + 1, 2 * _ERODE_PX + 1), np.uint8)
        allowed = cv2.erode(usable.astype(np.uint8), kernel)
    sift = cv2.SIFT.create(
        nfeatures=recipe.max_features,
        contrastThreshold=recipe.contrast,
        edgeThreshold=_EDGE_RATIO,
        enable_precise_upscale=True,
    )
    keypoints, raw = sift.detectAndCompute(picture, allowed)
    if not keypoints or raw is None:
        return np.zeros((0, 2)), np.zeros((0, 128), np.uint8)
    places = np.array([keypoint.pt for keypoint in keypoints], np.float64) + 0.5
    # Descriptors come in the order of the keypoints, which is not by strength and not the same in every
    # build; equal responses are told apart by place.
    strength = np.array([keypoint.response for keypoint in keypoints])
    angle = np.array([keypoint.angle for keypoint in keypoints])
    order = np.lexsort((angle, places[:, 1], places[:, 0], -strength))[: recipe.max_features]
    root = np.sqrt(raw[order] / np.maximum(raw[order].sum(axis=1, keepdims=True), 1e-9))
    return places[order], np.minimum(np.rint(DESCRIPTOR_SCALE * root), 255.0).astype(np.uint8)


def colors_at(radiance: NDArray[np.float32], places: NDArray[np.float64]) -> NDArray[np.float32]:
    """Radiance [N, 3] 0..1 at places [N, 2] of the full-size frame; 0 where it is not finite."""
    height, width = radiance.shape[:2]
    column = np.clip(places[:, 0].astype(np.int64), 0, width - 1)
    row = np.clip(places[:, 1].astype(np.int64), 0, height - 1)
    return np.nan_to_num(np.clip(radiance[row, column], 0.0, 1.0)).astype(np.float32)
