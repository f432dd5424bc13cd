"""What the frames of a pulse would look like without the flash.

The unlit frames before and after the pulse are brought to each frame's moment along their optical flow and
blended. The flow is between unlit frames, so the flash cannot disturb it. What remains of the camera's
motion (a hand's tremor is no straight line) is a small affine shift, found per frame on the fine structure
of the picture only, which the smooth flash does not have.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from capture.tagging.profiles import BLACK_FLOOR, THUMBNAIL_COLUMNS, THUMBNAIL_ROWS, FrameProfiles

Floats = NDArray[np.float64]
Image = NDArray[np.float32]

#: Grid on which gains are measured: two thumbnail rows a band, wide columns. Light is summed inside a
#: block before the ratio,
#: so what moves inside a block does not matter.
BANDS, COLUMNS = 48, 16
# Rounds of reweighting of the affine fit; it is a small correction to the flow.
_AFFINE_ROUNDS = 3
# Cells of the high pass: far below the head's size, above the texture's.
_HIGH_PASS_CELLS = 3.0
# Cells; the gradient describes the picture no farther.
_LARGEST_SHIFT = 1.5

_Y, _X = (a.astype(np.float32) for a in np.mgrid[0:THUMBNAIL_ROWS, 0:THUMBNAIL_COLUMNS])


@dataclass(frozen=True, eq=False)
class PulseGain:
    """Gain over the no-flash reference in the frames around one pulse.

    Attributes:
        frames: [n] indices of the frames.
        gain: [n, BANDS, COLUMNS] light over reference, minus 1.
        doubt: [BANDS, COLUMNS] standard deviation of the gain, from the disagreement of the two sides.
        slope: [BANDS, COLUMNS] change of the log reference from one band to the next: a vertical misfit of
            the reference makes an error of this shape in all columns at once.
    """

    frames: NDArray[np.int_]
    gain: Floats
    doubt: Floats
    slope: Floats


class Reference:
    """Predicts unlit frames of a sequence."""

    def __init__(self, profiles: FrameProfiles, row_gain: Floats | None = None):
        """Start from a sequence.

        Args:
            profiles: the sequence.
            row_gain: [K, THUMBNAIL_ROWS] gain of the room light per frame and row (mains flicker); None =
                constant.
        """
        self._profiles = profiles
        self._row_gain = row_gain
        self._flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
        # thumbnails are small: one octave finer than the preset's default
        self._flow.setFinestScale(1)

    def gain(self, frames: NDArray[np.int_], before: int | None, after: int | None) -> PulseGain:
        """Gain of frames over what unlit frames on both sides predict.

        Args:
            frames: [n] indices.
            before: an unlit frame before them all; None at the start of a sequence.
            after: an unlit frame after them all; None at the end.
        """
        if before is None and after is None:
            raise ValueError("a reference needs an unlit frame on one side at least")
        left = before if before is not None else after
        right = after if after is not None else before
        assert left is not None
        assert right is not None
        a, b = self._unlit(left), self._unlit(right)
        forward, backward = self._motion(left, right)
        t = self._profiles.pts_s
        gain, doubt, level = [], [], []
        for k in frames:
            share = np.float32((t[k] - t[left]) / (t[right] - t[left]) if right != left else 0.5)
            picture = self._profiles.linear(k)
            from_a, from_b = _warp(a, share * backward), _warp(b, (1 - share) * forward)
            blend = (1 - share) * from_a + share * from_b
            rest = _affine_motion(np.log(picture) - np.log(blend), np.log(blend))
            # again from the originals: every resampling costs texture
            from_a, from_b = _warp(a, share * backward + rest), _warp(b, (1 - share) * forward + rest)
            blend = (1 - share) * from_a + share * from_b
            row_gain = 1.0 if self._row_gain is None else self._row_gain[k][:, None].astype(np.float32)
            expected = _blocks(blend * row_gain)
            gain.append(_blocks(picture) / expected - 1)
            level.append(np.log(expected))
            doubt.append(np.log(_blocks(from_a)) - np.log(_blocks(from_b)))
        # The blend of two predictions with independent errors is off by about half their difference.
        # A blur by running sums leaves rounding below zero where both predictions are the same.
        scatter = np.maximum(cv2.blur(np.mean(np.square(doubt), axis=0), (3, 3)), 0.0)
        return PulseGain(
            frames=np.asarray(frames),
            gain=np.array(gain),
            doubt=0.5 * np.sqrt(scatter),
            slope=np.gradient(np.mean(level, axis=0), axis=0),
        )

    def _unlit(self, index: int) -> Image:
        picture = self._profiles.linear(index)
        if self._row_gain is None:
            return picture
        return picture / self._row_gain[index][:, None].astype(np.float32)

    def _motion(self, left: int, right: int) -> tuple[Image, Image]:
        """[h, w, 2] flow from left to right and from right to left, cells."""
        if left == right:
            still = np.zeros((THUMBNAIL_ROWS, THUMBNAIL_COLUMNS, 2), np.float32)
            return still, still
        codes = self._profiles.codes[[left, right]].astype(np.float32)
        low, high = np.quantile(codes, [0.01, 0.99])  # full contrast also in a dark room
        a, b = np.clip((codes - low) * (255 / max(high - low, 8.0)), 0, 255).astype(np.uint8)
        flow = np.zeros((2, THUMBNAIL_ROWS, THUMBNAIL_COLUMNS, 2), np.float32)
        self._flow.calc(a, b, flow[0])
        self._flow.calc(b, a, flow[1])
        return flow[0], flow[1]


def _warp(picture: Image, flow: Image) -> Image:
    """The picture's values at each cell plus its flow.

    Cubic, because linear interpolation smooths the texture away, differently for each flow; where cubic
    overshoots below black, black.
    """
    warped = cv2.remap(
        picture, _X + flow[..., 0], _Y + flow[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
    )
    return np.maximum(warped, np.float32(BLACK_FLOOR))


def _blocks(picture: NDArray[np.floating]) -> Floats:
    return cv2.resize(picture.astype(np.float32), (COLUMNS, BANDS), interpolation=cv2.INTER_AREA).astype(
        np.float64
    )


def _affine_motion(difference: Image, log_reference: Image) -> Image:
    """The small affine motion of the reference that explains a log difference best: [h, w, 2] cells.

    Linear in the six parameters: the motion times the reference's gradient. Both sides are high-passed,
    which takes out the flash (smooth over cells) and leaves the texture; weights 1 / (1 + (r/2s)^2)
    (Cauchy) keep out what moves otherwise.
    """
    smooth = cv2.GaussianBlur(log_reference, (0, 0), 0.7)
    gx, gy = (
        cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=1 / 8),
        cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=1 / 8),
    )
    x, y = _X / THUMBNAIL_COLUMNS - 0.5, _Y / THUMBNAIL_ROWS - 0.5
    basis = np.stack([gx, gy, x * gx, y * gx, x * gy, y * gy])
    fine = np.stack([_high_pass(layer) for layer in basis]).reshape(6, -1)
    target = _high_pass(difference).ravel()
    weight = np.ones_like(target)
    parameters = np.zeros(6, np.float32)
    for _ in range(_AFFINE_ROUNDS):
        weighted = fine * weight
        normal = weighted @ fine.T
        normal += np.eye(6, dtype=np.float32) * (1e-4 * np.trace(normal) / 6 + 1e-9)
        parameters = np.linalg.solve(normal, weighted @ target)
        residual = target - parameters @ fine
        scale = 1.4826 * np.median(np.abs(residual)) + 1e-6
        weight = 1 / (1 + (residual / (2 * scale)) ** 2)
    along_x = parameters[0] + parameters[2] * x + parameters[3] * y
    along_y = parameters[1] + parameters[4] * x + parameters[5] * y
    return np.clip(np.stack([along_x, along_y], axis=-1), -_LARGEST_SHIFT, _LARGEST_SHIFT).astype(np.float32)


def _high_pass(layer: Image) -> Image:
    return layer - cv2.GaussianBlur(layer, (0, 0), _HIGH_PASS_CELLS)
