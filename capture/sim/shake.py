"""Motion blur: the hand jerks while some of the frames are exposed."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from capture.cameras import Camera

_STEPS_PER_PX = 1.5  # poses averaged for each pixel of blur


@dataclass(frozen=True)
class ShakeConfig:
    """Which frames are blurred, and how far.

    Attributes:
        share: of the frames that are taken while the hand jerks, 0..1.
        length_px: of the streak in the middle of such a picture.
        seed: of the choice and of the directions.
    """

    share: float = 0.0
    length_px: float = 12.0
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.share <= 1 or not 0 <= self.length_px <= 200:
            raise ValueError(
                f"share {self.share} must lie in 0..1 and length_px {self.length_px} in 0..200 pixels"
            )

    def blurs(self, index: int) -> bool:
        """Whether a frame is blurred."""
        return bool(np.random.default_rng([self.seed, 61, index]).random() < self.share)

    def blur(self, radiance: np.ndarray, camera: Camera, index: int) -> np.ndarray:
        """The frame's radiance [H, W, 3], averaged over poses that turn about the camera's centre.

        The pose in the middle of the exposure is the camera's own. A turn moves the picture by the homography
        K R K^-1 whatever the depth; what comes in over the border is continued from there.
        """
        if not self.blurs(index) or self.length_px == 0:
            return radiance
        angle = np.random.default_rng([self.seed, 62, index]).uniform(0.0, 2 * np.pi)
        axis = np.array([np.cos(angle), np.sin(angle), 0.0])
        whole = self.length_px / camera.K[0, 0]
        steps = max(3, round(_STEPS_PER_PX * self.length_px))
        to_edge = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])  # OpenCV's centres are whole
        total = np.zeros_like(radiance, dtype=np.float32)
        for part in (np.arange(steps) + 0.5) / steps - 0.5:
            turn = Rotation.from_rotvec(whole * part * axis).as_matrix()
            matrix = np.linalg.inv(to_edge) @ camera.K @ turn @ np.linalg.inv(camera.K) @ to_edge
            size = (camera.width, camera.height)
            total += cv2.warpPerspective(
                radiance.astype(np.float32),
                matrix,
                size,
                flags=cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_REPLICATE,
            )
        return total / np.float32(steps)
