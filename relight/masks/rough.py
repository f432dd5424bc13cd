"""Coarse masks without poses or cloud: what the flash brightens, with frames aligned by optical flow.

For structure from motion, which may leave a moving background out by them, and to find the region where a
cloud is wanted. A lit frame and its unlit neighbours in time are aligned by dense flow (DIS, Kroeger 2016) on
pictures whose light is taken out. Their ratio is split into near and far by its own histogram, and so is
their difference: the ratio finds dark hair, the difference what a window lights too. Unlit frames take the
evidence of the lit ones beside them along the flow. Where the light falls into one heap (no head before a
wall) no mask is given.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from capture.frame_record import FrameRecord
from capture.session import Session
from relight.masks.colour import display
from relight.masks.flash import log_ratio
from relight.masks.frames import Floats
from relight.masks.solve import smoothed
from relight.masks.sweep import NOISE
from relight.stages import Progress, no_progress

SHARE = 0.25
"""Size of the masks, of the frames'."""

_LONGEST_PX = 320  # of the pictures that are looked at; larger ones tell no more
_NEIGHBOURS = 2  # unlit frames beside a lit one, and lit ones beside an unlit one
_FURTHEST = 15  # places in the list of frames: others look from elsewhere
_LEAST_GAP = 2.0  # between near and far in the ratio, spreads
_LIMIT = 4.0  # log-odds


