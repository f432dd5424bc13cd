"""What one picture says of exposure and sharpness; a fraction of a millisecond."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

_CLIP_CODE = 250  # codes from here on are at white clip, after a camera's conversion and JPEG
_BLACK_CODE = 6
_SUBJECT = (0.28, 0.38)  # half axes of the subject area, short sides
_NEAR_PX, _FAR_PX = 1, 6
_STRIDE = 2  # every second pixel: highlights are not averaged away, as a smaller picture's would be


@dataclass(frozen=True)
class Light:
    """Exposure of one picture.

    Attributes:
        level: median display value of the subject area, 0..1.
        clipped: share of the picture at white clip, in any channel.
        clipped_subject: share of the subject area.
        dark: share of the subject area at black, in all channels.
    """

    level: float
    clipped: float
    clipped_subject: float
    dark: float


class LightMeter:
    """Measures pictures of one size."""

    def __init__(self, width: int, height: int, sideways: bool = False) -> None:
        """Starts; in pictures that lie `sideways` the head does too."""
        rows, columns = np.mgrid[0:height:_STRIDE, 0:width:_STRIDE]
        side = min(width, height)
        across, along = (columns - width / 2) / side, (rows - height / 2) / side
        half_across, half_along = _SUBJECT[::-1] if sideways else _SUBJECT
        inside = (across / half_across) ** 2 + (along / half_along) ** 2 < 1
        self._subject = np.where(inside, 255, 0).astype(np.uint8)
        self._pixels = inside.size
        self._subject_pixels = int(np.count_nonzero(inside))

    def measure(self, picture: NDArray[np.uint8], luma: NDArray[np.uint8]) -> Light:
        """Exposure of a picture [h, w, 3] RGB or [h, w], and its luma [h, w]."""
        coarse = np.ascontiguousarray(picture[::_STRIDE, ::_STRIDE])
        brightest = coarse
        if coarse.ndim == 3:
            red, green, blue = cv2.split(coarse)
            brightest = np.asarray(cv2.max(cv2.max(red, green), blue), np.uint8)
        clipped = cv2.threshold(brightest, _CLIP_CODE - 1, 255, cv2.THRESH_BINARY)[1]
        histogram = cv2.calcHist(
            [np.ascontiguousarray(luma[::_STRIDE, ::_STRIDE])], [0], self._subject, [256], [0, 256]
        )
        below = np.cumsum(histogram) / self._subject_pixels
        return Light(
            level=float(np.searchsorted(below, 0.5)) / 255,
            clipped=cv2.countNonZero(clipped) / self._pixels,
            clipped_subject=cv2.countNonZero(cv2.bitwise_and(clipped, self._subject)) / self._subject_pixels,
            dark=float(below[_BLACK_CODE - 1]),
        )


class SharpnessGauge:
    """Sharpness of unlit pictures against the sharpest of late.

    Neighbouring pixels differ less, compared with distant ones, as edges widen. The ratio of the two hardly
    depends on what is seen or how bright it is. It is taken along four directions, since a moving hand blurs
    one; the worst of them counts. A focus that is wrong from the start, or a walk that is too fast all along,
    does not show, for there is nothing sharper to compare with.
    """

    _LATELY = 60  # frames whose upper quartile is sharp

    def __init__(self) -> None:
        self._last: deque[NDArray[np.float64]] = deque(maxlen=self._LATELY)

    def add(self, luma: NDArray[np.uint8]) -> float:
        """Relative sharpness, 0..1, of a small luma picture [h, w]."""
        ratios = _fineness(luma)
        self._last.append(ratios)
        best = np.sort(np.stack(self._last), axis=0)[(3 * len(self._last)) // 4]
        return float(np.clip(ratios / np.maximum(best, 1e-9), 0.0, 1.0).min())


def _fineness(luma: NDArray[np.uint8]) -> NDArray[np.float64]:
    """[4] mean square differences of near over those of distant pixels: along x, y and the two diagonals."""
    height, width = luma.shape
    middle = luma[height // 6 : -(height // 6), width // 6 : -(width // 6)]
    smooth = np.asarray(cv2.boxFilter(middle, -1, (2, 2)), np.uint8)
    near, far = _differences(smooth, _NEAR_PX), _differences(smooth, _FAR_PX)
    return near / np.maximum(far, 1e-3)


def _differences(picture: NDArray[np.uint8], distance: int) -> NDArray[np.float64]:
    """[4] mean square difference of pixels `distance` apart along x, y, and so many steps diagonally."""
    inner = slice(distance, -distance)
    here = picture[inner, inner]
    high, low = slice(None, -2 * distance), slice(2 * distance, None)
    there = (picture[inner, low], picture[low, inner], picture[low, low], picture[low, high])
    return np.array([cv2.norm(here, other, cv2.NORM_L2SQR) for other in there]) / here.size
