"""Where the head is: a sphere found from where the cameras look and from what the flash lights.

1. The cameras look at the head, so the point that their optical axes pass nearest to lies in it, or near it.
2. The flash is at the camera and falls off with 1/d^2, so it adds far more to the head than to the room:
   (lit - unlit) / unlit, free of the subject's albedo, stands out on the head in every lit frame. The boxes
   of a coarse grid that stand out in nearly all lit frames are the head, its neck and shoulders.
3. Where masks are given, they take the place of that ratio. Where there is neither, the sphere is what a
   picture shows at the distance of the head.

No face is looked for: a statue, a helmet or the back of a head serve as well. All lengths are multiples of
the cameras' distance, so the unit of the poses does not matter.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from capture.cameras import Camera
from capture.frame_record import FrameRecord
from capture.session import Session
from relight.errors import GeometryError

Floats = NDArray[np.float64]

_WORKING_PX = 96  # long side of the pictures in which the head is looked for
_MOST_FRAMES = 12
_STANDS_OUT = 0.3  # of the ratio in the middle of the head: at twice the distance the flash adds a quarter
_FLOOR = 0.004  # radiance of one 8-bit code in the shadows
_SHARE = 0.8  # of the frames that have a box in the picture
_GRID = 40  # boxes along a side
_MARGIN = 1.1
_FEWEST_BOXES = 60
_PARALLEL = 1e-4  # smallest eigenvalue of the mean projector: axes within about half a degree of each other


@dataclass(frozen=True, eq=False)
class HeadRegion:
    """A sphere that holds head, neck and the beginning of the shoulders.

    Attributes:
        centre_world: [3].
        radius: In world units.
        source: What it was found from: "masks", "flash" or "field of view".
    """

    centre_world: Floats
    radius: float
    source: str


def find_head_region(
    session: Session, cameras: Mapping[int, Camera], sparse_points: NDArray[np.floating] | None = None
) -> HeadRegion:
    """The head's sphere.

    Args:
        session: Only read; pictures of a few frames are.
        cameras: By frame index.
        sparse_points: [P, 3] world. Used only when the optical axes are parallel; may be empty or None.

    Raises:
        GeometryError: Fewer than two cameras, or they look at no common point.
    """
    records = {r.index: r for r in session.frames if r.usable and r.split != "val" and r.index in cameras}
    if len(records) < 2:
        raise GeometryError(
            f"Only {len(records)} usable frames of {session.path} have a pose; finding the head needs 2."
        )
    posed = [cameras[index] for index in records]
    looked_at = _looked_at(posed, sparse_points)
    depths = np.array([_depth(camera, looked_at) for camera in posed])
    before = float(np.mean(depths > 0))
    if before < 0.5:
        raise GeometryError(
            f"Only {100 * before:.0f} % of the cameras have the point that they look at before them; the "
            "poses are wrong, or the camera did not look at the subject."
        )
    seen = _field_of_view_radius(posed, depths)
    limit = min(1.15 * seen, 0.75 * float(np.percentile(depths[depths > 0], 10)))
    inside, source = _evidence(session, records, cameras, looked_at)
    grid = _grid(looked_at, limit)
    boxes = grid[_in_most(grid, inside)] if inside else grid[:0]
    if len(boxes) < _FEWEST_BOXES:
        return HeadRegion(looked_at, min(seen, limit), "field of view")
    low, high = np.percentile(boxes, [1, 99], axis=0)
    centre = (low + high) / 2.0
    reach = float(np.percentile(np.linalg.norm(boxes - centre, axis=1), 99)) + limit / _GRID
    return HeadRegion(centre, min(_MARGIN * reach, limit), source)


def _looked_at(cameras: Sequence[Camera], sparse_points: NDArray[np.floating] | None) -> Floats:
    """[3] the point nearest to the optical axes: least squares of distances, reweighted by Cauchy."""
    centres = np.array([camera.centre_world for camera in cameras])
    axes = np.array([camera.cam_from_world[2, :3] for camera in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    weight = np.ones(len(cameras))
    for _ in range(10):
        mean = np.einsum("n,nij->ij", weight, across) / weight.sum()
        if np.linalg.eigvalsh(mean)[0] < _PARALLEL:
            return _before_parallel_axes(centres, axes, sparse_points)
        right = np.einsum("n,nij,nj->i", weight, across, centres) / weight.sum()
        point = np.linalg.solve(mean, right)
        misses = np.linalg.norm(np.einsum("nij,nj->ni", across, point - centres), axis=1)
        weight = 1.0 / (1.0 + (misses / (2.0 * np.median(misses) + 1e-12)) ** 2)
    return np.asarray(point, np.float64)


def _before_parallel_axes(
    centres: Floats, axes: Floats, sparse_points: NDArray[np.floating] | None
) -> Floats:
    """[3] the middle of the nearer sparse points, for cameras that all look the same way."""
    axis = axes.mean(axis=0) / max(float(np.linalg.norm(axes.mean(axis=0))), 1e-12)
    origin = centres.mean(axis=0)
    depths = np.zeros(0)
    if sparse_points is not None and len(sparse_points):
        depths = (np.asarray(sparse_points, np.float64) - origin) @ axis
        depths = depths[np.isfinite(depths) & (depths > 0)]
    if not len(depths):
        raise GeometryError(
            "All cameras look the same way and no sparse points tell how far the subject is; move the camera "
            "around the head while filming."
        )
    return np.asarray(origin + axis * np.percentile(depths, 25), np.float64)


def _depth(camera: Camera, point: Floats) -> float:
    return float(camera.cam_from_world[2, :3] @ point + camera.cam_from_world[2, 3])


def _field_of_view_radius(cameras: Sequence[Camera], depths: Floats) -> float:
    """Half of what the longer side of a picture shows at the subject's distance (median)."""
    halves = [max(camera.width / camera.K[0, 0], camera.height / camera.K[1, 1]) / 2.0 for camera in cameras]
    return float(np.median((depths * np.array(halves))[depths > 0]))


