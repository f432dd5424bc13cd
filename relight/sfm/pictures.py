"""Pictures in which features are looked for: the same under flash and without it.

What the flash changes in a picture is smooth, except at shadows: it multiplies the radiance by a slowly
varying factor. In the logarithm of linear radiance that is an offset, which the local mean takes away; a
division by the local contrast brings skin, whose detail is a few percent, to the level of posters.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

KINDS = ("local", "clahe")

_GREY = np.array([0.25, 0.55, 0.20], np.float32)  # green sees pigment and is the least noisy
_DARKEST = 0.004  # radiance below which 8-bit codes are too coarse to have detail
_WINDOW = 0.024  # of the local mean, share of the longer side: pores and brows are finer, shading is coarser
_LEAST_CONTRAST = 0.03  # of the logarithm: below it, what is seen is noise and quantisation
_SPREAD = 3.0  # standard deviations of the local contrast from grey to white
_SMALL_SIDE = 64


def grey_radiance(
    radiance: NDArray[np.float32], max_side_px: int
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """A frame's grey radiance at the size at which it is looked at, and which pixels are finite.

    Args:
        radiance: [H, W, 3] linear.
        max_side_px: The longer side is made no longer; pictures are never enlarged.

    Returns:
        [h, w] 0..1 with 0 where a pixel is not finite, and [h, w] whether it is.
    """
    grey = radiance @ _GREY
    finite = np.isfinite(grey)
    grey = np.clip(np.where(finite, grey, 0.0), 0.0, 1.0).astype(np.float32)
    height, width = grey.shape
    longer = max(height, width)
    if longer > max_side_px:
        size = (
            max(1, round(width * max_side_px / longer)),
            max(1, round(height * max_side_px / longer)),
        )
        grey = np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.float32)
        finite = cv2.resize(finite.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.999
    return grey, finite


def feature_picture(grey: NDArray[np.float32], kind: str) -> NDArray[np.uint8]:
    """The 8-bit picture for a detector.

    Args:
        grey: [h, w] linear radiance 0..1.
        kind: "local" = logarithm by local mean and contrast; "clahe" = logarithm equalised by tiles
            (Zuiderveld 1994), which keeps edges of large plain areas that "local" flattens.
    """
    logarithm = np.log(grey + np.float32(_DARKEST))
    if kind == "clahe":
        low, high = np.log(_DARKEST), np.log(1.0 + _DARKEST)
        even = np.rint(255.0 * (logarithm - low) / (high - low)).astype(np.uint8)
        return np.asarray(cv2.createCLAHE(clipLimit=4.0, tileGridSize=(8, 8)).apply(even))
    sigma = _WINDOW * max(grey.shape)
    detail = logarithm - cv2.GaussianBlur(logarithm, (0, 0), sigma)
    contrast = np.sqrt(np.maximum(cv2.GaussianBlur(detail * detail, (0, 0), sigma), 0.0))
    levels = 0.5 + detail / (2.0 * _SPREAD * (contrast + np.float32(_LEAST_CONTRAST)))
    return np.rint(255.0 * np.clip(levels, 0.0, 1.0)).astype(np.uint8)


def marker_picture(grey: NDArray[np.float32]) -> NDArray[np.uint8]:
    """The 8-bit picture for detectors of printed markers: as the eye sees it, by the brightest percent."""
    bright = max(float(np.percentile(grey, 99.0)), _DARKEST)
    return np.rint(255.0 * np.sqrt(np.clip(grey / bright, 0.0, 1.0))).astype(np.uint8)


def sharpness(grey: NDArray[np.float32]) -> float:
    """How much fine detail a frame has relative to coarse, whatever its exposure.

    The energy of the logarithm's Laplacian at a scale of one pixel over that at four: a blur of a few pixels
    takes the first and leaves the second, another view of the scene changes both alike.
    """
    logarithm = np.log(grey + np.float32(_DARKEST))
    energies = []
    for sigma in (1.0, 4.0):
        smooth = cv2.GaussianBlur(logarithm, (0, 0), sigma)
        response = sigma * sigma * cv2.Laplacian(smooth, cv2.CV_32F)
        # The strongest twentieth: plain walls say nothing, and one lamp should not say all.
        energies.append(float(np.percentile(np.abs(response), 95.0)))
    fine, coarse = energies
    return fine / coarse if coarse > 1e-6 else 0.0


def small_picture(grey: NDArray[np.float32]) -> NDArray[np.float32]:
    """A frame at 64 pixels along its longer side, of which a copy of every frame can be kept."""
    height, width = grey.shape
    factor = min(1.0, _SMALL_SIDE / max(height, width))
    size = (max(1, round(width * factor)), max(1, round(height * factor)))
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.float32)
