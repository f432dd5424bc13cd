"""A response beside what others make of the same pictures: OpenCV's Debevec and Robertson, and known curves.

Both of OpenCV's take the exposures at their word and give no uncertainty; Debevec's takes a few points of the
picture (Debevec and Malik 1997), Robertson's all of it (Robertson et al. 1999). Where they disagree with each
other, the sweep is poor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.response.fit import ResponseResult
from calib.response.groups import SweepFrame
from capture.transfer import OPEN_CAMERA_PROFILES, to_linear

Floats = NDArray[np.float64]

_SIDE = 120  # of the pictures that OpenCV gets; Robertson's takes seconds for 640 x 480
_TOLD = (0.15, 0.85)  # stored values at which both are compared: theirs are noise or guessed beyond
_CURVES = ("linear", "srgb", "rec709", "gamma:2.2", *OPEN_CAMERA_PROFILES.values())


@dataclass(frozen=True)
class OtherResponse:
    """How far another response is from ours, after the best common factor.

    Attributes:
        name: of the method or the curve.
        median: relative difference, over the stored values that it tells.
        largest: likewise.
    """

    name: str
    median: float
    largest: float


def compare_opencv(frames: Sequence[SweepFrame], result: ResponseResult) -> tuple[OtherResponse, ...]:
    """OpenCV's two responses of the green channel against ours; none for pictures of 16 bits."""
    if any(frame.image.dtype != np.uint8 for frame in frames):
        return ()
    wrong = {check.name for check in result.frames if not check.used}
    sound = [frame for frame in frames if frame.name not in wrong]
    stride = max(1, min(sound[0].image.shape[:2]) // _SIDE)
    small = [np.ascontiguousarray(_colour(frame.image)[::stride, ::stride, ::-1]) for frame in sound]
    times = np.array([frame.exposure_s for frame in sound], dtype=np.float32)
    codes = np.arange(256) / 255.0
    compared = []
    for name, method in (
        ("Debevec (OpenCV)", cv2.createCalibrateDebevec(samples=200)),
        ("Robertson (OpenCV)", cv2.createCalibrateRobertson()),
    ):
        theirs = np.asarray(method.process(small, times), dtype=np.float64).reshape(256, 3)[:, 1]
        ours = np.interp(codes - result.dark[1], result.stored, _green(result))
        compared.append(_compare(name, theirs, ours, codes))
    return tuple(compared)


def nearest_curve(result: ResponseResult) -> OtherResponse:
    """The named transfer function that is nearest to the response."""
    return min(
        (
            _compare(name, to_linear(result.stored, name).astype(np.float64), _green(result), result.stored)
            for name in dict.fromkeys(_CURVES)
        ),
        key=lambda other: other.median,
    )


def _compare(name: str, theirs: Floats, ours: Floats, stored: Floats) -> OtherResponse:
    told = (stored > _TOLD[0]) & (stored < _TOLD[1]) & (theirs > 0) & (ours > 0)
    if not told.any():
        return OtherResponse(name, float("inf"), float("inf"))
    ratio = np.log(theirs[told] / ours[told])
    apart = np.abs(np.expm1(ratio - np.median(ratio)))
    return OtherResponse(name, float(np.median(apart)), float(apart.max()))


def _green(result: ResponseResult) -> Floats:
    return result.linear if result.linear.ndim == 1 else result.linear[:, 1]


def _colour(image: NDArray[np.generic]) -> NDArray[np.generic]:
    return np.repeat(image[..., None], 3, axis=2) if image.ndim == 2 else image
