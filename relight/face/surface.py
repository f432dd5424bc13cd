"""The face unrolled: for each texel of a symmetric texture the point of the surface and its normal.

A cylinder about the head's upright axis. Columns run from the subject's right (0) to the left (255), as
one sees a face in a picture. Column j and 255 - j are mirror images: the plane of symmetry is the seam
between columns 127 and 128; the left half of the texture is the subject's right. Row 0 is at the top. A
texel lies where the ray from the axis leaves the head (the outermost surface).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from relight.face.frame import HeadFrame
from relight.face.plane import Floats

TEXELS = 256
"""Side of the texture, as PRNet has it."""

HALF_ANGLE_RAD = 1.484
"""The texture spans 85 degrees to either side of the face's direction."""

TOP, BOTTOM = 0.85, -0.65
"""Heights that the texture spans, in breadths from the tip of the nose: hairline and chin lie within."""

_NEIGHBOURS = 10
_THICKNESS = 0.08  # breadths under the outermost point that still count as the surface
_GAP = 3.0  # typical distances between points over which the surface is interpolated
_ROLLED = 0.6  # breadths from axis to surface, typically: what an angle is worth
_FACE_ANGLE_RAD = 1.22  # half-width of the face at the height of the nose: 70 degrees, before the ears
_FACE_TOP, _FACE_BOTTOM = 0.68, -0.56
_NECK = 0.75  # of the face's radius: what lies deeper is the neck under the jaw
_SKIN_RATIO = (0.4, 2.5)  # albedo of skin over the median of nose and cheeks; brows and lips are filled


@dataclass(frozen=True, eq=False)
class FaceSurface:
    """Per texel of the texture, [256, 256] of them.

    Attributes:
        points: [256, 256, 3] float32, world; meaningless where not valid.
        normals_world: [256, 256, 3] float32, unit, outwards; 0 where not valid.
        valid: [256, 256] bool, where the cloud has a surface.
        region: [256, 256] bool, where the face is: without ears, neck and, where albedo tells, hair.
        albedo: [256, 256, 3] float32 of the cloud, 0 where not valid; None = the cloud has none.
    """

    points: torch.Tensor
    normals_world: torch.Tensor
    valid: torch.Tensor
    region: torch.Tensor
    albedo: torch.Tensor | None


def unroll(points: Floats, normals: Floats, albedo: Floats | None, frame: HeadFrame) -> FaceSurface:
    """The surface of a head in texels.

    Args:
        points: [P, 3], world, the head or more; non-finite and stray ones do no harm.
        normals: [P, 3], unit, outwards.
        albedo: [P, 3] linear, or None.
        frame: Of the head.
    """
    local, turned = frame.local(points), normals @ frame.axes.T
    angle, radius = np.arctan2(local[:, 0], local[:, 2]), np.hypot(local[:, 0], local[:, 2])
    outwards = (turned[:, 0] * np.sin(angle) + turned[:, 2] * np.cos(angle)) > 0.05
    with np.errstate(invalid="ignore"):
        near = (np.abs(angle) < HALF_ANGLE_RAD + 0.2) & (radius > 0.1) & (radius < 1.6) & outwards
        near &= (local[:, 1] < TOP + 0.1) & (local[:, 1] > BOTTOM - 0.1)
    kept = np.flatnonzero(near)
    if len(kept) > 4 * _NEIGHBOURS:
        kept = kept[_outermost(angle[kept], local[kept, 1], radius[kept])]
    if len(kept) <= 4 * _NEIGHBOURS:
        nothing = torch.zeros(TEXELS, TEXELS, 3)
        none = torch.zeros(TEXELS, TEXELS, dtype=torch.bool)
        return FaceSurface(nothing, nothing.clone(), none, none.clone(), None)
    rays, feet, weight, ids, valid, reach = _reached(local[kept], turned[kept], angle[kept], radius[kept])
    direction = (weight[..., None] * turned[kept][ids]).sum(axis=1)
    length = np.linalg.norm(direction, axis=1, keepdims=True)
    valid &= length[:, 0] > 0.3
    shape = (TEXELS, TEXELS)
    normal = np.where(valid[:, None], direction / np.maximum(length, 1e-6), 0.0) @ frame.axes
    colours = None
    if albedo is not None:
        colours = (weight[..., None] * np.nan_to_num(albedo[kept][ids])).sum(axis=1) * valid[:, None]
        colours = colours.reshape(*shape, 3)
    valid = valid.reshape(shape)
    return FaceSurface(
        points=_tensor(frame.world(feet + reach[:, None] * rays).reshape(*shape, 3)),
        normals_world=_tensor(normal.reshape(*shape, 3)),
        valid=torch.from_numpy(valid),
        region=torch.from_numpy(_region(valid, reach.reshape(shape), colours)),
        albedo=None if colours is None else _tensor(colours),
    )