Silhouette = Callable[[Floats], tuple[NDArray[np.bool_], NDArray[np.bool_]]]
"""Tells of points [N, 3] whether they project into a picture, and whether onto the subject there."""


def _evidence(
    session: Session, records: Mapping[int, FrameRecord], cameras: Mapping[int, Camera], looked_at: Floats
) -> tuple[list[Silhouette], str]:
    masked = [index for index in records if session.mask_path(index).is_file()]
    if len(masked) >= 3:
        chosen = masked[:: -(-len(masked) // _MOST_FRAMES)]
        found = []
        for index in chosen:
            mask = session.load_mask(records[index])
            if mask is not None and mask.any():
                found.append(_silhouette(cameras[index], _small(mask.astype(np.float32) / 255.0) > 0.5))
        if found:
            return found, "masks"
    lit = [index for index in records if records[index].flash == 1]
    unlit = [index for index in records if records[index].flash == 0]
    if not unlit:
        return [], "field of view"
    found = []
    for index in lit[:: max(1, -(-len(lit) // _MOST_FRAMES))]:
        views = np.array([cameras[other].centre_world for other in unlit])
        beside = unlit[int(np.argmin(np.linalg.norm(views - cameras[index].centre_world, axis=1)))]
        added = _flash_ratio(session, records[index], records[beside])
        head = _standing_out(added, cameras[index], looked_at)
        if head is not None:
            found.append(_silhouette(cameras[index], head))
    return found, "flash"


def _flash_ratio(session: Session, lit: FrameRecord, unlit: FrameRecord) -> NDArray[np.float32]:
    """[h, w] small picture of (lit - unlit) / unlit, blurred by more than the frames are apart."""
    pictures = [
        cv2.GaussianBlur(_small(np.nan_to_num(session.load_radiance(record)).mean(axis=2)), (0, 0), 1.5)
        for record in (lit, unlit)
    ]
    with_flash, without = (np.clip(picture, np.float32(0.0), np.float32(1.0)) for picture in pictures)
    if with_flash.shape != without.shape:
        without = cv2.resize(without, with_flash.shape[::-1], interpolation=cv2.INTER_AREA)
    return np.asarray((with_flash - without) / (without + _FLOOR), np.float32)


def _standing_out(ratio: NDArray[np.float32], camera: Camera, looked_at: Floats) -> NDArray[np.bool_] | None:
    """[h, w] what the flash lights about as much as it does the point looked at; None if it lights nothing
    there."""
    at = camera.cam_from_world[:3, :3] @ looked_at + camera.cam_from_world[:3, 3]
    if at[2] <= 0:
        return None
    height, width = ratio.shape
    u = (camera.K[0, 0] * at[0] / at[2] + camera.K[0, 2]) * width / camera.width
    v = (camera.K[1, 1] * at[1] / at[2] + camera.K[1, 2]) * height / camera.height
    rows, columns = np.mgrid[:height, :width] + 0.5
    about = (rows - v) ** 2 + (columns - u) ** 2 < (0.12 * max(height, width)) ** 2
    if not about.any():
        return None
    usual = float(np.median(ratio[about]))
    if usual < 0.1:  # ten percent more than the room: not to be told from a change of exposure
        return None
    head = ratio > _STANDS_OUT * usual
    labels = cv2.connectedComponents(head.astype(np.uint8))[1]
    touched = np.bincount(labels[about & head], minlength=int(labels.max()) + 1)
    return np.asarray(labels == int(np.argmax(touched)), bool)


def _small(picture: NDArray[np.float32]) -> NDArray[np.float32]:
    factor = _WORKING_PX / max(picture.shape[:2])
    if factor >= 1.0:
        return np.asarray(picture, np.float32)
    size = (max(8, round(picture.shape[1] * factor)), max(8, round(picture.shape[0] * factor)))
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.float32)


def _silhouette(camera: Camera, head: NDArray[np.bool_]) -> Silhouette:
    height, width = head.shape

    def test(points: Floats) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        at = points @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
        z = np.where(at[:, 2] > 0, at[:, 2], 1.0)
        u = (camera.K[0, 0] * at[:, 0] / z + camera.K[0, 2]) * width / camera.width
        v = (camera.K[1, 1] * at[:, 1] / z + camera.K[1, 2]) * height / camera.height
        shown = (at[:, 2] > 0) & (u >= 0) & (v >= 0) & (u < width) & (v < height)
        u, v = np.where(shown, u, 0).astype(int), np.where(shown, v, 0).astype(int)
        return shown, shown & head[v, u]

    return test


def _grid(centre: Floats, reach: float) -> Floats:
    steps = (np.arange(_GRID) + 0.5) / _GRID * 2.0 - 1.0
    boxes = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.asarray(centre + reach * boxes[np.linalg.norm(boxes, axis=1) <= 1.0], np.float64)


def _in_most(points: Floats, silhouettes: Sequence[Silhouette]) -> NDArray[np.bool_]:
    shown_in, head_in = np.zeros(len(points)), np.zeros(len(points))
    for test in silhouettes:
        shown, head = test(points)
        shown_in += shown
        head_in += head
    return np.asarray((shown_in >= 0.5 * len(silhouettes)) & (head_in >= _SHARE * shown_in), bool)
