"""Tangent frames of normals."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]


def tangents(normals: Floats) -> tuple[Floats, Floats]:
    """Two unit vectors [P, 3] each that make a right-handed frame with unit normals [P, 3].

    Without a branch or a singularity (Duff et al. 2017, "Building an orthonormal basis, revisited").
    """
    x, y, z = normals.T
    sign = np.where(z < 0, np.float32(-1), np.float32(1))
    a = -1.0 / (sign + z)
    b = x * y * a
    first = np.stack([1 + sign * x * x * a, sign * b, -sign * x], axis=1)
    second = np.stack([b, sign + y * y * a, -y], axis=1)
    return first.astype(np.float32), second.astype(np.float32)