def texel_places() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Heights [256] of the rows in breadths, and angles [256] of the columns in radians."""
    steps = (np.arange(TEXELS) + 0.5) / TEXELS
    return TOP + (BOTTOM - TOP) * steps, HALF_ANGLE_RAD * (2.0 * steps - 1.0)


def _reached(
    local: Floats, turned: Floats, angle: Floats, radius: Floats
) -> tuple[Floats, Floats, Floats, NDArray[np.int64], NDArray[np.bool_], Floats]:
    """Where the texels' rays leave the surface of points in the head's frame.

    Returns:
        Rays [T, 3] and their feet on the axis [T, 3], breadths; weights [T, k] and ids [T, k] of the points
        about them; whether there are any near enough [T]; lengths of the rays [T].
    """
    flat = np.stack([angle * _ROLLED, local[:, 1]], axis=1)
    tree = cKDTree(flat)
    spacing = float(np.median(tree.query(flat[:: max(1, len(flat) // 4000)], k=[5], workers=1)[0])) / 1.26
    rows, columns = texel_places()
    at = np.stack(np.meshgrid(columns * _ROLLED, rows, indexing="xy"), axis=-1).reshape(-1, 2)
    distances, ids = tree.query(at, k=_NEIGHBOURS, workers=1)
    weight = np.exp(-0.5 * (distances**2 - distances[:, :1] ** 2) / max(spacing, 1e-12) ** 2)
    rays = np.stack([np.sin(at[:, 0] / _ROLLED), np.zeros(len(at)), np.cos(at[:, 0] / _ROLLED)], axis=1)
    feet = np.stack([np.zeros(len(at)), at[:, 1], np.zeros(len(at))], axis=1)
    slant = (turned[ids] * rays[:, None]).sum(axis=-1)
    # Where the ray meets the neighbours' tangent planes; of planes along the ray, the neighbour itself.
    lengths = ((local[ids] - feet[:, None]) * turned[ids]).sum(axis=-1) / np.maximum(slant, 0.2)
    lengths = np.clip(lengths, radius[ids] - 3 * spacing, radius[ids] + 3 * spacing)
    middle = np.median(lengths, axis=1, keepdims=True)
    weight /= 1.0 + ((lengths - middle) / max(2.0 * spacing, 1e-12)) ** 2
    weight /= weight.sum(axis=1, keepdims=True)
    valid = distances[:, 0] < max(_GAP * spacing, 2.0 / TEXELS)
    return rays, feet, weight, ids, valid, (weight * lengths).sum(axis=1)


def _outermost(angle: Floats, height: Floats, radius: Floats) -> NDArray[np.int64]:
    """Indices of the points not far under the outermost ones about them."""
    side = int(np.clip(np.sqrt(len(angle) / 24.0), 8, 96))
    column = ((angle / HALF_ANGLE_RAD * 0.4 + 0.5) * side).astype(np.int64).clip(0, side - 1)
    row = ((height - BOTTOM) / (TOP - BOTTOM) * 0.8 * side + 0.1 * side).astype(np.int64).clip(0, side - 1)
    place = row * side + column
    order = np.lexsort((radius, place))
    ends = np.searchsorted(place[order], np.arange(side * side), side="right")
    counts = np.bincount(place, minlength=side * side)
    # Not the very outermost but the one a tenth below: strays stick out.
    pick = np.clip(ends - 1 - counts // 10, 0, len(order) - 1)
    top = np.where(counts > 0, radius[order[pick]], 0.0)
    kept: NDArray[np.int64] = np.flatnonzero(
        (radius > top[place] - _THICKNESS) & (radius < top[place] + _THICKNESS)
    )
    return kept


def _region(
    valid: NDArray[np.bool_], radius: Floats, albedo: NDArray[np.float64] | None
) -> NDArray[np.bool_]:
    """Where the face is: an oval without the neck, and in it what hangs together with the nose."""
    rows, columns = texel_places()
    middle, half = 0.5 * (_FACE_TOP + _FACE_BOTTOM), 0.5 * (_FACE_TOP - _FACE_BOTTOM)
    across, along = np.abs(columns / _FACE_ANGLE_RAD)[None], np.abs((rows - middle) / half)[:, None]
    oval = (across**2.5 + along**2.5 < 1.0) & valid
    if oval.any():
        oval &= radius > _NECK * float(np.median(radius[oval]))
    if albedo is None:
        return oval
    level = albedo.mean(axis=-1)
    centre = oval & (np.abs(rows)[:, None] < 0.2) & (np.abs(columns)[None] < 0.7)
    if not centre.any():
        return oval
    ratio = level / max(float(np.median(level[centre])), 1e-6)
    skin = oval & (ratio > _SKIN_RATIO[0]) & (ratio < _SKIN_RATIO[1])
    # Brows, eyes, nostrils and lips are islands or inlets some texels wide; a fringe or a beard is more.
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (17, 17))
    closed = cv2.morphologyEx(skin.astype(np.uint8), cv2.MORPH_CLOSE, kernel)
    _, labels = cv2.connectedComponents(closed)
    inside = labels[centre]
    inside = inside[inside > 0]
    if not len(inside):
        return oval
    kept = (labels == np.bincount(inside).argmax()).astype(np.uint8)
    holes = cv2.morphologyEx(kept, cv2.MORPH_CLOSE, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (25, 25)))
    return np.asarray((holes > 0) & oval)


def _tensor(values: Floats) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))