def rough_foreground(
    session: Session, records: Sequence[FrameRecord], progress: Progress = no_progress
) -> dict[int, NDArray[np.uint8]]:
    """Masks of what is near, by frame index.

    Args:
        session: Is read.
        records: Frames to use, of known flash; in any order.
        progress: Told ("masks", fraction).

    Returns:
        [H / 4, W / 4] 0..255 by index of the frame, rounded up; frames of which nothing can be said (no
        neighbour under the other light, nothing nearer than the rest) are not in it.
    """
    ordered = sorted(
        (record for record in records if record.file is not None and record.flash is not None),
        key=lambda record: record.index,
    )
    pictures = _Pictures(session)
    evidence: dict[int, Floats] = {}
    lit = [place for place, record in enumerate(ordered) if record.flash == 1]
    total = len(lit) + len(ordered)
    for done, place in enumerate(lit):
        odds = _lit_evidence(ordered, place, pictures)
        if odds is not None:
            evidence[place] = odds
        progress("masks", (done + 1) / max(total, 1))
    masks = {}
    for place, record in enumerate(ordered):
        odds = evidence.get(place)
        if odds is None and record.flash == 0:
            odds = _carried(ordered, place, sorted(evidence), evidence, pictures)
        if odds is not None:
            mask = _solid(smoothed(display(pictures.of(record)), odds, 4))
            size = (-(-record.width // 4), -(-record.height // 4))
            resized = cv2.resize(mask, size, interpolation=cv2.INTER_AREA)
            masks[record.index] = np.round(255.0 * resized).astype(np.uint8)
        progress("masks", (len(lit) + place + 1) / total)
    return masks


class _Pictures:
    """Small linear pictures of frames, the last few of them in memory."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._kept: dict[int, Floats] = {}

    def of(self, record: FrameRecord) -> Floats:
        if record.index not in self._kept:
            radiance = np.nan_to_num(self._session.load_radiance(record), nan=0.0, posinf=1.0, neginf=0.0)
            share = min(1.0, _LONGEST_PX / max(record.width, record.height))
            size = (max(8, round(record.width * share)), max(8, round(record.height * share)))
            while len(self._kept) >= 4 * _FURTHEST:
                del self._kept[next(iter(self._kept))]
            resized = cv2.resize(radiance, size, interpolation=cv2.INTER_AREA)
            self._kept[record.index] = np.asarray(resized, np.float32)
        return self._kept[record.index]


def _beside(places: Sequence[int], place: int) -> list[int]:
    """The nearest of some places, one from either side first."""
    near = sorted(
        (other for other in places if 0 < abs(other - place) <= _FURTHEST), key=lambda o: abs(o - place)
    )
    before, after = [o for o in near if o < place], [o for o in near if o > place]
    chosen = sorted([*before[:1], *after[:1]], key=lambda other: abs(other - place))
    chosen += [other for other in near if other not in chosen]
    return chosen[:_NEIGHBOURS]


def _lit_evidence(records: Sequence[FrameRecord], place: int, pictures: _Pictures) -> Floats | None:
    """Log-odds [h, w] of a lit frame, None where it tells nothing."""
    unlit = [other for other, record in enumerate(records) if record.flash == 0]
    around = _beside(unlit, place)
    if not around:
        return None
    picture = pictures.of(records[place])
    ratios, gains, trusts = [], [], []
    for other in around:
        neighbour = pictures.of(records[other])
        warped = _along(neighbour, _flow(picture, neighbour))
        ratio, trust = log_ratio(picture, warped)
        ratios.append(ratio)
        trusts.append(trust)
        gain = cv2.blur((picture - warped).mean(axis=-1), (3, 3))
        gains.append(np.log(np.maximum(gain, 0.0) + np.float32(NOISE)))
    trust = np.min(trusts, axis=0)
    # What one neighbour hides behind the head it shows dark: the larger value is the wrong one.
    by_ratio = _split(np.min(ratios, axis=0), trust)
    by_gain = _split(np.min(gains, axis=0), trust)
    if by_ratio is None or by_gain is None:
        return by_ratio
    return np.maximum(by_ratio, by_gain)


def _carried(
    records: Sequence[FrameRecord],
    place: int,
    lit: Sequence[int],
    evidence: dict[int, Floats],
    pictures: _Pictures,
) -> Floats | None:
    """Mean log-odds [h, w] of the lit frames beside an unlit one, along the flow to them."""
    around = _beside(lit, place)
    if not around:
        return None
    picture = pictures.of(records[place])
    total = np.zeros(picture.shape[:2], np.float32)
    weights = 0.0
    for other in around:
        weight = 1.0 / abs(other - place)
        total += weight * _along(evidence[other], _flow(picture, pictures.of(records[other])))
        weights += weight
    return total / np.float32(weights)


def _flow(picture: Floats, other: Floats) -> Floats:
    """[h, w, 2] from a picture's pixels to where they are in another, under whatever light."""
    estimator = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    flow = np.zeros((*picture.shape[:2], 2), np.float32)
    return np.asarray(estimator.calc(_unlit_grey(picture), _unlit_grey(other), flow), np.float32)


def _unlit_grey(picture: Floats) -> NDArray[np.uint8]:
    """8-bit grey with the light taken out: log radiance less its surroundings, over their spread."""
    grey = np.log(picture.mean(axis=-1) + np.float32(0.01))
    detail = grey - cv2.GaussianBlur(grey, (0, 0), 8.0)
    spread = np.sqrt(cv2.GaussianBlur(detail * detail, (0, 0), 16.0)) + 0.03
    return np.asarray(np.clip(128.0 + 50.0 * detail / spread, 0, 255), np.uint8)


def _along(picture: Floats, flow: Floats) -> Floats:
    height, width = flow.shape[:2]
    u, v = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    warped = cv2.remap(
        picture, u + flow[..., 0], v + flow[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(warped, np.float32)


def _split(ratio: Floats, trust: Floats) -> Floats | None:
    """Log-odds [h, w] by the two heaps that a frame's values fall into (Otsu 1979), None for one heap."""
    sure = ratio[trust > 0.3]
    if sure.size < 200:
        return None
    low, high = np.percentile(sure, [1.0, 99.0])
    if high - low < 0.1:
        return None
    levels = np.clip(255.0 * (sure - low) / (high - low), 0, 255).astype(np.uint8)[None]
    level, _ = cv2.threshold(levels, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    between = low + (high - low) * (level + 0.5) / 255.0
    near, far = sure[sure > between], sure[sure <= between]
    if min(near.size, far.size) < 0.03 * sure.size:
        return None
    spread = max(0.08, 0.5 * float(near.std() + far.std()))
    gap = float(near.mean() - far.mean())
    if gap < _LEAST_GAP * spread:
        return None
    odds = (ratio - np.float32(between)) * np.float32(gap / spread**2)
    return (np.clip(odds, -_LIMIT, _LIMIT) * trust).astype(np.float32)


def _solid(mask: Floats) -> Floats:
    """The largest piece of a mask, its holes filled."""
    opened = cv2.morphologyEx((mask > 0.5).astype(np.uint8), cv2.MORPH_OPEN, np.ones((5, 5), np.uint8))
    count, labels, statistics, _ = cv2.connectedComponentsWithStats(opened, connectivity=4)
    if count < 2:
        return np.zeros_like(mask)
    largest = labels == 1 + int(np.argmax(statistics[1:, cv2.CC_STAT_AREA]))
    outside = np.pad(~largest, 1, constant_values=True).astype(np.uint8)
    cv2.floodFill(outside, None, (0, 0), 2)
    return (outside[1:-1, 1:-1] != 2).astype(np.float32)
