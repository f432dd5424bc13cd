"""Position maps from files, as PRNet writes them: folder/NNNNNN.npy per frame, [256, 256, 3] or [.., 2].

The first two channels are the pixels of the stored frame in which the texels lie (integer centres, as PRNet
has them: 0.5 is added), the third, a depth in pixels, is not used: the cloud knows the face's shape better.
What the maps add is which texel is which part of the face.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from capture.cameras import Camera
from relight.errors import PlanError
from relight.face.lifting import lift
from relight.face.plane import Floats, Plane
from relight.face.surface import TEXELS, FaceSurface

_FARTHEST = 4.0  # picture sizes off the picture: further away it is no map of pixels
_MOST_LIFTED = 40
_SMOOTH_TEXELS = 1.5
_NEIGHBOURS = 10


def load_position_maps(folder: Path, cameras: Mapping[int, Camera]) -> dict[int, NDArray[np.float32]]:
    """Reads a folder's maps: frame index to pixels [256, 256, 2] of the undistorted frame, centres at 0.5.

    Frames without a file have no map.

    Raises:
        PlanError: The folder or its files cannot be used.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise PlanError(f"The folder of position maps {folder} does not exist.")
    maps = {}
    for path in sorted(folder.glob("*.npy")):
        if re.fullmatch(r"\d+", path.stem) and int(path.stem) in cameras:
            maps[int(path.stem)] = _read(path, cameras[int(path.stem)])
    if not maps:
        raise PlanError(
            f"{folder} has no position map NNNNNN.npy of a frame with a pose; name them by frame numbers."
        )
    return maps


def surface_of_maps(
    maps: Mapping[int, NDArray[np.float32]], cameras: Mapping[int, Camera], points: Floats, normals: Floats
) -> tuple[FaceSurface, Plane]:
    """The face's surface and plane of symmetry: the maps' texels brought onto the cloud.

    Raises:
        PlanError: Too few texels lie on the cloud.
    """
    chosen = list(maps)[:: max(1, -(-len(maps) // _MOST_LIFTED))]
    cloud = torch.from_numpy(np.ascontiguousarray(points[np.isfinite(points).all(axis=1)], np.float32))
    lifted = np.full((len(chosen), TEXELS, TEXELS, 3), np.nan, np.float32)
    for k, index in enumerate(chosen):
        uv_px = maps[index]
        here = lift(cloud, cameras[index], uv_px)
        lifted[k] = np.where(facing(uv_px)[..., None], here, np.nan)
    counts = np.isfinite(lifted[..., 0]).sum(axis=0)
    valid = counts > 0
    if valid.mean() < 0.1:
        raise PlanError(
            f"Only {valid.mean():.0%} of the texels of the position maps lie on the cloud; are they maps of "
            "these frames, in pixels?"
        )
    places, directions = np.zeros((TEXELS, TEXELS, 3)), np.zeros((TEXELS, TEXELS, 3))
    places[valid] = np.nanmedian(lifted[:, valid], axis=0)
    weight = cv2.GaussianBlur(valid.astype(np.float64), (0, 0), _SMOOTH_TEXELS)
    blurred = cv2.GaussianBlur(places, (0, 0), _SMOOTH_TEXELS)
    places[valid] = blurred[valid] / weight[valid][:, None]
    places[valid], directions[valid] = _onto_cloud(places[valid], points, normals)
    surface = FaceSurface(
        torch.from_numpy(places.astype(np.float32)),
        torch.from_numpy(directions.astype(np.float32)),
        torch.from_numpy(valid),
        torch.from_numpy(valid.copy()),
        None,
    )
    return surface, _plane(places, valid)


def facing(uv_px: Floats) -> NDArray[np.bool_]:
    """[256, 256] whether the map shows a texel from its outer side: there it is not turned over."""
    du, dv = np.gradient(uv_px.astype(np.float64), axis=1), np.gradient(uv_px.astype(np.float64), axis=0)
    area = du[..., 0] * dv[..., 1] - du[..., 1] * dv[..., 0]
    sign = np.sign(np.nansum(area))
    with np.errstate(invalid="ignore"):
        return np.asarray(area * (sign or 1.0) > 0)


def _read(path: Path, camera: Camera) -> NDArray[np.float32]:
    try:
        values: Any = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise PlanError(f"The position map {path} cannot be read ({error}).") from error
    values = np.asarray(values)
    if values.ndim != 3 or values.shape[:2] != (TEXELS, TEXELS) or values.shape[2] not in (2, 3):
        raise PlanError(
            f"The position map {path} is {list(values.shape)}; it must be [256, 256, 3] or [.., 2]."
        )
    if values.dtype.kind not in "fiu" or not np.isfinite(values[..., :2]).all():
        raise PlanError(f"The position map {path} has values that are no finite numbers.")
    uv_px = values[..., :2].astype(np.float64) + 0.5
    limit = _FARTHEST * max(camera.width, camera.height)
    if np.abs(uv_px).max() > limit:
        raise PlanError(f"The position map {path} reaches {np.abs(uv_px).max():.0f} px; is it in pixels?")
    if np.ptp(uv_px.reshape(-1, 2), axis=0).max() < 4.0:
        raise PlanError(
            f"The position map {path} spans {np.ptp(uv_px):.1f} px; it must be in pixels, not 0..1."
        )
    if camera.distortion.any():
        straight = cv2.undistortPoints(
            uv_px.reshape(-1, 1, 2), camera.K, camera.opencv_distortion, P=camera.K
        )
        uv_px = straight.reshape(uv_px.shape)
    return uv_px.astype(np.float32)


def _onto_cloud(places: Floats, points: Floats, normals: Floats) -> tuple[Floats, Floats]:
    """Places [T, 3] brought onto the tangent planes of the cloud about them, and its normals there [T, 3].

    Depths read from pixels step by a pixel's and a point's width, which would spoil any normals of theirs.
    """
    good = np.isfinite(points).all(axis=1) & np.isfinite(normals).all(axis=1)
    points, normals = points[good], normals[good]
    distances, ids = cKDTree(points).query(places, k=min(_NEIGHBOURS, len(points)), workers=1)
    width = np.maximum(np.median(distances, axis=1, keepdims=True), 1e-12)
    weight = np.exp(-0.5 * (distances / width) ** 2)
    weight /= weight.sum(axis=1, keepdims=True)
    mean = (weight[..., None] * normals[ids]).sum(axis=1)
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9)
    height = (weight * ((places[:, None] - points[ids]) * normals[ids]).sum(axis=-1)).sum(axis=1)
    return places - height[:, None] * mean, mean


def _plane(points: Floats, valid: NDArray[np.bool_]) -> Plane:
    """The plane between texels and their mirror images: across it on average, through their middles."""
    both = valid & valid[:, ::-1]
    both[:, TEXELS // 2 :] = False
    if not both.any():
        raise PlanError(
            "The position maps show one half of the face only; no symmetry can be taken from them."
        )
    left, right = points[:, ::-1][both], points[both]
    across = np.median(left - right, axis=0)
    return Plane.of(across, float(np.median(0.5 * (left + right) @ across)))
