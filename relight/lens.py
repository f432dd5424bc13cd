"""How much a lens bends, in the only unit that matters to a fit: pixels."""

from __future__ import annotations

import cv2
import numpy as np

from capture.cameras import Camera


def distortion_px(camera: Camera) -> float:
    """How far the lens moves the pixel that it moves most, of those along the border and the diagonals."""
    if not camera.distortion.any():
        return 0.0
    across, down = np.linspace(0, camera.width, 33), np.linspace(0, camera.height, 33)
    pixels = np.concatenate(
        [
            np.stack([across, np.zeros(33)], 1),
            np.stack([across, np.full(33, camera.height)], 1),
            np.stack([np.zeros(33), down], 1),
            np.stack([np.full(33, camera.width), down], 1),
            np.stack([across, down], 1),
        ]
    )
    rays = (pixels - camera.K[:2, 2]) / camera.K.diagonal()[:2]
    straight = np.concatenate([rays, np.ones((len(rays), 1))], 1)
    bent, _ = cv2.projectPoints(straight, np.zeros(3), np.zeros(3), camera.K, camera.opencv_distortion)
    return float(np.linalg.norm(bent.reshape(-1, 2) - pixels, axis=1).max())
