"""The flash as evidence: what it lights is near.

With a lit frame and its unlit neighbours in register, the ratio

    (lit - unlit) / unlit = C_flash / (C_room s) max(0, <n, l>) / d^2

does not depend on the albedo and falls with the square of the distance (Sevastopolsky 2020, eqs. 1-3): a
head at 0.5 m has 16 times that of a wall at 2 m. How large it is on subject and background is learned in
each frame from pixels that are surely either. Dark pixels (hair, black cloth), whose ratio drowns in the
sensor's steps, say little and are weighted so. Unlit frames take the evidence of the lit ones beside them,
carried over at the subject's depth.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from relight.masks.frames import Floats
from relight.masks.sweep import NOISE, Register

LEAST_SEPARATION = 1.0
"""Standard deviations between subject and background below which the ratio says nothing."""

_LIMIT = 4.0  # of the evidence, in log-odds
_LEAST_SPREAD = 0.08  # of the log ratio: shading and registration are never better
_FEWEST = 50  # sure pixels of either kind
_SURE_INSIDE, _SURE_OUTSIDE = 0.03, 0.08  # of the picture's longer side, from the cloud's outline


@dataclass(frozen=True, eq=False)
class FlashEvidence:
    """Of one lit frame.

    Attributes:
        odds: [h, w] float32 log-odds of being the subject, 0 where nothing is known.
        separation: Between subject and background, standard deviations; 0 = not measured.
    """

    odds: Floats
    separation: float


def flash_evidence(lit: Floats, unlit: Register, distance_px: Floats) -> FlashEvidence:
    """The evidence of a lit frame [h, w, 3] and its unlit neighbours.

    Args:
        lit: Small picture.
        unlit: Neighbours in register with it.
        distance_px: [h, w] to the outline of the cloud, positive inside: tells the sure pixels.
    """
    ratio, trust = log_ratio(lit, unlit.radiance)
    return by_ratio(ratio, trust * unlit.matched, distance_px)


def log_ratio(lit: Floats, unlit: Floats) -> tuple[Floats, Floats]:
    """Log of lit over unlit radiance [h, w], and how far above the noise it is, 0..1."""
    bright, dark = (cv2.blur(np.maximum(values.mean(axis=-1), 0.0), (3, 3)) for values in (lit, unlit))
    ratio = np.log((bright + NOISE) / (dark + NOISE))
    trust = (bright + dark) / (bright + dark + 4.0 * NOISE)
    return np.asarray(ratio, np.float32), np.asarray(trust, np.float32)


def by_ratio(ratio: Floats, trust: Floats, distance_px: Floats) -> FlashEvidence:
    """Log-odds of a ratio [h, w], by what subject and background have in the sure pixels of the frame."""
    size = max(ratio.shape)
    sure = distance_px > _SURE_INSIDE * size, distance_px < -_SURE_OUTSIDE * size
    known = [ratio[which & (trust > 0.3)] for which in sure]
    if min(map(len, known)) < _FEWEST:
        return FlashEvidence(np.zeros_like(ratio), 0.0)
    near, far = (float(np.median(values)) for values in known)
    near_spread, far_spread = (
        max(_LEAST_SPREAD, 1.4826 * float(np.median(np.abs(values - middle))))
        for values, middle in zip(known, (near, far), strict=True)
    )
    variance = 0.5 * (near_spread**2 + far_spread**2)
    separation = (near - far) / variance**0.5
    if separation < LEAST_SEPARATION:
        return FlashEvidence(np.zeros_like(ratio), max(separation, 0.0))
    # Linear, so that more light is never less evidence; zero as many deviations from the one as the other.
    between = (far * near_spread + near * far_spread) / (near_spread + far_spread)
    odds = (ratio - between) * (near - far) / variance
    return FlashEvidence((np.clip(odds, -_LIMIT, _LIMIT) * trust).astype(np.float32), separation)
