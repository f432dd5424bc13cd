"""Which frames get a depth map, and which others each is compared with.

The light moves with the camera in lit frames, so a frame is compared only with frames of its own kind. Unlit
frames serve where there are enough of them; each kind is asked how much of the path it covers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from capture.cameras import Camera

Floats = NDArray[np.float64]


def directions_from(centre_world: Floats, cameras: Sequence[Camera]) -> Floats:
    """[N, 3] unit vectors from a point to the cameras."""
    towards = np.array([camera.centre_world for camera in cameras]).reshape(-1, 3) - centre_world
    return towards / np.linalg.norm(towards, axis=1, keepdims=True).clip(1e-12)


def spread_out(directions: Floats, count: int) -> list[int]:
    """Places of at most `count` directions that cover all of them evenly (farthest point sampling)."""
    if len(directions) <= count:
        return list(range(len(directions)))
    mean = directions.mean(axis=0)
    chosen = [int(np.argmin(directions @ mean))]  # the end of the path is covered too
    nearest = np.full(len(directions), -1.0)
    while len(chosen) < count:
        nearest = np.maximum(nearest, directions @ directions[chosen[-1]])
        chosen.append(int(np.argmin(nearest)))
    return sorted(set(chosen))


def choose_sources(
    reference: int,
    cameras: Mapping[int, Camera],
    candidates: Sequence[int],
    centre_world: Floats,
    angles_deg: Sequence[float],
    widest_deg: float,
) -> list[int]:
    """Frames to compare a reference with: for each angle one on either side, as nearly as there are some.

    Args:
        reference: Frame index.
        cameras: By frame index.
        candidates: Frames of the same kind; the reference itself is left out.
        centre_world: The point about which angles are measured.
        angles_deg: Wanted angles between the directions to the two cameras.
        widest_deg: No source is further away.
    """
    others = [index for index in candidates if index != reference]
    if not others:
        return []
    own = directions_from(centre_world, [cameras[reference]])[0]
    theirs = directions_from(centre_world, [cameras[index] for index in others])
    offsets = theirs - own
    angles = np.degrees(2.0 * np.arcsin(np.clip(np.linalg.norm(offsets, axis=1) / 2.0, 0.0, 1.0)))
    axis = np.linalg.svd(offsets, full_matrices=False)[2][0]  # along the path
    side = np.where(offsets @ axis < 0, -1.0, 1.0)
    usable = (angles >= 0.4 * min(angles_deg)) & (angles <= widest_deg)
    chosen: list[int] = []
    for wanted in angles_deg:
        for sign in (-1.0, 1.0):
            misfit = np.abs(np.log(np.maximum(angles, 1e-3) / wanted))
            misfit = np.where(usable & (side == sign), misfit, np.inf)
            misfit[chosen] = np.inf
            best = int(np.argmin(misfit))
            if np.isfinite(misfit[best]) and misfit[best] < 0.5:
                chosen.append(best)
    for best in np.argsort(np.abs(np.log(np.maximum(angles, 1e-3) / np.mean(angles_deg)))):
        if len(chosen) >= 2 * len(angles_deg):
            break
        if usable[best] and int(best) not in chosen:
            chosen.append(int(best))
    return [others[place] for place in chosen]
