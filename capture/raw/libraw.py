"""LibRaw, through rawpy: a file open in it, and its demosaicing of samples that are ours.

Demosaicing is LibRaw's PPG for Bayer mosaics (Lin, "Pixel grouping", 2003) and its own for others. With noise
PPG is half a decibel below AHD and one below DHT, but takes two fifths and a fourteenth of their time, and
what a clipped sample spoils round it is small and known (benchmarks/results/raw_demosaic.json).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rawpy
from numpy.typing import NDArray

from capture.errors import ImageError

Floats = NDArray[np.float32]

# Pixels into which a sample goes. With PPG a cross, found by changing samples of random pictures.
# X-Trans interpolates from less than the square; which of several directions it then takes is settled further
# round, and none of them is wrong.
_OTHER_REACH = np.ones((9, 9), np.uint8)
_BAYER_REACH = np.zeros((9, 9), np.uint8)
_BAYER_REACH[3:6, :] = _BAYER_REACH[:, 3:6] = 1
_HEADROOM = 1.1  # interpolated values may lie a little beyond the largest sample
_LARGEST_CODE = 65535


@contextmanager
def unpacked(path: Path) -> Iterator[Any]:
    """The file open in LibRaw.

    Raises:
        ImageError: LibRaw's errors, within the context too; the sentence lacks the file's name.
    """
    try:
        with rawpy.imread(str(path)) as raw:
            yield raw
    except (
        rawpy.LibRawError,
        rawpy.NotSupportedError,
        NotImplementedError,
        RuntimeError,
        MemoryError,
    ) as cause:
        reason = cause.args[0] if cause.args else type(cause).__name__
        reason = reason.decode("utf-8", "replace") if isinstance(reason, bytes) else str(reason)
        raise ImageError(f"LibRaw says {' '.join(reason.split()).rstrip('.')!r}") from cause


def is_bayer(cell: NDArray[np.uint8]) -> bool:
    """Whether a [2, 2] cell of colour indices (0 red, 1 green, 2 blue) is one of the four Bayer cells."""
    greens_meet = cell.shape == (2, 2) and (cell[0, 0] == 1) == (cell[1, 1] == 1)
    return greens_meet and sorted(cell.ravel().tolist()) == [0, 1, 1, 2]


def demosaic(
    path: Path, samples: Floats, cell: NDArray[np.uint8], corner: tuple[int, int] = (0, 0)
) -> tuple[Floats, NDArray[np.bool_]]:
    """Colours of a mosaic: our samples take the place of the file's in LibRaw's buffer of 16 bits.

    Their range, with room at both ends, fills the 16 bits, so that nothing is cut; a step is 1 in 60,000
    of the largest sample.

    Args:
        path: the file that the samples are of.
        samples: [H, W] white balanced: interpolation takes grey detail for granted.
        cell: [n, n] colour indices.
        corner: row and column of the first sample in the file's picture.

    Returns:
        [H, W, 3], measured samples as they are; and [H, W], where LibRaw leaves colours out: in the corner of
        an X-Trans picture, and in a first row or column of odd number.

    Raises:
        ImageError: LibRaw sees another picture in the file, or refuses it (X-Trans below 512 pixels).
    """
    low, high = 2.0 * min(float(samples.min()), 0.0), _HEADROOM * max(float(samples.max()), 1e-6)
    scale = (_LARGEST_CODE - 1) / (high - low)
    height, width = samples.shape
    with unpacked(path) as raw:
        sizes = raw.sizes
        top, left = sizes.top_margin - corner[0], sizes.left_margin - corner[1]
        seen = np.s_[top : top + sizes.height, left : left + sizes.width]
        if min(top, left) < 0 or top + sizes.height > height or left + sizes.width > width:
            raise ImageError("its light-sensitive area is not the one that LibRaw interpolates")
        stored = np.round((samples - np.float32(low)) * np.float32(scale) + 1).astype(np.uint16)
        raw.raw_image[corner[0] : corner[0] + height, corner[1] : corner[1] + width] = stored
        algorithm = rawpy.DemosaicAlgorithm.PPG if is_bayer(cell) else rawpy.DemosaicAlgorithm.AHD
        codes = np.zeros((height, width, 3), np.uint16)
        codes[seen] = raw.postprocess(
            demosaic_algorithm=algorithm,
            output_color=rawpy.ColorSpace.raw,
            output_bps=16,
            gamma=(1.0, 1.0),
            user_wb=[1.0, 1.0, 1.0, 1.0],
            user_black=0,
            user_cblack=[0, 0, 0, 0],
            user_sat=_LARGEST_CODE,
            user_flip=0,
            no_auto_bright=True,
            adjust_maximum_thr=0.0,
            highlight_mode=rawpy.HighlightMode.Clip,
        )
    missing = np.ones((height, width), bool)
    missing[seen] = False if is_bayer(cell) else (codes[seen] == 0).any(axis=2)
    radiance = np.maximum(codes, 1).astype(np.float32)
    radiance -= np.float32(1)
    radiance *= np.float32(1 / scale)
    radiance += np.float32(low)
    return radiance, missing


def touched_by(samples: NDArray[np.bool_], cell: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """[H, W] pixels into which `demosaic` takes some samples."""
    reach = _BAYER_REACH if is_bayer(cell) else _OTHER_REACH
    return cv2.dilate(samples.astype(np.uint8), reach).astype(bool)


def binned(mosaic: Floats, cell: NDArray[np.uint8]) -> Floats:
    """One pixel a cell: the mean of each colour's samples in it; for looking, not for measuring.

    Args:
        mosaic: [H, W].
        cell: [n, n] colour indices; every colour of the three must be in it.

    Returns:
        [H // n, W // n, 3].
    """
    n = len(cell)
    height, width = (side // n for side in mosaic.shape)
    blocks = mosaic[: height * n, : width * n].reshape(height, n, width, n)
    picture = np.zeros((height, width, 3), np.float32)
    for row, column in np.ndindex(n, n):
        colour = int(cell[row, column])
        picture[..., colour] += blocks[:, row, :, column] / np.float32(np.count_nonzero(cell == colour))
    return picture
