"""What is remembered of every frame: a thumbnail that keeps the sensor's rows apart, and its colour.

A frame costs well under a millisecond and 15 kB, so a whole video is looked at while it is decoded.
Thumbnails are not cropped, rotated or registered: row y of the thumbnail is a band of sensor rows, read out
at its own time.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from capture.errors import TaggingError
from capture.tagging.config import TaggingConfig
from capture.transfer import canonical_transfer, to_linear

#: Thumbnail size. 96 bands resolve a readout of 10 to 33 ms to 0.1-0.35 ms; 160 columns are enough to
#: follow the
#: picture's motion to a fraction of a cell.
THUMBNAIL_ROWS, THUMBNAIL_COLUMNS = 96, 160
#: Blocks a side of the colour averages.
COLOR_BLOCKS = 8
#: Added to linear light before a ratio is taken: half a code of 8-bit sRGB in the shadows (1/255/12.92/2
#: = 1.5e-4) and the
#: camera's black-level error (about 1e-3) are then not mistaken for gain.
BLACK_FLOOR = 2e-3

# Y'CbCr to R'G'B' (ITU-R BT.601-7, BT.709-6, BT.2020-2): the luma weights of red and blue.
_LUMA_WEIGHTS = {"bt601": (0.299, 0.114), "bt709": (0.2126, 0.0722), "bt2020": (0.2627, 0.0593)}


@dataclass(frozen=True, eq=False)
class FrameProfiles:
    """All frames of a sequence, as the tagger sees them.

    Attributes:
        pts_s: [K] presentation times, increasing.
        codes: [K, h, w] uint8 thumbnails, rows in sensor order.
        linear_of_code: [256] float32, linear light of a code, 1 = white clip.
        clip_code: codes from here on are clipped.
        color: [K, n, n, 3] float32 linear RGB block means; None when the source gave luma only.
        readable: [K] bool; False where the frame held NaN or nothing.
    """

    pts_s: NDArray[np.float64]
    codes: NDArray[np.uint8]
    linear_of_code: NDArray[np.float32]
    clip_code: int
    color: NDArray[np.float32] | None
    readable: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.pts_s)

    def take(self, index: NDArray[np.int_]) -> FrameProfiles:
        """The profiles of some frames."""
        return FrameProfiles(
            pts_s=self.pts_s[index],
            codes=self.codes[index],
            linear_of_code=self.linear_of_code,
            clip_code=self.clip_code,
            color=None if self.color is None else self.color[index],
            readable=self.readable[index],
        )

    def linear(self, index: int) -> NDArray[np.float32]:
        """[h, w] linear light of a thumbnail, black floor added."""
        return self.linear_of_code[self.codes[index]] + np.float32(BLACK_FLOOR)

    def blocks(self, rows: int, columns: int) -> NDArray[np.float32]:
        """[K, rows, columns] mean linear light of blocks, black floor added."""
        out = np.empty((len(self), rows, columns), np.float32)
        for k in range(len(self)):
            out[k] = cv2.resize(self.linear(k), (columns, rows), interpolation=cv2.INTER_AREA)
        return out

    def clipped(self) -> NDArray[np.float64]:
        """[K] share of the picture at white clip."""
        return np.array([np.mean(codes >= self.clip_code) for codes in self.codes])

    @property
    def interval_s(self) -> float:
        """The usual time from one frame to the next (median)."""
        return float(np.median(np.diff(self.pts_s))) if len(self) > 1 else float("nan")


class ProfileAccumulator:
    """Takes every frame of a sequence, one at a time, and keeps what tagging needs."""

    def __init__(
        self,
        width: int,
        height: int,
        *,
        transfer: str,
        levels: tuple[float, float] | None = None,
        matrix: str = "bt709",
        config: TaggingConfig | None = None,
    ) -> None:
        """Start a sequence.

        Args:
            width: of the frames, pixels.
            height: of the frames, pixels; rows as the sensor has them.
            transfer: name of the transfer function (see `capture.transfer`).
            levels: stored values of black and white; (16, 235) for 8-bit limited-range luma. Default: the
                full range of the frames' type.
            matrix: of the Y'CbCr planes when `chroma` is given: bt601, bt709 or bt2020.
            config: of the tagger; `clip_display` is used.

        Raises:
            TaggingError: the frames are too small to tell one row's time from another's.
            TransferError: unknown transfer function.
        """
        if height < 16 or width < 16:
            raise TaggingError(
                f"Frames of {width}x{height} are too small to see a rolling shutter; at least 16x16 are "
                "needed."
            )
        if matrix not in _LUMA_WEIGHTS:
            raise ValueError(f"matrix {matrix!r} is not one of {', '.join(_LUMA_WEIGHTS)}")
        self.width, self.height = width, height
        self._transfer = canonical_transfer(transfer)
        self._levels = levels
        self._matrix = matrix
        self._clip_display = (config or TaggingConfig()).clip_display
        self._dropped = 0
        self._pts: list[float] = []
        self._codes: list[NDArray[np.uint8]] = []
        self._color: list[NDArray[np.float32]] = []
        self._readable: list[bool] = []

    def add(
        self,
        frame: NDArray[np.generic],
        pts_s: float,
        *,
        chroma: tuple[NDArray[np.generic], NDArray[np.generic]] | None = None,
    ) -> None:
        """Look at one frame.

        Args:
            frame: [H, W] luma or [H, W, 3] RGB, display-referred; uint8, uint16, or floating 0..1.
            pts_s: presentation time, later than the frame before.
            chroma: the frame's Cb and Cr planes in the luma's type, at any subsampling; lets white balance
                be watched.

        Raises:
            TaggingError: wrong size, or a time that is not later than the one before.
        """
        number = self._dropped + len(self._pts)
        if frame.shape[:2] != (self.height, self.width) or frame.ndim not in (2, 3):
            raise TaggingError(
                f"Frame {number} is {'x'.join(map(str, frame.shape[1::-1]))}, but the sequence is "
                f"{self.width}x{self.height}; all frames must have one size."
            )
        if not np.isfinite(pts_s) or (self._pts and pts_s <= self._pts[-1]):
            before = f"{self._pts[-1]:.6f} s" if self._pts else "the start"
            raise TaggingError(
                f"Frame {number} is at {pts_s} s, not later than {before}; sort the frames by time."
            )
        small = self._display(_shrink(frame, THUMBNAIL_COLUMNS, THUMBNAIL_ROWS))
        readable = bool(np.all(np.isfinite(small))) and float(small.max()) > 0
        small = np.nan_to_num(small, nan=0.0, posinf=1.0, neginf=0.0)
        luma = small if small.ndim == 2 else small @ np.array([0.2126, 0.7152, 0.0722], np.float32)
        if small.ndim == 3:
            self._color.append(self._block_color(small))
        elif chroma is not None:
            self._color.append(self._block_color(self._rgb(small, *chroma)))
        self._pts.append(float(pts_s))
        self._codes.append(np.round(255 * np.clip(self._code(luma), 0, 1)).astype(np.uint8))
        self._readable.append(readable)

    @property
    def times_s(self) -> list[float]:
        """Presentation times of the frames that are kept."""
        return self._pts

    def drop(self, count: int) -> None:
        """Forgets the first frames that are still kept."""
        self._dropped += count
        for kept in (self._pts, self._codes, self._color, self._readable):
            del kept[:count]

    def square(self, side: int) -> NDArray[np.float32]:
        """[side, side] mean linear light of blocks of the latest frame, black floor added."""
        linear = self._linear_of_code()[self._codes[-1]] + np.float32(BLACK_FLOOR)
        return _resized(linear, side, side)

    def _linear_of_code(self) -> NDArray[np.float32]:
        codes = np.arange(256, dtype=np.float32) / 255
        return to_linear(codes**2 if self._transfer == "linear" else codes, self._transfer)

    def profiles(self, begin: int = 0, end: int | None = None) -> FrameProfiles:
        """Everything that is kept, or a part of it."""
        pts, codes, color = self._pts[begin:end], self._codes[begin:end], self._color[begin:end]
        empty = np.zeros((0, THUMBNAIL_ROWS, THUMBNAIL_COLUMNS), np.uint8)
        return FrameProfiles(
            pts_s=np.array(pts),
            codes=np.stack(codes) if codes else empty,
            linear_of_code=self._linear_of_code(),
            clip_code=int(np.ceil(255 * float(self._code(np.float32(self._clip_display))))),
            color=np.stack(color) if color and len(self._color) == len(self._pts) else None,
            readable=np.array(self._readable[begin:end], bool),
        )

    def _code(self, display: NDArray[np.float32] | np.float32) -> NDArray[np.float32] | np.float32:
        """0..1 value whose 8-bit rounding is kept: the display value, or its square root for linear
        sources, whose shadows 256 even steps would not resolve.
        """
        return np.sqrt(np.maximum(display, 0)) if self._transfer == "linear" else display

    def _display(self, stored: NDArray[np.generic]) -> NDArray[np.float32]:
        """Display values 0..1 of stored ones."""
        black, white = self._range(stored.dtype)
        return (stored.astype(np.float32) - np.float32(black)) * np.float32(1.0 / (white - black))

    def _range(self, dtype: np.dtype[np.generic]) -> tuple[float, float]:
        if self._levels is not None:
            return self._levels
        return 0.0, float(np.iinfo(str(dtype)).max) if np.issubdtype(dtype, np.integer) else 1.0

    def _block_color(self, display: NDArray[np.float32]) -> NDArray[np.float32]:
        linear = to_linear(np.clip(display, 0, 1), self._transfer)
        return _resized(linear, COLOR_BLOCKS, COLOR_BLOCKS)

    def _rgb(
        self, luma: NDArray[np.float32], cb: NDArray[np.generic], cr: NDArray[np.generic]
    ) -> NDArray[np.float32]:
        """[n, n, 3] display RGB of a thumbnail's luma and of the chroma planes."""
        n = COLOR_BLOCKS
        black, white = self._range(cb.dtype)
        limited = self._levels is not None and black > 0
        # Chroma is centred on half the type's range; in limited range it spans 224 of luma's 219 steps
        # (BT.709-6, 4.6).
        middle = (float(np.iinfo(str(cb.dtype)).max) + 1) / 2 if np.issubdtype(cb.dtype, np.integer) else 0.5
        span = (white - black) * (224 / 219 if limited else 1.0)
        blue, red = (
            (_resized(_shrink(plane, 4 * n, 4 * n), n, n).astype(np.float32) - middle) / span
            for plane in (cb, cr)
        )
        y = _resized(luma, n, n)
        kr, kb = _LUMA_WEIGHTS[self._matrix]
        r, b = y + 2 * (1 - kr) * red, y + 2 * (1 - kb) * blue
        return np.stack([r, (y - kr * r - kb * b) / (1 - kr - kb), b], axis=-1)


def _shrink(image: NDArray[np.generic], columns: int, rows: int) -> NDArray[np.generic]:
    """Area average to [rows, columns].

    Display values are averaged, not light: on a power law both give the same *ratio* between two frames
    that differ by a gain, and it costs a tenth. Halving first is OpenCV's fast path.
    """
    if image.dtype == np.float64 or image.dtype == np.float16:
        image = image.astype(np.float32)
    while (
        image.shape[0] >= 4 * rows
        and image.shape[1] >= 4 * columns
        and not (image.shape[0] | image.shape[1]) & 1
    ):
        image = _resized(image, image.shape[1] // 2, image.shape[0] // 2)
    return _resized(image, columns, rows)


def _resized(image: NDArray[Any], columns: int, rows: int) -> NDArray[Any]:
    return np.asarray(cv2.resize(image, (columns, rows), interpolation=cv2.INTER_AREA))
