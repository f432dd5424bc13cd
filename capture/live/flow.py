"""How the picture moves: corners followed through the unlit frames.

Only unlit frames are followed, each from the unlit one before, so that the flash's change of light never
looks like motion; half a dozen lit frames between two are jumped over, with the last speed as a first guess
and a look backwards as a check.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

#: Short side of the pictures that are followed: a corner is found to a tenth of a pixel, a degree is about
#: five pixels, and a frame costs a millisecond.
SHORT_SIDE = 240
#: Half axes of the ellipse where the head should be, in short sides of the picture.
MIDDLE = (0.30, 0.40)
_STEP_S = 0.2  # a flow is told this often: a degree or two of a walk
_MOST_CORNERS = 60  # in the middle, and as many around it
_FEWEST_CORNERS = 36  # below, new ones are looked for
_PATIENCE = 4  # frames between two searches: a bare wall has never enough
_CORNER_SPACING_PX = 9
_CORNER_QUALITY = 0.008  # of the best corner's strength
_LEAST_CONTRAST = 12  # of a corner's neighbourhood, codes; below, noise is followed
_WINDOW = (15, 15)
_LEVELS = 3
_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 12, 0.03)
_LARGEST_ERROR = 14.0  # mean difference of codes over a corner's window, after the motion
_LONG_S = 0.06  # over longer gaps a corner must be found again backwards
_BACK_PX = 1.0

Points = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Flow:
    """Where corners were and are.

    Attributes:
        before: [N, 2] float32, pixels of the followed picture, x and y.
        after: [N, 2].
        interval_s: from one picture to the other.
        width: of the followed picture, pixels.
        height: likewise.
    """

    before: Points
    after: Points
    interval_s: float
    width: int
    height: int

    def __len__(self) -> int:
        return len(self.before)

    @property
    def middle(self) -> Points:
        """[N, 2] halfway between before and after."""
        return np.asarray((self.before + self.after) / 2, np.float32)


class FlowTracker:
    """Follows corners through a sequence of pictures."""

    def __init__(self) -> None:
        self._luma: NDArray[np.uint8] | None = None
        self._stamp_s = 0.0
        self._corners = np.zeros((0, 2), np.float32)
        self._origin = np.zeros(
            (0, 2), np.float32
        )  # where each was when the step began; NaN = it was not yet
        self._speed = np.zeros((0, 2), np.float32)  # pixels a second
        self._step_from_s = 0.0
        self._since = _PATIENCE

    def add(self, luma: NDArray[np.uint8], stamp_s: float) -> Flow | None:
        """Looks at an unlit frame.

        Args:
            luma: [h, w] uint8, short side `SHORT_SIDE`, of one size throughout.
            stamp_s: increasing.

        Returns:
            The flow since the last one that was told, perhaps of no corner at all; None in between.
        """
        if self._luma is None:
            self._step_from_s = stamp_s
        else:
            self._follow(self._luma, luma, stamp_s - self._stamp_s)
        self._luma, self._stamp_s = luma, stamp_s
        flow = None
        if stamp_s - self._step_from_s >= _STEP_S:
            flow = self._told(luma, stamp_s)
        self._since += 1
        if self._since >= _PATIENCE:
            self._replenish(luma)
        return flow

    def _told(self, luma: NDArray[np.uint8], stamp_s: float) -> Flow:
        old = np.isfinite(self._origin).all(axis=1)
        height, width = luma.shape
        flow = Flow(self._origin[old], self._corners[old], stamp_s - self._step_from_s, width, height)
        self._origin, self._step_from_s = self._corners.copy(), stamp_s
        return flow

    def _follow(self, last: NDArray[np.uint8], luma: NDArray[np.uint8], interval_s: float) -> None:
        if not len(self._corners):
            return
        guess = self._corners + self._speed * np.float32(interval_s)
        after, found, error = _tracked(last, luma, self._corners, guess)
        height, width = luma.shape
        inside = ((after >= 2) & (after < np.array([width - 2, height - 2]))).all(axis=1)
        kept = (found[:, 0] == 1) & (error[:, 0] < _LARGEST_ERROR) & inside
        if interval_s > _LONG_S:
            back, _, _ = _tracked(luma, last, after, self._corners)
            kept &= np.abs(back - self._corners).max(axis=1) < _BACK_PX
        self._speed = (after[kept] - self._corners[kept]) / np.float32(max(interval_s, 1e-3))
        self._corners, self._origin = after[kept], self._origin[kept]

    def _replenish(self, luma: NDArray[np.uint8]) -> None:
        """Finds corners where none is followed, for the middle and the surroundings apart."""
        height, width = luma.shape
        middle = in_middle(self._corners, width, height)
        counts = (int(middle.sum()), int((~middle).sum()))
        if min(counts) >= _FEWEST_CORNERS:
            return
        self._since = 0
        free = np.full(luma.shape, 255, np.uint8)
        for x, y in np.round(self._corners).astype(int).tolist():
            cv2.circle(free, (x, y), _CORNER_SPACING_PX, 0, -1)
        zone = _middle_mask(width, height)
        new = [self._corners]
        for mask, have in zip((zone, 255 - zone), counts, strict=True):
            if have < _FEWEST_CORNERS:
                new.append(_corners(luma, free & mask, _MOST_CORNERS - have))
        added = sum(map(len, new[1:]))
        speed = np.median(self._speed, axis=0) if len(self._speed) else np.zeros(2)
        # Right after a flow was told every corner begins with the step; later ones join the next.
        begun = self._step_from_s == self._stamp_s
        origin = np.concatenate(new[1:]) if begun else np.full((added, 2), np.nan)
        self._corners = np.concatenate(new).astype(np.float32)
        self._origin = np.concatenate([self._origin, origin]).astype(np.float32)
        self._speed = np.concatenate([self._speed, np.tile(speed, (added, 1))]).astype(np.float32)


def in_middle(points: Points, width: int, height: int) -> NDArray[np.bool_]:
    """[N] whether points [N, 2] lie where the head should be: an upright ellipse in the middle."""
    axes = min(width, height) * np.array(MIDDLE)
    offset = (points - np.array([width / 2, height / 2])) / axes
    return np.asarray((offset**2).sum(axis=1) < 1.0)


def _middle_mask(width: int, height: int) -> NDArray[np.uint8]:
    """[h, w] 255 where `in_middle`."""
    mask = np.zeros((height, width), np.uint8)
    side = min(width, height)
    axes = (round(side * MIDDLE[0]), round(side * MIDDLE[1]))
    cv2.ellipse(mask, (width // 2, height // 2), axes, 0, 0, 360, 255, -1)
    return mask


def _corners(luma: NDArray[np.uint8], mask: NDArray[np.uint8], most: int) -> Points:
    """[N, 2] the strongest corners within a mask."""
    found = cv2.goodFeaturesToTrack(luma, most, _CORNER_QUALITY, _CORNER_SPACING_PX, mask=mask, blockSize=5)
    if found is None:
        return np.zeros((0, 2), np.float32)
    points = found.reshape(-1, 2)
    half = _WINDOW[0] // 2
    contrasts = []
    for x, y in points.astype(int).tolist():
        patch = luma[max(0, y - half) : y + half + 1, max(0, x - half) : x + half + 1]
        contrasts.append(int(patch.max()) - int(patch.min()))
    return np.asarray(points[np.array(contrasts) >= _LEAST_CONTRAST])


def _tracked(
    last: NDArray[np.uint8], luma: NDArray[np.uint8], points: Points, guess: Points
) -> tuple[Points, NDArray[np.uint8], Points]:
    """Where points of one picture are in another [N, 2], whether found [N, 1], and what is left [N, 1]."""
    after, found, error = cv2.calcOpticalFlowPyrLK(
        last,
        luma,
        points,
        guess.astype(np.float32),
        winSize=_WINDOW,
        maxLevel=_LEVELS,
        criteria=_STOP,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    return np.asarray(after, np.float32), np.asarray(found, np.uint8), np.asarray(error, np.float32)
