"""Small pictures brought into register with their neighbours at a few depths.

The depth of a pixel is sought among those of the subject's cloud, continued beyond its outline, and planes
behind it out to far away. Where a neighbour was taken under the same light its colours must match, else its
detail must. What matches at the subject's depth better than behind it is the subject (parallax): between
frames the head stands still and the room moves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from capture.cameras import Camera
from relight.masks.frames import Floats, Frame, FrameSource

NEAR_DEPTHS = (0.9, 0.95, 1.0, 1.05, 1.1)
"""Hypotheses for the subject, factors on the depth of its cloud."""
FAR_DEPTHS = (1.45, 1.8, 2.3, 3.0, 4.2, 7.0, 16.0)
"""Hypotheses for the background, factors on the subject's median depth."""
NOISE = 0.004
"""Radiance: a step of 8-bit sRGB where it is coarse, and some sensor noise."""

_NEIGHBOURS = 3
_WIDEST_TURN = 0.22  # of the distance: neighbours further off see another side
_LEAST_STEP = 0.02  # of the distance: nearer ones of the same light have no parallax
_RELATIVE_NOISE = 0.03
_DETAIL_NOISE = 0.05
_WORST = 6.0  # cost, in standard deviations, that counts as no match
_LIMIT = 3.0  # of the evidence, in log-odds


@dataclass(frozen=True, eq=False)
class Register:
    """A frame's neighbours in register with it.

    Attributes:
        parallax: [h, w] log-odds of being the subject by the match, 0 where nothing is known.
        radiance: [h, w, 3] of the neighbours, at the depth that matches best.
        matched: [h, w] bool, whether any depth does.
    """

    parallax: Floats
    radiance: Floats
    matched: NDArray[np.bool_]


def neighbours(frame: Frame, frames: Sequence[Frame], flash: int, distance: float) -> list[Frame]:
    """The nearest frames of a flash state by place of the camera, from both sides of the path.

    Args:
        frame: The frame in question.
        frames: Those to choose from.
        flash: 1 or 0.
        distance: From cameras to subject, world units.
    """
    found = []
    for candidate in frames:
        if candidate.index != frame.index and candidate.flash == flash:
            apart = float(np.linalg.norm(candidate.camera.centre_world - frame.camera.centre_world))
            if apart <= _WIDEST_TURN * distance:
                found.append((apart, candidate.index, candidate))
    if frame.flash == flash:
        found = [entry for entry in found if entry[0] > _LEAST_STEP * distance] or found
    sides: tuple[list[Frame], list[Frame]] = ([], [])
    for _, _, candidate in sorted(found, key=lambda entry: entry[:2]):
        sides[candidate.index > frame.index].append(candidate)
    chosen: list[Frame] = []
    while len(chosen) < _NEIGHBOURS and (sides[0] or sides[1]):
        for side in sides:
            if side and len(chosen) < _NEIGHBOURS:
                chosen.append(side.pop(0))
    return chosen


def register(
    frame: Frame, around: Sequence[Frame], source: FrameSource, depth: Floats, inside: NDArray[np.bool_]
) -> Register:
    """Brings neighbours, at least one, into register with a frame.

    Args:
        frame: Whose small picture is the reference.
        around: Neighbours, all of one flash state.
        source: Where the pictures are.
        depth: [h, w] of the subject, continued beyond its outline.
        inside: [h, w], where the cloud covers; covers at least a pixel.
    """
    picture = source.small(frame)
    middle = float(np.median(depth[inside]))
    depths = [np.float32(factor) * depth for factor in NEAR_DEPTHS]
    depths += [np.full_like(depth, factor * middle) for factor in FAR_DEPTHS]
    same_light = around[0].flash == frame.flash
    detail = _detail(picture)
    lines = [epipolar(frame.small, neighbour.small) for neighbour in around]
    pictures = [source.small(neighbour) for neighbour in around]
    details = pictures if same_light else [_detail(each) for each in pictures]
    reference = picture if same_light else detail
    best = [np.full(depth.shape, np.inf, np.float32) for _ in range(2)]
    chosen = np.zeros(depth.shape, np.int64)
    for k, hypothesis in enumerate(depths):
        cost = _cost(reference, details, lines, hypothesis, same_light)
        side = best[k >= len(NEAR_DEPTHS)]
        chosen[cost < np.minimum(*best)] = k
        np.minimum(side, cost, out=side)
    near, far = best
    known = np.isfinite(near) & np.isfinite(far)
    odds = np.zeros_like(near)
    odds[known] = np.clip(0.5 * (far[known] ** 2 - near[known] ** 2), -_LIMIT, _LIMIT)
    registered = np.choose(chosen, depths).astype(np.float32)
    radiance, _ = mean_at(pictures, lines, registered)
    return Register(odds, radiance, np.minimum(near, far) < _WORST)


