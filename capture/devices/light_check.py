"""Whether a camera really exposes as it says: halve the exposure, and the light in the picture must halve.

A camera's word for its controls is not enough: drivers answer from their own memory, firmware forgets manual
mode when a stream starts, some values roll over to dark, and an automatic gain may fill up what the exposure
lost. The check looks at the pictures alone, so it works on every back end.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture.devices.camera import CapturedFrame, StreamFormat
from capture.devices.pixel_formats import FrameDataError, luma_levels, small_planes
from capture.errors import CameraError
from capture.transfer import to_linear

#: Frames in flight when a control is set, and the two or three that a sensor takes to follow.
LATENCY_FRAMES = 6
#: Buffers of a driver, at most; frames that come faster than this share of their interval have waited there.
_WAITING_FRAMES, _AT_ONCE = 32, 0.3
#: Frames that are averaged: noise, and most of the mains' flicker.
MEASURED_FRAMES = 6
#: An automatic takes about a second to fill up what was taken away.
_HOLD_FRAMES = 24
#: Linear light of pixels that can tell: above the black level's and the noise's reach, below the shoulder.
_DARKEST, _BRIGHTEST = 0.01, 0.75
_ENOUGH_PIXELS = 0.02
#: The ratio is judged as a power of the one expected, because a camera's tone curve is not quite the one that
#: its format names: between exponents 0.55 and 1.7 (0.68 and 0.31 for a half). No exposure at all gives 0.
_LEAST_EXPONENT, _LARGEST_EXPONENT = 0.55, 1.7
#: Relative change that counts as one: of the scene between two looks, of the light while nothing is touched.
_STEADY, _CREEP = 0.12, 0.15
_SMALL_SIDE = 120


@dataclass(frozen=True)
class LightCheck:
    """What the light says of an exposure control.

    Attributes:
        verified: True: the light follows; False: it does not; None: it could not be told.
        expected: Ratio of light that the exposures promise.
        measured: Ratio that came; None = not measured.
        note: In words, for the lock report.
    """

    verified: bool | None
    expected: float | None
    measured: float | None
    note: str


def linear_luma(frame: CapturedFrame, format: StreamFormat) -> NDArray[np.float32]:
    """Linear light [h, w] of a frame, reduced; 1 = white clip.

    Raises:
        FrameDataError: Its bytes are damaged.
    """
    small, _ = small_planes(frame.data, format, _SMALL_SIDE)
    black, white = luma_levels(format) or (0.0, float(np.iinfo(small.dtype).max))
    display = (small.astype(np.float32) - np.float32(black)) / np.float32(white - black)
    linear = to_linear(np.clip(display, 0.0, 1.0), format.transfer)
    weights = np.array([0.2126, 0.7152, 0.0722], np.float32)  # BT.709-6; the channels' sum, roughly
    return linear if linear.ndim == 2 else np.asarray(linear @ weights, np.float32)


def mean_light(
    read: Callable[[], CapturedFrame], format: Callable[[], StreamFormat], frames: int = MEASURED_FRAMES
) -> NDArray[np.float64]:
    """Mean linear light [h, w] of the next sound frames.

    Raises:
        CameraError: Too many of them are damaged, or the camera fails.
    """
    total: NDArray[Any] | None = None
    count = 0
    for _ in range(3 * frames + 10):
        frame = read()
        if frame.damaged:
            continue
        try:
            light = linear_luma(frame, format()).astype(np.float64)
        except FrameDataError:
            continue
        total = light if total is None else total + light
        count += 1
        if count == frames:
            break
    if total is None or count < frames:
        raise CameraError(
            f"Of {3 * frames + 10} frames only {count} were whole; use a shorter cable, a port of its own "
            "for the camera, or a smaller picture."
        )
    return np.asarray(total / count)


def verify_exposure(
    read: Callable[[], CapturedFrame],
    format: Callable[[], StreamFormat],
    set_exposure: Callable[[float], float],
    exposure_s: float,
) -> LightCheck:
    """Halves the exposure, compares the light, and sets the exposure again.

    The light of the room must be steady meanwhile and the flash off; it takes about fifty frames.

    Args:
        read: The next frame.
        format: Of the frames.
        set_exposure: Asks for an exposure in seconds; gives what the device says it took.
        exposure_s: That is set now, and again afterwards, whatever happens.

    Returns:
        The verdict; `verified` is None where the picture is too dark, too bright or too unsteady to tell.

    Raises:
        CameraError: The camera fails.
    """
    try:
        tried = "the picture is too dark or too bright"
        for top, bottom in ((1.0, 0.5), (2.0, 1.0), (0.5, 0.25), (0.25, 0.125)):
            long_s = set_exposure(top * exposure_s)
            skip_latency(read)
            before = mean_light(read, format, MEASURED_FRAMES)
            telling = (before > _DARKEST) & (before < _BRIGHTEST)
            if telling.mean() < _ENOUGH_PIXELS:
                continue
            short_s = set_exposure(bottom * exposure_s)
            if not short_s < 0.8 * long_s:
                tried = f"the device does not take an exposure shorter than {short_s:.5f} s"
                continue
            return _compare(read, format, set_exposure, before, telling, long_s, short_s)
        return LightCheck(None, None, None, f"not verified with light: {tried}")
    finally:
        set_exposure(exposure_s)


def skip_latency(read: Callable[[], CapturedFrame]) -> None:
    """Lets the frames pass that were under way before a control was set, in buffers and in the camera."""
    frame = read()
    for _ in range(_WAITING_FRAMES):
        before, frame = frame, read()
        if frame.arrival_s - before.arrival_s > _AT_ONCE * (frame.stamp_s - before.stamp_s):
            break  # it had to be waited for: no older one is left in the buffers
    for _ in range(LATENCY_FRAMES - 2):
        read()


def _compare(
    read: Callable[[], CapturedFrame],
    format: Callable[[], StreamFormat],
    set_exposure: Callable[[float], float],
    before: NDArray[np.float64],
    telling: NDArray[np.bool_],
    long_s: float,
    short_s: float,
) -> LightCheck:
    expected = short_s / long_s
    skip_latency(read)
    during = mean_light(read, format, MEASURED_FRAMES)
    for _ in range(_HOLD_FRAMES):
        read()
    later = mean_light(read, format, MEASURED_FRAMES)
    set_exposure(long_s)
    skip_latency(read)
    after = mean_light(read, format, MEASURED_FRAMES)

    level = {name: float(light[telling].sum()) for name, light in (("before", before), ("after", after))}
    shorter, held = float(during[telling].sum()), float(later[telling].sum())
    measured = shorter / level["before"]
    if held > (1 + _CREEP) * shorter and measured < 0.9:
        return LightCheck(
            False,
            expected,
            measured,
            f"with {expected:.2f} of the exposure the light fell to {measured:.2f} and then rose to "
            f"{held / level['before']:.2f}: an automatic is still at work",
        )
    low, high = expected**_LARGEST_EXPONENT, expected**_LEAST_EXPONENT
    followed = min(shorter, held) <= high * max(level.values())
    if followed and abs(level["after"] / level["before"] - 1) > _STEADY:
        return LightCheck(
            None,
            expected,
            measured,
            f"not verified with light: it changed by itself, to {level['after'] / level['before']:.2f}",
        )
    if low <= measured <= high:
        return LightCheck(
            True, expected, measured, f"{expected:.2f} of the exposure gives {measured:.2f} of the light"
        )
    return LightCheck(
        False,
        expected,
        measured,
        f"{expected:.2f} of the exposure gives {measured:.2f} of the light: the camera does not expose as it "
        "says",
    )
