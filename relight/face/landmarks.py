"""Landmarks of a face from MediaPipe's face landmarker, where the user has the package and its task file.

Nothing is downloaded, and the package is imported only here. Landmarks are brought onto the cloud, frame
by frame; their medians tell which plane is the face's and where up is. Texels then come from the cloud
as without a network (`relight.face.surface`).

Numbers are those of MediaPipe's canonical face mesh of 468 (478 with irises) points.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from capture.cameras import Camera
from relight.errors import PlanError
from relight.face.lifting import lift
from relight.face.plane import Floats, Plane
from relight.stages import Progress, no_progress

PAIRS = ((33, 263), (133, 362), (61, 291), (98, 327))
"""Outer and inner corners of the eyes, corners of the mouth, wings of the nose: the subject's right, left."""

MIDDLE = (10, 168, 1, 152)
"""On the plane: top of the forehead, between the eyes, tip of the nose, chin."""

_COUNTS = (468, 478)
_MOST_FRAMES = 40
_FEWEST_FRAMES = 3

LoadSrgb = Callable[[int], NDArray[np.uint8]]
"""Gives the picture [H, W, 3] of a frame as stored: sRGB, 8 bits."""


def import_mediapipe() -> ModuleType:
    """The package.

    Raises:
        PlanError: It is not installed.
    """
    try:
        import mediapipe  # type: ignore[import-not-found,unused-ignore]
    except ImportError as error:
        raise PlanError(
            "A face landmark model is given but the package mediapipe is not installed; install it (pip "
            "install mediapipe) or leave the model out: the face is then found from the cloud."
        ) from error
    module: ModuleType = mediapipe
    return module


def detect_landmarks(
    model: Path,
    cameras: Mapping[int, Camera],
    load_srgb: LoadSrgb,
    rotation_deg: int = 0,
    progress: Progress = no_progress,
) -> dict[int, NDArray[np.float64]]:
    """Landmarks of up to 40 frames.

    Args:
        model: The task file, such as face_landmarker.task.
        cameras: By frame index, with the distortion of the stored frames.
        load_srgb: Gives their pictures.
        rotation_deg: Clockwise turn that makes the pictures upright, in which faces are detected.
        progress: Told ("face", fraction).

    Returns:
        Frame index to [468 or 478, 2] pixels of the undistorted frame, centres at 0.5; frames without a face
        are left out.

    Raises:
        PlanError: The package or the file is missing, the file is no such model, or no frame shows a face.
    """
    model = Path(model)
    if not model.is_file():
        raise PlanError(f"The face landmark model {model} does not exist; give the path of a task file.")
    mediapipe = import_mediapipe()
    vision = mediapipe.tasks.vision
    options = vision.FaceLandmarkerOptions(
        base_options=mediapipe.tasks.BaseOptions(model_asset_path=str(model)),
        running_mode=vision.RunningMode.IMAGE,
        num_faces=1,
    )
    try:
        landmarker = vision.FaceLandmarker.create_from_options(options)
    except (RuntimeError, ValueError) as error:
        raise PlanError(f"The face landmark model {model} cannot be loaded ({error}).") from error
    chosen = list(cameras)[:: max(1, -(-len(cameras) // _MOST_FRAMES))]
    found = {}
    with landmarker:
        for k, index in enumerate(chosen):
            picture = np.ascontiguousarray(np.rot90(load_srgb(index), -(rotation_deg // 90)))
            image = mediapipe.Image(image_format=mediapipe.ImageFormat.SRGB, data=picture)
            faces = landmarker.detect(image).face_landmarks
            if faces:
                found[index] = _pixels(faces[0], picture.shape[:2], cameras[index], rotation_deg, model)
            progress("face", (k + 1) / len(chosen))
    if len(found) < _FEWEST_FRAMES:
        raise PlanError(
            f"The landmark model finds a face in {len(found)} of {len(chosen)} frames; at least "
            f"{_FEWEST_FRAMES} are needed."
        )
    return found


def plane_of_landmarks(
    found: Mapping[int, NDArray[np.float64]], cameras: Mapping[int, Camera], points: Floats
) -> tuple[Plane, NDArray[np.float64]]:
    """The face's plane, normal to the subject's left, and the face's up [3], unit.

    Raises:
        PlanError: The landmarks do not lie on the cloud.
    """
    cloud = torch.from_numpy(np.ascontiguousarray(points[np.isfinite(points).all(axis=1)], np.float32))
    numbers = [*(number for pair in PAIRS for number in pair), *MIDDLE]
    lifted = np.stack([lift(cloud, cameras[index], found[index][numbers]) for index in found])
    counts = np.isfinite(lifted[..., 0]).sum(axis=0)
    if (counts == 0).any():
        raise PlanError(
            f"{int((counts == 0).sum())} of the {len(numbers)} landmarks that tell the face's plane never "
            "lie on the cloud; are poses and cloud in the same coordinates?"
        )
    places = np.nanmedian(lifted, axis=0)
    right, left, middle = (
        places[: 2 * len(PAIRS) : 2],
        places[1 : 2 * len(PAIRS) : 2],
        places[2 * len(PAIRS) :],
    )
    across = (left - right).mean(axis=0)
    across /= np.linalg.norm(across)
    on_plane = np.concatenate([0.5 * (left + right), middle])
    up = middle[0] - middle[-1]
    up = up - (up @ across) * across
    return Plane.of(across, float(np.median(on_plane @ across))), np.asarray(up / np.linalg.norm(up))


def _pixels(
    landmarks: Any, shape: tuple[int, ...], camera: Camera, rotation_deg: int, model: Path
) -> NDArray[np.float64]:
    """From 0..1 of the upright picture to pixels of the undistorted frame in the sensor's orientation."""
    if len(landmarks) not in _COUNTS:
        raise PlanError(f"{model} gives {len(landmarks)} landmarks; 468 or 478 are known.")
    height, width = shape
    u, v = (np.array([getattr(mark, axis) for mark in landmarks], float) for axis in "xy")
    u, v = u * width, v * height
    for _ in range(rotation_deg // 90 % 4):  # a quarter turn back, counter-clockwise
        u, v, width, height = v, width - u, height, width
    pixels = np.stack([u, v], axis=1)
    if camera.distortion.any():
        straight = cv2.undistortPoints(
            pixels.reshape(-1, 1, 2), camera.K, camera.opencv_distortion, P=camera.K
        )
        pixels = straight.reshape(-1, 2)
    return pixels