def carried(
    maps: Sequence[Floats], cameras: Sequence[Camera], camera: Camera, depth: Floats
) -> tuple[Floats, Floats]:
    """Maps [h, w] of other cameras' pictures seen from a camera, at given depths, and where any was.

    Returns:
        Mean [h, w] of the maps that have the pixel, and their number.
    """
    lines = [epipolar(camera, other) for other in cameras]
    return mean_at(maps, lines, depth)


def epipolar(
    camera: Camera,
    other: Camera,
    u: NDArray[np.floating] | None = None,
    v: NDArray[np.floating] | None = None,
) -> tuple[Floats, Floats]:
    """Factors a [..., 3] and b [3]: a pixel (u, v) at depth z is at z a + b in another picture, homogeneous.

    Without pixels [...] all of the picture's [h, w].
    """
    if u is None or v is None:
        u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    pixels = np.stack([u, v, np.ones_like(u)], axis=-1)
    matrix = other.K @ other.cam_from_world[:3, :3]
    towards = matrix @ camera.cam_from_world[:3, :3].T @ np.linalg.inv(camera.K)
    start = matrix @ camera.centre_world + other.K @ other.cam_from_world[:3, 3]
    return (pixels @ towards.T).astype(np.float32), start.astype(np.float32)


def _warped(picture: Floats, line: tuple[Floats, Floats], depth: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """A picture [h, w, C] or [h, w] read where a camera's pixels of a depth [...] are in it, and whether they
    are in it at all."""
    at = [line[0][..., axis] * depth + line[1][axis] for axis in range(3)]
    z = np.maximum(at[2], np.float32(1e-9))
    u, v = at[0] / z, at[1] / z
    height, width = picture.shape[:2]
    inside = (at[2] > 1e-9) & (u >= 0) & (v >= 0) & (u < width) & (v < height)
    u, v = (np.clip(value, -1e4, 1e4) - np.float32(0.5) for value in (u, v))
    warped = cv2.remap(picture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(warped, np.float32).reshape(*depth.shape, *picture.shape[2:]), inside


def _cost(
    reference: Floats,
    pictures: Sequence[Floats],
    lines: Sequence[tuple[Floats, Floats]],
    depth: Floats,
    same_light: bool,
) -> Floats:
    """How badly a depth fits [h, w], in standard deviations; infinite where no neighbour has the pixel."""
    costs = []
    for picture, line in zip(pictures, lines, strict=True):
        warped, inside = _warped(picture, line, depth)
        apart = np.abs(reference - warped)
        if same_light:
            sigma = NOISE + _RELATIVE_NOISE * reference[..., 1]
            cost = (apart[..., 0] + apart[..., 1] + apart[..., 2]) / (3.0 * sigma)
        else:
            cost = apart / np.float32(_DETAIL_NOISE)
        cost = cv2.blur(np.minimum(cost, np.float32(_WORST)), (3, 3))
        costs.append(np.where(inside, cost, np.float32(np.inf)))
    # What hides behind the subject on one side shows on the other: the better half decides.
    stack = np.sort(np.stack(costs), axis=0)
    seen = np.isfinite(stack).sum(axis=0)
    cost = stack[0]
    if len(costs) > 2:
        cost = np.where(seen > 2, 0.5 * (stack[0] + np.where(seen > 1, stack[1], stack[0])), cost)
    return np.asarray(cost, np.float32)


def mean_at(
    pictures: Sequence[Floats], lines: Sequence[tuple[Floats, Floats]], depth: Floats
) -> tuple[Floats, Floats]:
    """Mean [...] or [..., C] of pictures at a depth [...] over those that have the pixel; their number."""
    total, count = None, np.zeros(depth.shape, np.float32)
    for picture, line in zip(pictures, lines, strict=True):
        warped, inside = _warped(picture, line, depth)
        warped = warped * (inside if warped.ndim == inside.ndim else inside[..., None])
        total = warped if total is None else total + warped
        count += inside
    assert total is not None
    share = np.maximum(count, 1.0)
    return (total / (share if total.ndim == share.ndim else share[..., None])).astype(np.float32), count


def _detail(picture: Floats) -> Floats:
    """[h, w] what of a picture stays under another light: log radiance less its surroundings."""
    grey = np.log(picture.mean(axis=-1) + np.float32(4.0 * NOISE))
    return np.asarray(grey - cv2.GaussianBlur(grey, (0, 0), 3.0), np.float32)
