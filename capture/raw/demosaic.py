"""From a mosaic under a colour filter array to three colours a pixel, in floats and linear.

Bayer mosaics go through the linear filters of Malvar, He, Cutler, "High-quality linear interpolation for
demosaicing of Bayer-patterned color images" (ICASSP 2004), figure 2. Better ones decide by the picture
which way to interpolate; then a lit picture minus an unlit one is no longer the picture of the flash alone. A
linear filter keeps that difference, knows no range in which it would have to cut, and tells exactly which
pixels a clipped sample has touched. Other mosaics (X-Trans) are left to LibRaw.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

# Weights times 8. Green at a red or blue sample; red at a green sample with red left and right (blue with
# blue); the same above and below is its transpose; red at a blue sample (blue at red).
_GREEN = np.array(
    [[0, 0, -1, 0, 0], [0, 0, 2, 0, 0], [-1, 2, 4, 2, -1], [0, 0, 2, 0, 0], [0, 0, -1, 0, 0]], np.float32
)
_BESIDE = np.array(
    [[0, 0, 0.5, 0, 0], [0, -1, 0, -1, 0], [-1, 4, 5, 4, -1], [0, -1, 0, -1, 0], [0, 0, 0.5, 0, 0]],
    np.float32,
)
_ACROSS = np.array(
    [[0, 0, -1.5, 0, 0], [0, 2, 0, 2, 0], [-1.5, 0, 6, 0, -1.5], [0, 2, 0, 2, 0], [0, 0, -1.5, 0, 0]],
    np.float32,
)
_TOUCHED = ((_GREEN != 0) | (_BESIDE != 0) | (_BESIDE.T != 0) | (_ACROSS != 0)).astype(np.uint8)


def is_bayer(cell: NDArray[np.uint8]) -> bool:
    """Whether a [2, 2] cell of colour indices (0 red, 1 green, 2 blue) is one of the four Bayer cells."""
    greens_meet = cell.shape == (2, 2) and (cell[0, 0] == 1) == (cell[1, 1] == 1)
    return greens_meet and sorted(cell.ravel().tolist()) == [0, 1, 1, 2]


def demosaic_bayer(mosaic: Floats, cell: NDArray[np.uint8]) -> Floats:
    """Colours of a Bayer mosaic.

    Args:
        mosaic: [H, W], both at least 4; white balanced, for the filters take grey detail for granted.
        cell: [2, 2] colour indices of the top left samples.

    Returns:
        [H, W, 3]; measured samples are kept as they are. Beside edges values may be below zero or above the
        largest sample.
    """
    if not is_bayer(cell):
        raise ValueError(f"{cell.tolist()} is no Bayer cell")
    picture = np.empty((*mosaic.shape, 3), np.float32)
    for kernel, sampled, wanted in _steps(cell):
        filtered = mosaic if kernel is None else _filtered(mosaic, kernel)
        for (row, column), colour in zip(sampled, wanted, strict=True):
            picture[row::2, column::2, colour] = filtered[row::2, column::2]
    return picture


def _steps(cell: NDArray[np.uint8]) -> list[tuple[Floats | None, list[tuple[int, int]], list[int]]]:
    """Filters (None = as measured), the places of the cell that each is for, the colours it gives there."""
    places = [(row, column) for row in (0, 1) for column in (0, 1)]
    greens = [place for place in places if cell[place] == 1]
    others = [place for place in places if cell[place] != 1]
    return [
        (None, places, [int(cell[place]) for place in places]),
        (_GREEN, others, [1, 1]),
        (_ACROSS, others, [2 - int(cell[place]) for place in others]),
        (_BESIDE, greens, [int(cell[row, 1 - column]) for row, column in greens]),
        (_BESIDE.T.copy(), greens, [int(cell[1 - row, column]) for row, column in greens]),
    ]


def touched_by(samples: NDArray[np.bool_], margin: int | None = None) -> NDArray[np.bool_]:
    """Pixels into which some samples go: of `demosaic_bayer`, or all within a margin of pixels."""
    kernel = _TOUCHED if margin is None else np.ones((2 * margin + 1, 2 * margin + 1), np.uint8)
    return cv2.dilate(samples.astype(np.uint8), kernel).astype(bool)


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


def _filtered(mosaic: Floats, kernel: Floats) -> Floats:
    # reflection without the edge keeps the colours' places in the mosaic
    filtered = cv2.filter2D(mosaic, cv2.CV_32F, kernel / 8, borderType=cv2.BORDER_REFLECT_101)
    return np.asarray(filtered, np.float32)
