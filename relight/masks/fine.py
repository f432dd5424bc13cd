"""The mask of a frame at full size: its outline found again in the picture, between cloud and small mask.

The small mask says where the subject is, the cloud's silhouette where its outline runs to a pixel or two.
Where the two agree the outline is sought close to the cloud's, else (hair, holes, a head that moved) in a
wider band about the small mask's. In the band the colours on either side decide, with neighbours of like
colour; and once more about the outline so found, closer.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from relight.masks.colour import colour_evidence
from relight.masks.frames import Floats
from relight.masks.silhouette import Silhouette, signed_distance_px
from relight.masks.solve import smoothed

# Lengths are in pixels of a picture whose longer side is 512.
_AGREE = 1.5  # pixels of the small picture: outlines this near each other are one
_SURE_PX, _UNSURE_PX = 2.1, 5.3  # uncertainty of the outline where they agree, and where not
_AGAIN_PX = 1.3  # the same, once it was found
_MARGIN = 0.75  # in these: pixels that far from the outline are surely on their side of it
_RING_PX = 14.0  # of pixels whose colours are asked, on either side
_RADIUS_PX = 11.0  # of the windows in which they are
_GUIDE_PX, _GUIDE_EPS, _STEPS = 3.0, 1e-3, 3
_BY_PLACE = 1.6  # log-odds of a pixel one uncertainty inside the outline
_MOST_BY_PLACE, _MOST_BY_COLOUR = 12.0, 4.0


def refine(picture: Floats, small_mask: Floats, seen: Silhouette) -> Floats:
    """Coverage [H, W] 0..1.

    Args:
        picture: [H, W, 3] display values.
        small_mask: [h, w] 0..1.
        seen: The cloud's silhouette at full size.
    """
    height, width = picture.shape[:2]
    enlarged = cv2.resize(small_mask, (width, height), interpolation=cv2.INTER_CUBIC)
    about = signed_distance_px(enlarged > 0.5)
    scale = max(height, width) / 512.0
    step = max(height, width) / max(small_mask.shape)  # pixels of a pixel of the small picture
    apart = np.abs(np.clip(seen.distance_px, -50, 50) - np.clip(about, -50, 50))
    agree = np.exp(-0.5 * (cv2.blur(apart, (9, 9)) / (_AGREE * step)) ** 2)
    distance = agree * seen.distance_px + (1.0 - agree) * about
    sure = math.hypot(_SURE_PX * scale, seen.noise_px)
    spread = agree * sure + (1.0 - agree) * max(_UNSURE_PX * scale, sure)
    mask = _outline(picture, distance, spread.astype(np.float32), scale)
    return _outline(picture, signed_distance_px(mask > 0.5), np.float32(_AGAIN_PX * scale), scale)


def _outline(picture: Floats, distance: Floats, spread: Floats | np.float32, scale: float) -> Floats:
    """Coverage [H, W] by the colours on either side of an outline known to a spread (pixels)."""
    odds = np.clip(_BY_PLACE * distance / spread, -_MOST_BY_PLACE, _MOST_BY_PLACE).astype(np.float32)
    margin = _MARGIN * spread
    outer = margin + np.float32(_RING_PX * scale)
    subject = ((distance > margin) & (distance < outer)).astype(np.float32)
    background = ((distance < -margin) & (distance > -outer)).astype(np.float32)
    wanted = np.abs(distance) < outer
    colour = colour_evidence(picture, subject, background, max(4, round(_RADIUS_PX * scale)), wanted)
    odds += np.clip(colour, -_MOST_BY_COLOUR, _MOST_BY_COLOUR)
    return smoothed(picture, odds, _STEPS, radius=max(2, round(_GUIDE_PX * scale)), eps=_GUIDE_EPS)
