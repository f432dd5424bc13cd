"""Measures of pictures, normals and masks against the truth, in float64, over pixels that are named.

A `region` [H, W] (bool) says which pixels count. Where no pixels are left to compare the measure is NaN:
nothing was measured. NaN inside the region gives NaN as well: a broken pixel is not a good one.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

# Wang et al. 2004, "Image quality assessment: from error visibility to structural similarity", section III-C.
_SSIM_K1, _SSIM_K2 = 0.01, 0.03
_SSIM_WINDOW_PX = 7

# How far around the true silhouette the mask is looked at; how far off a right outline may be.
BAND_PX = 10.0
TOLERANCE_PX = 1.5

Picture = NDArray[np.floating]
Region = NDArray[np.bool_]


def psnr_db(picture: Picture, truth: Picture, region: Region) -> float:
    """Peak signal-to-noise ratio (peak 1) over the region and all channels; infinite where all is equal.

    Args:
        picture: [..., C], display-referred, 0..1.
        truth: as `picture`.
        region: [...].
    """
    difference = picture[region].astype(np.float64) - truth[region].astype(np.float64)
    if not difference.size:
        return float("nan")
    error = float(np.mean(difference**2))
    return float("inf") if error == 0.0 else float(-10.0 * np.log10(error))


def ssim(picture: Picture, truth: Picture, region: Region) -> float:
    """Structural similarity of display values (peak 1), Wang 2004, eq. 13, mean over the region and channels.

    A uniform 7 x 7 window; both pictures are black outside the region and mirrored at their border.

    Args:
        picture: [H, W, C], display-referred, 0..1.
        truth: as `picture`.
        region: [H, W].
    """
    if not region.any():
        return float("nan")
    first, second = (np.where(region[..., None], image, 0.0).astype(np.float64) for image in (picture, truth))
    mean_1, mean_2 = _windowed(first), _windowed(second)
    variance_1 = _windowed(first * first) - mean_1 * mean_1
    variance_2 = _windowed(second * second) - mean_2 * mean_2
    covariance = _windowed(first * second) - mean_1 * mean_2
    c1, c2 = _SSIM_K1**2, _SSIM_K2**2
    similarity = ((2.0 * mean_1 * mean_2 + c1) * (2.0 * covariance + c2)) / (
        (mean_1 * mean_1 + mean_2 * mean_2 + c1) * (variance_1 + variance_2 + c2)
    )
    return float(np.mean(similarity[region]))


def _windowed(image: NDArray[np.float64]) -> NDArray[np.float64]:
    mean = cv2.blur(image, (_SSIM_WINDOW_PX, _SSIM_WINDOW_PX), borderType=cv2.BORDER_REFLECT)
    return np.asarray(mean, np.float64).reshape(image.shape)  # OpenCV drops a last axis of one


def channel_scales(values: Picture, truth: Picture) -> NDArray[np.float64]:
    """Factors [C] that bring `values` [P, C] nearest to `truth` [P, C], by linear least squares.

    A channel without any light has the factor 1: no factor changes it.
    """
    values, truth = values.astype(np.float64), truth.astype(np.float64)
    energy = np.sum(values * values, axis=0)
    products = np.sum(values * truth, axis=0)
    lit = energy > 0
    return np.where(lit, products / np.where(lit, energy, 1.0), 1.0)


def median_relative_error(values: Picture, truth: Picture) -> float:
    """Median of |values - truth| / truth over all values whose truth is above 0."""
    known = truth > 0
    if not known.any():
        return float("nan")
    expected = truth[known].astype(np.float64)
    return float(np.median(np.abs(values[known] - expected) / expected))


def angles_deg(directions: Picture, truth: Picture) -> NDArray[np.float64]:
    """Angles [...] between directions [..., 3] of any length, degrees, exact at 0 and 180 too.

    A direction of length zero says nothing and counts as 90 degrees, as a guess would on average; where the
    truth has length zero there is nothing to measure: NaN.
    """
    first, second = directions.astype(np.float64), truth.astype(np.float64)
    sine = np.linalg.norm(np.cross(first, second), axis=-1)
    angles = np.degrees(np.arctan2(sine, np.sum(first * second, axis=-1)))
    angles = np.where((first == 0).all(axis=-1), 90.0, angles)
    return np.where((second == 0).all(axis=-1), np.nan, angles)


def mask_iou(mask: Picture, truth: Picture, threshold: float = 0.5) -> float:
    """Intersection over union of two masks (0..1) at a threshold; NaN when both are empty."""
    first, second = mask >= threshold, truth >= threshold
    union = np.count_nonzero(first | second)
    return np.count_nonzero(first & second) / union if union else float("nan")


def alpha_error(mask: Picture, truth: Picture, band_px: float = BAND_PX) -> float:
    """Mean |mask - truth| within `band_px` of the true silhouette, where hair is: 0 perfect, 1 worst.

    The silhouette is where the true mask [H, W] crosses 0.5; the picture's border is none.
    """
    band = _distance_px(_silhouette(truth)) <= band_px
    if not band.any():
        return float("nan")
    return float(np.mean(np.abs(mask[band].astype(np.float64) - truth[band])))


def silhouette_f_score(mask: Picture, truth: Picture, tolerance_px: float = TOLERANCE_PX) -> float:
    """Harmonic mean of the shares of either silhouette that lie within a tolerance of the other.

    Unlike the IoU it sees strands of hair: it counts length, not area (the boundary measure F of Perazzi
    2016, with exact distances). 0 when only one of the masks [H, W] has a silhouette, NaN when none has.
    """
    found, wanted = _silhouette(mask), _silhouette(truth)
    if not (found.any() and wanted.any()):
        return 0.0 if found.any() or wanted.any() else float("nan")
    precision = np.mean(_distance_px(wanted)[found] <= tolerance_px)
    recall = np.mean(_distance_px(found)[wanted] <= tolerance_px)
    return float(2.0 * precision * recall / (precision + recall)) if precision + recall else 0.0


def _silhouette(mask: Picture) -> Region:
    """Pixels [H, W] of the mask at 0.5 with a neighbour (of four) that is not in it."""
    inside = (mask >= 0.5).astype(np.uint8)
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    return (inside > 0) & (cv2.erode(inside, cross) == 0)


def _distance_px(pixels: Region) -> NDArray[np.float32]:
    """Distance [H, W] of every pixel to the nearest of some pixels; infinite when there is none."""
    if not pixels.any():
        return np.full(pixels.shape, np.inf, np.float32)
    distance = cv2.distanceTransform((~pixels).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(distance, np.float32)
