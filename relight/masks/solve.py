"""From evidence to a mask of a small picture: all that is known of a pixel, and of its neighbours, weighed.

Log-odds add up. The cloud's silhouette is the prior: sure inside, less so at its outline, and unlikely the
further from it. What lies under the cloud, with nothing of it further down, is what the subject stands or
sits in or wears where stereo found nothing, and is left out: there is no surface there to be lit. Pixels
then persuade their neighbours of like colour: mean-field steps whose messages pass through a guided filter
(He 2013; Krähenbühl 2011 for the scheme).
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from relight.masks.colour import colour_evidence
from relight.masks.frames import Floats
from relight.masks.silhouette import Silhouette, filled
from relight.upright import upright_picture

_INSIDE = 5.0  # log-odds deep in the silhouette
_NEAR_OUTSIDE, _FAR_OUTSIDE = -1.5, -6.0  # just beyond the outline, and far away
_FAR = 0.2  # of the picture's longer side: that far from the outline is far
_UNDER = -8.0
_UNDER_PX = 1.5  # of the small picture: the cloud's lower rim may be ragged by so much
_OUTLINE_PX = 1.2  # of the small picture: how uncertain the cloud's outline is
_STEPS = 4
_PERSUASION = 2.5
_COLOUR_LIMIT = 2.5
_DOUBTFUL = 7.0  # log-odds that colours and neighbours cannot turn
_GUIDE_RADIUS, _GUIDE_EPS = 3, 2e-3


def prior(seen: Silhouette, rotation_deg: int) -> Floats:
    """Log-odds [h, w] by the cloud alone."""
    distance = seen.distance_px
    size = max(distance.shape)
    away = np.clip(-distance / (_FAR * size), 0.0, 1.0)
    outside = _NEAR_OUTSIDE + (_FAR_OUTSIDE - _NEAR_OUTSIDE) * away
    step = 1.0 / (1.0 + np.exp(-np.clip(distance / _OUTLINE_PX, -30, 30) * 1.5))
    odds = outside + (_INSIDE - outside) * step
    beneath = under(seen.inside, rotation_deg) * np.clip(-distance / _UNDER_PX - 0.25, 0.0, 1.0)
    odds += (_UNDER - odds) * beneath
    return odds.astype(np.float32)


def under(inside: NDArray[np.bool_], rotation_deg: int) -> NDArray[np.bool_]:
    """Pixels [h, w] with the silhouette above them and nothing of it below, in the upright picture."""
    upright = upright_picture(inside, rotation_deg)
    above = np.logical_or.accumulate(upright, axis=0)
    below = np.logical_or.accumulate(upright[::-1], axis=0)[::-1]
    return upright_picture(above & ~below, -rotation_deg % 360)


def solve(picture: Floats, odds: Floats, seen: Silhouette) -> Floats:
    """Coverage [h, w] 0..1 of a small picture.

    Args:
        picture: [h, w, 3] display values.
        odds: [h, w] sum of all evidence.
        seen: The cloud's silhouette; what of the mask does not touch it is dropped.
    """
    mask = _probability(odds)
    radius = max(4, max(odds.shape) // 10)
    doubtful = np.abs(odds) < _DOUBTFUL
    for _ in range(2):
        colour = colour_evidence(picture, _sure(mask), _sure(1.0 - mask), radius, doubtful)
        mask = smoothed(picture, odds + np.clip(colour, -_COLOUR_LIMIT, _COLOUR_LIMIT), _STEPS)
    return attached(mask, seen)


def smoothed(
    picture: Floats, odds: Floats, steps: int, radius: int = _GUIDE_RADIUS, eps: float = _GUIDE_EPS
) -> Floats:
    """Mean-field steps: [h, w] 0..1 from log-odds, with messages filtered along the picture's edges."""
    mask = _probability(odds)
    guided = cv2.ximgproc.createGuidedFilter(picture, radius, eps)
    for _ in range(steps):
        message = guided.filter(mask)
        mask = _probability(odds + _PERSUASION * (2.0 * message - 1.0))
    return mask


def attached(mask: Floats, seen: Silhouette) -> Floats:
    """The mask without what does not touch the cloud, its small enclosed holes filled."""
    solid = mask > 0.5
    count, labels = cv2.connectedComponents(solid.astype(np.uint8), connectivity=4)
    touching = np.bincount(labels[seen.distance_px > 2.0], minlength=count) > 0
    touching[0] = False
    stays = touching[labels]
    stays = filled(stays)
    near = cv2.dilate(stays.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    return np.where(stays, np.maximum(mask, 0.5), np.where(near, np.minimum(mask, 0.5), 0.0)).astype(
        np.float32
    )


def _probability(odds: Floats) -> Floats:
    return (1.0 / (1.0 + np.exp(-np.clip(odds, -30.0, 30.0)))).astype(np.float32)


def _sure(mask: Floats) -> Floats:
    return np.clip((mask - 0.85) / 0.15, 0.0, 1.0).astype(np.float32)
