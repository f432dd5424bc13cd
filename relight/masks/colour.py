"""Colours of subject and background near each pixel: a Gaussian of either in a window, from sure pixels.

Everything is sums over boxes, so the cost does not depend on the window.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from relight.masks.frames import Floats

_NOISE = 0.02  # of display values 0..1: added to every colour's spread
_FEWEST = 12.0  # sure pixels in a window
_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))  # entries of a symmetric matrix, in our order


def display(radiance: Floats) -> Floats:
    """Linear radiance [H, W, 3] as evenly visible values 0..1: a square root."""
    return np.sqrt(np.clip(radiance, 0.0, 1.0))


def colour_evidence(
    picture: Floats,
    subject: Floats,
    background: Floats,
    radius_px: int,
    wanted: NDArray[np.bool_] | None = None,
) -> Floats:
    """Log-odds [H, W] of being the subject by colour.

    Args:
        picture: [H, W, 3] display values.
        subject: [H, W] 0..1 weight of surely covered pixels.
        background: [H, W] 0..1 weight of surely free ones.
        radius_px: Of the windows.
        wanted: [H, W] pixels to answer for, all by default.

    Returns:
        0 where a window has too few pixels of either, and where not wanted.
    """
    sums = _sums(picture, subject, radius_px), _sums(picture, background, radius_px)
    known = (sums[0][0] >= _FEWEST) & (sums[1][0] >= _FEWEST)
    if wanted is not None:
        known &= wanted
    odds = np.zeros(known.shape, np.float32)
    if known.any():
        here = picture[known]
        inside, outside = (_log_density(here, [layer[known] for layer in layers]) for layers in sums)
        odds[known] = inside - outside
    return odds


def _sums(picture: Floats, weight: Floats, radius_px: int) -> list[Floats]:
    """Over windows [H, W]: weights, weighted values (3), and their products (6)."""
    size = (2 * radius_px + 1, 2 * radius_px + 1)
    channels = cv2.split(picture)
    weighted = [weight * channel for channel in channels]
    layers = [weight, *weighted, *(weighted[i] * channels[j] for i, j in _PAIRS)]
    # One call on many channels is slower than one a channel: boxes of one channel stay in the cache.
    boxes = (
        cv2.boxFilter(layer, cv2.CV_32F, size, normalize=False, borderType=cv2.BORDER_CONSTANT)
        for layer in layers
    )
    return [np.asarray(box, np.float32) for box in boxes]


def _log_density(colours: Floats, sums: list[Floats]) -> Floats:
    """Log of a normal density [N] at colours [N, 3], less a constant, from sums over windows [N]."""
    total = sums[0]
    mean = [layer / total for layer in sums[1:4]]
    a, b, c, d, e, f = (
        layer / total - mean[i] * mean[j] for layer, (i, j) in zip(sums[4:], _PAIRS, strict=True)
    )
    a, d, f = (np.maximum(value, 0.0) + np.float32(_NOISE**2) for value in (a, d, f))
    # The inverse by cofactors; variances are above the noise's and rounding is far below it.
    aa, bb, cc = d * f - e * e, c * e - b * f, b * e - c * d
    dd, ee, ff = a * f - c * c, b * c - a * e, a * d - b * b
    determinant = np.maximum(a * aa + b * bb + c * cc, np.float32(0.1 * _NOISE**6))
    x, y, z = (colours[:, axis] - mean[axis] for axis in range(3))
    square = aa * x * x + dd * y * y + ff * z * z + 2.0 * (bb * x * y + cc * x * z + ee * y * z)
    return np.asarray(-0.5 * (square / determinant + np.log(determinant)), np.float32)
