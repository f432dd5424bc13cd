"""Lens models: what is known of the lens before, and how COLMAP's cameras and ours turn into each other.

Inside the search every frame has the size at which it was looked at; intrinsics are scaled along.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from calib.calibration import Intrinsics

Floats = NDArray[np.float64]

GUESSED_FOCAL = 1.1
"""Focal length over the longer side where nothing is known: 49 degrees, a phone's main lens when it films."""

FOCAL_RANGE = (0.45, 4.0)
"""Focal length over the longer side that a camera for heads can have: 96 to 14 degrees."""

_OPENCV_ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


@dataclass(frozen=True, eq=False)
class Lens:
    """Intrinsics at the size of the frames as they are stored.

    Attributes:
        width, height: Pixels.
        K: [3, 3].
        distortion: [n] in OpenCV's order.
        known: Whether they are calibrated and stay as they are.
        source: Where they come from, in words.
    """

    width: int
    height: int
    K: Floats
    distortion: Floats
    known: bool
    source: str


def starting_lens(
    width: int, height: int, calibrated: Intrinsics | None, exif_focal_px: float | None
) -> Lens:
    """What is known of the lens of frames of a size before the search."""
    if calibrated is not None and calibrated.width * height == calibrated.height * width:
        factor = width / calibrated.width
        K = np.diag([factor, factor, 1.0]) @ calibrated.K
        distortion = np.zeros(0) if calibrated.distortion is None else calibrated.distortion.value
        return Lens(width, height, K, distortion, True, f"calibration ({calibrated.pinhole.source})")
    longer = max(width, height)
    focal, source = GUESSED_FOCAL * longer, f"guess of {GUESSED_FOCAL} x the longer side, refined"
    if exif_focal_px is not None and FOCAL_RANGE[0] <= exif_focal_px / longer <= FOCAL_RANGE[1]:
        focal, source = exif_focal_px, "EXIF focal length, refined"
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    return Lens(width, height, K, np.zeros(0), False, source)


def colmap_camera(lens: Lens, size: tuple[int, int], refine: bool, camera_id: int) -> pycolmap.Camera:
    """The COLMAP camera of a lens for frames looked at with another (width, height).

    An unknown lens gets one focal length and one radial term: enough for phones, and what a walk around a
    head determines well.
    """
    across, down = size[0] / lens.width, size[1] / lens.height
    fx, fy = lens.K[0, 0] * across, lens.K[1, 1] * down
    cx, cy = lens.K[0, 2] * across, lens.K[1, 2] * down
    camera = pycolmap.Camera(camera_id=camera_id, width=size[0], height=size[1])
    distortion = np.zeros(8)
    distortion[: min(len(lens.distortion), 8)] = lens.distortion[:8]
    if not lens.known:
        camera.model = pycolmap.CameraModelId.SIMPLE_RADIAL
        camera.params = [0.5 * (fx + fy), cx, cy, 0.0]
    elif not distortion.any() and not refine:
        camera.model = pycolmap.CameraModelId.PINHOLE
        camera.params = [fx, fy, cx, cy]
    elif not distortion[4:].any():
        camera.model = pycolmap.CameraModelId.OPENCV
        camera.params = [fx, fy, cx, cy, *distortion[:4]]
    else:
        camera.model = pycolmap.CameraModelId.FULL_OPENCV
        camera.params = [fx, fy, cx, cy, *distortion]
    camera.has_prior_focal_length = lens.known
    return camera


def lens_of(camera: pycolmap.Camera, width: int, height: int) -> tuple[Floats, Floats]:
    """K [3, 3] and distortion [n] of a COLMAP camera at the size of the stored frames."""
    across, down = width / camera.width, height / camera.height
    K = np.diag([across, down, 1.0]) @ np.asarray(camera.calibration_matrix(), np.float64)
    named = dict(zip((name.strip() for name in camera.params_info.split(",")), camera.params, strict=True))
    values = np.array([named.get(name, 0.0) for name in _OPENCV_ORDER])
    if "k" in named:
        values[0] = named["k"]
    if not values.any():
        return K, np.zeros(0)
    return K, values if values[4:].any() else values[:4]


def edge_shift_px(camera: pycolmap.Camera) -> float:
    """Mean distance by which distortion moves the middles of the sides and the corners, pixels."""
    x = np.array([0.0, 0.5, 1.0, 0.5, 0.0, 1.0, 0.0, 1.0]) * camera.width
    y = np.array([0.5, 0.0, 0.5, 1.0, 0.0, 0.0, 1.0, 1.0]) * camera.height
    K = np.asarray(camera.calibration_matrix(), np.float64)
    straight = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)], axis=1)
    bent = np.asarray(camera.img_from_cam(straight), np.float64)
    return float(np.hypot(bent[:, 0] - x, bent[:, 1] - y).mean())


def impossible_lens(camera: pycolmap.Camera) -> str | None:
    """What is wrong with a lens that was refined; None = nothing."""
    longer = max(camera.width, camera.height)
    focal = camera.mean_focal_length() / longer
    if not FOCAL_RANGE[0] <= focal <= FOCAL_RANGE[1]:
        return (
            f"the focal length came out as {focal:.2f} x the longer side "
            f"(possible: {FOCAL_RANGE[0]} to {FOCAL_RANGE[1]})"
        )
    shift = edge_shift_px(camera)
    if not shift < 0.15 * longer:
        return f"the lens distortion came out as {shift:.0f} px at the picture's edge"
    return None
