"""Which pictures the preview shows: a screen that does not flash, whatever the lamp does.

Frames that are labelled lit or partial are left out. Labels can be wrong, so brightness is watched as well:
a picture much brighter or darker than the one that is shown has to wait until the change has lasted longer
than any flash may. Large changes then come less often than three times a second (WCAG 2.3.1).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

#: Pictures a second at most.
LARGEST_RATE_HZ = 10.0
_LASTING_S = 0.4  # flashes are 0.25 s at most; and 0.4 s between changes is 2.5 a second
_CHANGE = 1.12  # of the middle's mean display value
_DARK = 4.0  # codes that are added to both: black pictures have no ratio


class SteadyPicture:
    """Holds the picture to be shown."""

    def __init__(self) -> None:
        self.picture: NDArray[np.uint8] | None = None
        #: Counts the pictures that were shown.
        self.number = 0
        self._level = 0.0
        self._shown_s = -math.inf
        self._waiting_since_s: float | None = None

    def offer(self, picture: NDArray[np.uint8], label: str, now_s: float) -> bool:
        """Takes a picture [h, w, 3] or [h, w] uint8 with its label, or does not; whether it did."""
        if label in ("lit", "partial") or now_s - self._shown_s < 1.0 / LARGEST_RATE_HZ - 1e-6:
            return False
        height, width = picture.shape[:2]
        middle = picture[height // 4 : -(height // 4) : 4, width // 4 : -(width // 4) : 4]
        level = float(middle.mean()) + _DARK
        if self.picture is not None and not 1 / _CHANGE < level / self._level < _CHANGE:
            if self._waiting_since_s is None:
                self._waiting_since_s = now_s
            if now_s - self._waiting_since_s < _LASTING_S:
                return False
        self._waiting_since_s = None
        self.picture, self._level, self._shown_s = picture.copy(), level, now_s
        self.number += 1
        return True
