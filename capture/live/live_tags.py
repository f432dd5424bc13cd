"""Quick labels for the display: lit, unlit, partial or unknown, told from what has been seen so far.

The gain of a frame is the ratio of its light to the running median of the unlit frames before, band of rows
by band of rows, each the median over the columns of the middle: motion of the picture disturbs single cells,
the flash lifts all. The most that each band has gained of late stands for a full flash; a frame with some
bands up and others down caught an edge of the pulse in its rolling shutter.

For display only: an edge that is caught at the very top or bottom, or a flash much weaker than the room, is
told by `capture.tagging` afterwards.
"""

from __future__ import annotations

from collections import deque

import cv2
import numpy as np
from numpy.typing import NDArray

from capture.transfer import to_linear

LIT, UNLIT, PARTIAL, UNKNOWN = "lit", "unlit", "partial", "unknown"

_BANDS, _COLUMNS = 24, 16
_INNER = slice(3, 13)  # columns of the middle
_BLACK_FLOOR = 4e-3  # linear; the ratio of two blacks is not a gain
_CLIPPED_CODE = 249
_REFERENCES, _FEWEST = 4, 3  # unlit frames: more are a longer walk back
_LEAST_GAIN = 0.08  # natural logarithm; weaker flashes than 8 % of the room are not shown
_NOISE_FACTOR = 5.0
# Shares of a full flash's gain from which a band is lit (of this pulse's, of earlier ones'), and is not.
_FULL, _ROUGHLY_FULL, _NONE = 0.8, 0.55, 0.22
_TELLING = 0.3  # of the strongest band's gain: weaker ones see the wall, and say little
_MOVED = 0.5
_FADES = 0.94  # of the remembered full flash, at each frame with some
_LONGEST_LIT_S = 0.6  # no flash lasts so long: the light of the room has changed
_DARKER_FRAMES = 3  # darker than the reference: that was lit
_PULSE_GAP_S = 0.15  # between the lit frames of one pulse
_KEPT = 0.9  # of the noise's running mean


class LiveTagger:
    """Labels frames as they come."""

    def __init__(self, transfer: str) -> None:
        """Starts.

        Args:
            transfer: of the pictures (`capture.transfer`).

        Raises:
            TransferError: unknown transfer function.
        """
        codes = np.arange(256, dtype=np.uint8)
        self._log_of_code = np.log(to_linear(codes, transfer) + np.float32(_BLACK_FLOOR)).astype(np.float32)
        self._unlit: deque[NDArray[np.float32]] = deque(maxlen=_REFERENCES)
        self._full: NDArray[np.float32] | None = None
        self._noise = 0.02
        self._pulse: NDArray[np.float32] | None = None
        self._darker = 0
        self._lit_since_s: float | None = None
        self._last_lit_s = -1e9
        #: Flashes that were seen, and when the last of them began; None = none yet.
        self.pulses = 0
        self.last_pulse_s: float | None = None

    def add(self, luma: NDArray[np.uint8], stamp_s: float) -> str:
        """The label of a frame: luma [h, w] in sensor rows, and its stamp, increasing."""
        thumbnail = cv2.resize(luma, (_COLUMNS, _BANDS), interpolation=cv2.INTER_AREA)
        logs = self._log_of_code[thumbnail]
        if len(self._unlit) < _FEWEST:
            return self._begin(logs)
        gains = logs - np.median(np.stack(self._unlit), axis=0)
        profile = np.median(gains[:, _INNER], axis=1).astype(np.float32)
        profile = cv2.blur(profile[:, None], (1, 3))[:, 0]
        clipped = np.mean(thumbnail[:, _INNER] >= _CLIPPED_CODE, axis=1) > 0.5
        label = self._label(profile, clipped)
        return self._remember(label, profile, logs, stamp_s)

    def _begin(self, logs: NDArray[np.float32]) -> str:
        self._unlit.append(logs)
        levels = [float(np.median(seen[:, _INNER])) for seen in self._unlit]
        if max(levels) - min(levels) > 2 * _LEAST_GAIN:  # began within a pulse, or with one
            darkest = self._unlit[int(np.argmin(levels))]
            self._unlit.clear()
            self._unlit.append(darkest)
        return UNKNOWN

    def _label(self, profile: NDArray[np.float32], clipped: NDArray[np.bool_]) -> str:
        least = max(_LEAST_GAIN, _NOISE_FACTOR * self._noise)
        most, fewest = (float(value) for value in np.percentile(profile, (85, 10)))
        usual = 0.0 if self._full is None else float(np.percentile(self._full, 85))
        # A flash darkens nothing; where some bands gain and others lose, the picture has moved.
        if most < max(least, _NONE * usual) or fewest < -_MOVED * most:
            return UNLIT
        first_frame = self._full is None
        self._full = profile if self._full is None else np.maximum(_FADES * self._full, profile)
        full = self._full
        if first_frame:  # how much a full flash gives is not known yet: it may be an edge
            return PARTIAL
        told = (full > max(least, _TELLING * float(full.max()))) & ~clipped
        if told.sum() < _BANDS // 4:
            return LIT if float(np.median(profile)) > least else PARTIAL
        shares = profile[told] / full[told]
        if float(np.percentile(shares, 92)) <= _NONE:
            return UNLIT
        # The pulse's own frames before say it exactly; the pulses before, of another view, roughly.
        of_pulse = 1.0 if self._pulse is None else _least_share(profile[told], self._pulse[told])
        self._pulse = profile if self._pulse is None else np.maximum(self._pulse, profile)
        return (
            LIT if _least_share(profile[told], full[told]) >= _ROUGHLY_FULL and of_pulse >= _FULL else PARTIAL
        )

    def _remember(
        self, label: str, profile: NDArray[np.float32], logs: NDArray[np.float32], stamp_s: float
    ) -> str:
        if label == UNLIT:
            self._lit_since_s = self._pulse = None
            spread = 1.4826 * float(np.median(np.abs(profile)))
            self._noise = _KEPT * self._noise + (1 - _KEPT) * spread
            darker = float(np.median(profile)) < -max(_LEAST_GAIN, _NOISE_FACTOR * self._noise)
            self._darker = self._darker + 1 if darker else 0
            if self._darker >= _DARKER_FRAMES:
                self._forget()
                return UNKNOWN
            self._unlit.append(logs)
            return UNLIT
        if self._lit_since_s is None:
            self._lit_since_s = stamp_s
        if stamp_s - self._lit_since_s > _LONGEST_LIT_S:
            self._forget()
            return UNKNOWN
        if stamp_s - self._last_lit_s > _PULSE_GAP_S:
            self.pulses += 1
            self.last_pulse_s = stamp_s
        self._last_lit_s = stamp_s
        return label

    def _forget(self) -> None:
        """The room has another light now: its unlit frames are gathered anew."""
        self._unlit.clear()
        self._darker = 0
        self._lit_since_s = None


def _least_share(profile: NDArray[np.float32], full: NDArray[np.float32]) -> float:
    """Nearly the least share of a full flash's gain among bands."""
    return float(np.percentile(profile / np.maximum(full, 1e-3), 8))
