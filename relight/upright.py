"""From the sensor's orientation, in which frames are kept, to the one in which people look at them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture.cameras import Camera

# A clockwise quarter turn takes the pixel (u, v) of a picture of height H to (H - v, u); the axes go along.
_QUARTER_TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def upright_camera(camera: Camera, rotation_deg: int) -> Camera:
    """The camera of the picture turned clockwise: same centre, same rays, lens distortion left out.

    Args:
        camera: In the sensor's orientation.
        rotation_deg: 0, 90, 180 or 270, as a session records it.
    """
    camera = replace(camera, distortion=np.zeros(0))
    for _ in range(rotation_deg // 90 % 4):
        (fx, _, cx), (_, fy, cy) = camera.K[:2]
        cam_from_world = camera.cam_from_world.copy()
        cam_from_world[:3] = _QUARTER_TURN @ cam_from_world[:3]
        camera = replace(
            camera,
            width=camera.height,
            height=camera.width,
            K=np.array([[fy, 0.0, camera.height - cy], [0.0, fx, cx], [0.0, 0.0, 1.0]]),
            cam_from_world=cam_from_world,
        )
    return camera


def upright_picture(picture: NDArray[Any], rotation_deg: int) -> NDArray[Any]:
    """A picture [H, W, ...] turned clockwise."""
    return np.ascontiguousarray(np.rot90(picture, -(rotation_deg // 90)))
