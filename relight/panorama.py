"""Lat-long panoramas of radiance: reading, directions, solid angles, projection to spherical harmonics.

A panorama is [H, W, 3], linear radiance, constant over each cell. Row i, column j looks along theta = pi (i +
0.5) / H, phi = 2 pi (j + 0.5) / W, direction (sin theta sin phi, cos theta, -sin theta cos phi) in the world:
the top row is up (+Y), the middle column is +Z.
"""

from __future__ import annotations

import logging
import math
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from capture.errors import RelightError
from capture.images import read_image
from relight.errors import LightError
from relight.spherical_harmonics import project_to_sh

_LOG = logging.getLogger(__name__)


def read_panorama(path: Path) -> NDArray[np.float32]:
    """A lat-long panorama from a .hdr or .exr file: [H, W, 3], linear, finite, at least 0.

    Negative values, left by some stitchers, become 0; infinite ones (a sun beyond half float) the largest
    finite one.

    Raises:
        LightError: missing, unreadable, not .hdr or .exr, not twice as wide as high, or with NaN.
    """
    if path.suffix.lower() not in (".hdr", ".exr"):
        raise LightError(
            f"Panorama {path} is not a .hdr or .exr file; other formats hold no linear radiance."
        )
    try:
        image = np.asarray(read_image(path), dtype=np.float32)
    except RelightError as error:
        raise LightError(f"Panorama {path} cannot be used: {error}") from error
    if image.ndim == 2:
        image = np.stack([image] * 3, axis=-1)
    height, width = image.shape[:2]
    if width != 2 * height:
        raise LightError(
            f"Panorama {path} has {width} x {height} pixels; a lat-long panorama is twice as wide as high."
        )
    if np.isnan(image).any():
        raise LightError(
            f"Panorama {path} has {int(np.isnan(image).sum())} values that are not numbers (NaN)."
        )
    if np.isinf(image).any():
        largest = np.max(image, where=np.isfinite(image), initial=0.0)
        _LOG.warning(
            "Panorama %s has infinite values; they are read as %g, its largest finite one.", path, largest
        )
        image = np.minimum(image, largest)
    return np.maximum(image, 0.0)


def lat_long_directions(height: int, width: int) -> NDArray[np.float64]:
    """Directions [H, W, 3] of the centres of a panorama's cells, unit, world."""
    theta = math.pi * (np.arange(height) + 0.5) / height
    phi = 2.0 * math.pi * (np.arange(width) + 0.5) / width
    theta, phi = np.meshgrid(theta, phi, indexing="ij")
    return np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)], axis=-1)


def lat_long_solid_angles(height: int, width: int) -> NDArray[np.float64]:
    """Solid angles [H] of one cell of each row, steradian, exact: H rows of W cells are 4 pi."""
    edges = np.cos(math.pi * np.arange(height + 1) / height)
    return 2.0 * math.pi / width * (edges[:-1] - edges[1:])


def lat_long_vectors(height: int, width: int) -> NDArray[np.float64]:
    """Integrals [H, W, 3] of the direction over each cell, exact: solid angle times mean direction."""
    theta = math.pi * np.arange(height + 1) / height
    phi = 2.0 * math.pi * np.arange(width + 1) / width
    across = np.diff(theta / 2.0 - np.sin(2.0 * theta) / 4.0)  # integral of sin^2
    upward = np.diff(np.sin(theta) ** 2 / 2.0)  # integral of sin cos
    x = across[:, None] * -np.diff(np.cos(phi))[None, :]
    y = np.repeat(upward[:, None] * (2.0 * math.pi / width), width, axis=1)
    z = across[:, None] * -np.diff(np.sin(phi))[None, :]
    return np.stack([x, y, z], axis=-1)


def panorama_to_sh(panorama: NDArray[np.floating], bands: int = 3) -> Tensor:
    """Spherical harmonics of a panorama's radiance, weighted by solid angle.

    Args:
        panorama: [H, W, C], linear.
        bands: number of bands B; 3 gives the paper's nine coefficients.

    Returns:
        [B^2, C], float64.
    """
    height, width, channels = panorama.shape
    directions = lat_long_directions(height, width)
    solid_angles = lat_long_solid_angles(height, width)
    coefficients = torch.zeros(bands * bands, channels, dtype=torch.float64)
    # In pieces: a 4096 x 2048 panorama would need 600 MB for its basis alone.
    for rows in np.array_split(np.arange(height), max(1, height * width // 65536)):
        coefficients += project_to_sh(
            torch.from_numpy(panorama[rows].reshape(-1, channels).astype(np.float64)),
            torch.from_numpy(directions[rows].reshape(-1, 3)),
            torch.from_numpy(np.repeat(solid_angles[rows], width)),
            bands,
        )
    return coefficients
