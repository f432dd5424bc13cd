"""Views that repeat another: a hand that stood still gives the solve the same equations again."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from capture.cameras import Camera

SAME_DIRECTION_RAD = np.deg2rad(0.25)
"""Seen from the subject. At half a metre this is 2 mm of the hand: under a pixel of parallax on a head."""

SAME_DISTANCE = 0.005
"""Relative change of the distance to the subject."""

ENOUGH_REPEATS = 4
"""Views of one place that are kept: four halve the noise, and other errors outweigh what more would give."""


def redundant_views(cameras: Mapping[int, Camera], centre_world: np.ndarray | None) -> dict[int, int]:
    """Which unlit views to leave out, each with the view that stands for it.

    Lit views are never left out: they are few, and each gives its own light direction.

    Args:
        cameras: By frame index, in capture order.
        centre_world: [3] middle of the subject; None = unknown, then nothing is redundant.

    Returns:
        Index of the redundant view to index of the first one of its place.
    """
    if centre_world is None:
        return {}
    unlit = [index for index, camera in cameras.items() if camera.flash == 0]
    repeats: dict[int, int] = {}
    redundant = {}
    directions: list[np.ndarray] = []
    distances: list[float] = []
    for index in unlit:
        offset = cameras[index].centre_world - centre_world
        distance = float(np.linalg.norm(offset))
        direction = offset / max(distance, 1e-9)
        twin = _same_place(direction, distance, directions, distances)
        if twin is None:
            directions.append(direction)
            distances.append(distance)
            repeats[index] = 1
            continue
        first = list(repeats)[twin]
        repeats[first] += 1
        if repeats[first] > ENOUGH_REPEATS:
            redundant[index] = first
    return redundant


def _same_place(
    direction: np.ndarray, distance: float, directions: list[np.ndarray], distances: list[float]
) -> int | None:
    """Position of the first kept view at the same place, or None."""
    if not directions:
        return None
    # The chord of unit vectors: an arc cosine would lose these small angles to rounding.
    apart = np.linalg.norm(np.array(directions) - direction, axis=1)
    known = np.array(distances)
    near = (apart < SAME_DIRECTION_RAD) & (np.abs(known / max(distance, 1e-9) - 1) < SAME_DISTANCE)
    return int(np.argmax(near)) if near.any() else None
