"""A ColorChecker Classic found in pictures, and the linear light of its patches.

It is found by OpenCV's detector, which takes a chart seen in a mirror for one, too: that is told by the order
of its corners. A patch counts by the pixels of its inner part, the darkest and brightest tenth left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.colour.reference import NEUTRAL, PATCHES
from calib.flash.pairs import LinearPicture
from capture.radiometry import Radiometry
from capture.response import Response

Floats = NDArray[np.float64]

_LEAST_SIDE_PX = 6.0  # of a patch's inner part
_CLIPPED = 0.01  # share of a patch's pixels
_LEAST_WHITE = 0.04  # radiance of the white patch: below, codes and noise tell little of the dark ones
_LARGEST_SPREAD = 0.12  # relative, of a light patch's pixels: more is glare, a shadow, or no patch
_TRIM = 10.0  # percent
_SEARCHED_PX = 1600  # the detector's time goes with the picture; corners are sought in one of this width
_LARGEST_MOVE = 0.2  # of a patch


class ChartProblem(Enum):
    """Why a picture tells no colours; the value is for people."""

    NOT_FOUND = "no ColorChecker was found: the whole chart must be seen, sharp and not too small"
    MIRRORED = "the chart is seen in a mirror, or the picture is mirrored"
    SMALL = "the chart is too small"
    CLIPPED = "the chart is overexposed"
    DARK = "the chart is too dark"
    UNEVEN = "patches are not even: glare, a shadow, or no ColorChecker"
    MOVED = "the chart moved between the two pictures"


@dataclass(frozen=True, eq=False)
class ChartReading:
    """The light of a chart in one picture.

    Attributes:
        name: of the picture.
        patches: [24, 3] linear camera RGB, in the order of the chart.
        noise: [24, 3] standard error of these.
    """

    name: str
    patches: Floats
    noise: Floats

    @property
    def dark(self) -> bool:
        """Whether there is too little light on the chart for its colours to be told."""
        return bool(self.patches[NEUTRAL][0].mean() < _LEAST_WHITE)


def find_chart(picture: LinearPicture) -> Floats | ChartProblem:
    """The corners [24, 4, 2] of the inner parts of the patches, pixels, or why there are none."""
    stored = _eight_bits(picture.stored)
    shrink = max(1.0, max(stored.shape[:2]) / _SEARCHED_PX)
    small = cv2.resize(stored, None, fx=1 / shrink, fy=1 / shrink, interpolation=cv2.INTER_AREA)
    detector = cv2.mcc.CCheckerDetector.create()
    detector.setColorChartType(cv2.mcc.MCC24)
    if not detector.process(np.ascontiguousarray(small[..., ::-1]), 1):
        return ChartProblem.NOT_FOUND
    corners = np.array(detector.getBestColorChecker().getColorCharts(), dtype=np.float64)
    if corners.shape != (4 * PATCHES, 2) or not np.isfinite(corners).all():
        return ChartProblem.NOT_FOUND
    corners = corners.reshape(PATCHES, 4, 2) * shrink
    side, along = corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 0]
    turn = side[:, 0] * along[:, 1] - side[:, 1] * along[:, 0]
    if (turn < 0).any():
        return ChartProblem.MIRRORED
    if np.sqrt(turn.min()) < _LEAST_SIDE_PX:
        return ChartProblem.SMALL
    return corners


def read_chart(
    picture: LinearPicture, corners: Floats, flat_field: Floats | None = None
) -> ChartReading | ChartProblem:
    """The light of the patches, or why it does not count.

    Args:
        picture: in linear light.
        corners: [24, 4, 2] as `find_chart` gives them.
        flat_field: [n] as in `calib.calibration`; None or empty = the lens passes all.
    """
    radiance = Radiometry(Response("linear"), flat_field=flat_field).radiance(picture.radiance)
    means, errors, spreads = np.zeros((PATCHES, 3)), np.zeros((PATCHES, 3)), np.zeros(PATCHES)
    for number, patch in enumerate(corners):
        inside = _inside(patch, picture.clipped.shape)
        if inside is None:
            return ChartProblem.NOT_FOUND
        rows, columns = inside
        if picture.clipped[rows, columns].mean() > _CLIPPED:
            return ChartProblem.CLIPPED
        pixels = radiance[rows, columns].astype(np.float64)
        grey = pixels.mean(axis=1)
        low, high = np.percentile(grey, (_TRIM, 100.0 - _TRIM))
        kept = pixels[(grey >= low) & (grey <= high)]
        means[number] = kept.mean(axis=0)
        errors[number] = kept.std(axis=0) / np.sqrt(len(kept))
        spreads[number] = kept.mean(axis=1).std() / max(abs(float(means[number].mean())), 1e-9)
    light = means.mean(axis=1) > max(0.3 * float(means[NEUTRAL][0].mean()), _LEAST_WHITE / 3)
    if light.any() and np.median(spreads[light]) > _LARGEST_SPREAD:
        return ChartProblem.UNEVEN
    return ChartReading(picture.name, means, errors)


def difference(lit: ChartReading, unlit: ChartReading) -> ChartReading:
    """What the flash adds to the light of a chart."""
    return ChartReading(lit.name, lit.patches - unlit.patches, np.hypot(lit.noise, unlit.noise))


def moved(corners: Floats, others: Floats) -> bool:
    """Whether a chart that was found twice [24, 4, 2] is at two places."""
    patch = np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1).mean()
    return bool(
        np.linalg.norm(corners.mean(axis=1) - others.mean(axis=1), axis=1).max() > _LARGEST_MOVE * patch
    )


def _inside(patch: Floats, shape: tuple[int, ...]) -> tuple[NDArray[np.intp], NDArray[np.intp]] | None:
    """Rows and columns of the pixels centred in a quadrangle [4, 2]; None where it leaves the picture."""
    low, high = np.floor(patch.min(axis=0)).astype(int), np.ceil(patch.max(axis=0)).astype(int)
    if (low < 0).any() or high[0] > shape[1] or high[1] > shape[0]:
        return None
    y, x = np.mgrid[low[1] : high[1], low[0] : high[0]] + 0.5
    within = np.ones(x.shape, bool)
    for start, end in zip(patch, np.roll(patch, -1, axis=0), strict=True):
        within &= (end[0] - start[0]) * (y - start[1]) - (end[1] - start[1]) * (x - start[0]) >= 0
    rows, columns = np.nonzero(within)
    return (rows + low[1], columns + low[0]) if len(rows) >= _LEAST_SIDE_PX**2 / 2 else None


def _eight_bits(stored: NDArray[Any]) -> NDArray[np.uint8]:
    """[H, W, 3] to find a chart in; what is linear gets a curve."""
    if stored.dtype == np.uint8:
        return np.asarray(stored, np.uint8)
    if stored.dtype == np.uint16:
        return np.asarray(stored >> 8, np.uint8)
    value = np.clip(np.nan_to_num(stored), 0.0, None)
    value = (value / max(float(np.percentile(value, 99.5)), 1e-6)).clip(0, 1) ** (1 / 2.2)
    return np.rint(255 * value).astype(np.uint8)
