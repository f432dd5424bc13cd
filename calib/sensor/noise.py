"""Dark level and noise of a camera: photon transfer (Janesick 2007) on linear radiance.

Two pictures of one scene differ by noise alone: what is fixed (the scene, the lens, the pixels' own gains and
offsets) drops out of their difference, so any still scene of many brightnesses will do, and flats do best.
Over parts of the picture, with m the mean radiance,

    var(difference) / 2  -  what rounding to codes adds  =  noise_read^2 + noise_shot m
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.errors import NoiseError
from calib.stills import Still
from capture.response import Response

Floats = NDArray[np.float64]

_LARGEST_DARK = 0.12  # stored; cameras put black at 16/255 at most, sensors at 1/16
_LARGEST_SHADING = 0.012  # of a dark picture: three codes of 8 bits
_AT_BLACK = 0.3  # share of pixels at the lowest code from which on black is cut off there
_GROUPS = 240
_LEAST_SIDE_PX = 8
_PAIR_RATIO = 1.05  # of the levels of two pictures of one exposure
_CUT_SHARE = 1e-3  # of a part's pixels at black or white, from which on it is left out
_LEAST_CODES = 0.4  # noise of fewer codes is not dithered: its variance cannot be told from rounding's
_LEAST_PARTS = 12
_LEAST_SPAN, _LEAST_TOP = 3.0, 0.05
_TUKEY = 5.0
_LARGEST_OUTLIERS = 0.3
_SHIFT_SIGMAS, _SHIFT = 5.0, 0.02  # a part whose mean changed by more has moved
_CORRELATED = 0.15


@dataclass(frozen=True, eq=False)
class DarkResult:
    """The dark level.

    Attributes:
        level: [3] stored value 0..1 of a frame without light.
        sigma: [3] its standard deviation.
        frames: how many were used.
        cut: whether the camera cuts off black, so that half of the dark noise is lost.
        warnings: sentences.
    """

    level: Floats
    sigma: Floats
    frames: int
    cut: bool
    warnings: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class NoiseResult:
    """The noise model of calibration.json: var = read^2 + shot * radiance.

    Attributes:
        read: [3] standard deviation of radiance at black.
        read_sigma: [3] of `read`.
        shot: [3] variance per radiance; 1 / shot is the full well in electrons at white.
        shot_sigma: [3] of `shot`.
        pairs: how many pairs of pictures.
        means: [m, 3] radiance and
        variances: [m, 3] variance of the parts; nan where left out.
        misfit: [3] scatter of the variances about the line over what their number of pixels promises.
        correlation: of the noise of neighbours.
        warnings: sentences.
    """

    read: Floats
    read_sigma: Floats
    shot: Floats
    shot_sigma: Floats
    pairs: int
    means: Floats
    variances: Floats
    misfit: Floats
    correlation: float
    warnings: tuple[str, ...]


def fit_dark(stills: Sequence[Still]) -> DarkResult:
    """The dark level from pictures without light.

    Medians count: where black is cut off, a mean would take the noise that is left for light.

    Raises:
        NoiseError: fewer than two, unlike each other, or not dark.
    """
    if len(stills) < 2:
        raise NoiseError(f"There are {len(stills)} dark pictures; at least 2 are needed, 8 are good.")
    levels, cuts = [], []
    for still in stills:
        image = _checked(still, stills[0])
        white = np.iinfo(image.dtype).max
        parts = _parts(image)
        local = np.median(parts, axis=1) / white
        level = np.array([_grouped_median(parts[..., c]) for c in range(3)]) / white
        if level.max() > _LARGEST_DARK:
            raise NoiseError(
                f"{still.name} is not dark: its level is {level.max():.3f} of white, at most "
                f"{_LARGEST_DARK:g} is taken for black. Cover the lens, not only the room."
            )
        low, high = np.percentile(local, (2, 98), axis=0)
        if (high - low).max() > max(_LARGEST_SHADING, 1.0 / white):
            raise NoiseError(
                f"{still.name} is not evenly dark: parts differ by {(high - low).max():.3f} of white. Light "
                "gets in; cover lens and viewfinder."
            )
        cuts.append((parts == 0).mean(axis=(0, 1)))
        levels.append(level)
    step = 1.0 / np.iinfo(stills[0].image.dtype).max
    share = np.mean(cuts, axis=0)
    cut = bool((share > _AT_BLACK).any())
    level = np.where(share > _AT_BLACK, 0.0, np.mean(levels, axis=0))
    scatter = np.var(levels, axis=0, ddof=1) / len(levels)
    # Within a code the median is told by noise alone; where black is cut off, by nothing.
    sigma = np.sqrt(scatter + np.where(share > _AT_BLACK, 0.3 * step, 0.05 * step) ** 2)
    warnings = []
    if cut:
        warnings.append("The camera cuts off black: dark pictures tell its level but not its noise.")
    return DarkResult(np.maximum(level, 0.0), sigma, len(stills), cut, tuple(warnings))


def fit_noise(
    stills: Sequence[Still], response: Response, dark: Floats | None = None, darks: Sequence[Still] = ()
) -> NoiseResult:
    """The noise model from pairs of pictures of a still scene at one or more exposures.

    Args:
        stills: in the order in which they were taken; two or more of each exposure, one after the other.
        response: stored value above the dark level -> radiance.
        dark: [3] stored dark level; None = 0.
        darks: pictures without light; where black is not cut off they fix the noise at black.

    Raises:
        NoiseError: no pairs, a scene that moved, levels too alike, or noise too small for the codes.
    """
    black = np.zeros(3) if dark is None else np.asarray(dark, dtype=np.float64)
    pairs = _pairs(stills)
    lit = len(pairs)
    pairs += list(zip(darks[0::2], darks[1::2], strict=False))
    if not lit:
        raise NoiseError(
            f"Of {len(stills)} pictures no two that follow each other are of one brightness; take two or "
            "more at each exposure, with everything locked."
        )
    decode = _Decoder(response, black, pairs[0][0].image.dtype)
    means, variances, pixels, correlations, moved = [], [], [], [], []
    for place, (a, b) in enumerate(pairs):
        mean, variance, count, correlation, far = _transfer(
            _checked(a, stills[0]), _checked(b, stills[0]), decode, dark=place >= lit
        )
        means.append(mean)
        variances.append(variance)
        pixels.append(count)
        correlations.append(correlation)
        moved.append(far)
    mean, variance = np.concatenate(means), np.concatenate(variances)
    number = np.concatenate(pixels)
    _refuse_poor(mean, variance)
    lines = [_line(mean[:, c], variance[:, c], number) for c in range(3)]
    outliers = max(max(line.outliers for line in lines), float(np.median(moved[:lit])))
    if outliers > _LARGEST_OUTLIERS:
        raise NoiseError(
            f"In {outliers:.0%} of the picture two shots differ by more than noise: the scene or the camera "
            "moved between them, or the light flickers. Use a tripod and steady light."
        )
    warnings = []
    correlation = float(np.nanmedian(correlations))
    if abs(correlation) > _CORRELATED:
        warnings.append(
            f"The noise of neighbouring pixels goes together ({correlation:+.2f}): the camera sharpens, "
            "denoises or compresses, and the noise found is what that leaves."
        )
    misfit = np.array([line.misfit for line in lines])
    if misfit.max() > 3.0:
        warnings.append(
            f"The variances scatter {misfit.max():.1f} times as far about the line as they should: noise is "
            "not of this form here, or the response is wrong; the uncertainty allows for it."
        )
    return NoiseResult(
        read=np.array([line.read for line in lines]),
        read_sigma=np.array([line.read_sigma for line in lines]),
        shot=np.array([line.shot for line in lines]),
        shot_sigma=np.array([line.shot_sigma for line in lines]),
        pairs=len(pairs),
        means=mean,
        variances=variance,
        misfit=misfit,
        correlation=correlation,
        warnings=tuple(warnings),
    )


class _Decoder:
    """Codes to radiance by table; below black the response goes on as its mirror image."""

    def __init__(self, response: Response, dark: Floats, kind: np.dtype[Any]) -> None:
        self.white = int(np.iinfo(kind).max)
        edges = (np.arange(self.white + 2) - 0.5) / self.white
        self.table = self._radiance(response, np.arange(self.white + 1) / self.white, dark)
        steps = np.diff(self._radiance(response, edges, dark), axis=0)
        self.rounding = steps**2 / 12.0

    @staticmethod
    def _radiance(response: Response, stored: Floats, dark: Floats) -> Floats:
        above = stored[:, None] - dark
        linear = response.to_linear(np.minimum(np.abs(above), 1.0)).astype(np.float64)
        return np.asarray(np.sign(above) * linear)

    def planes(self, codes: NDArray[Any], table: Floats) -> Floats:
        """[..., 3] the table's values at codes [..., 3]."""
        return np.stack([table[codes[..., c], c] for c in range(3)], axis=-1)


@dataclass(frozen=True)
class _Line:
    read: float
    read_sigma: float
    shot: float
    shot_sigma: float
    misfit: float
    outliers: float


def _transfer(
    a: NDArray[Any], b: NDArray[Any], decode: _Decoder, dark: bool
) -> tuple[Floats, Floats, Floats, float, float]:
    """Mean [G, 3], variance [G, 3], pixels [G] of a pair's parts; neighbours' correlation; share moved."""
    codes_a, codes_b = _parts(a), _parts(b)
    one, two = decode.planes(codes_a, decode.table), decode.planes(codes_b, decode.table)
    scale = one.mean(axis=(0, 1)) / np.maximum(two.mean(axis=(0, 1)), 1e-9)
    difference = one - two * (1.0 if dark else scale)  # at black the ratio is noise
    shift = difference.mean(axis=1, keepdims=True)
    difference -= shift
    count = difference.shape[1]
    variance = (difference**2).sum(axis=1) / (2.0 * (count - 1))
    rounding = 0.5 * (decode.planes(codes_a, decode.rounding) + decode.planes(codes_b, decode.rounding))
    in_codes = np.std(codes_a.astype(np.float32) - codes_b.astype(np.float32), axis=1) / np.sqrt(2.0)
    cut = ((codes_a == 0) | (codes_b == 0)).mean(axis=1) > _CUT_SHARE
    full = ((codes_a >= decode.white) | (codes_b >= decode.white)).any(axis=2).mean(axis=1) > _CUT_SHARE
    sound = ~cut & ~full[:, None] & (in_codes > _LEAST_CODES)
    mean = 0.5 * (one + two).mean(axis=1)
    far = np.abs(shift[:, 0]) > _SHIFT_SIGMAS * np.sqrt(2.0 * variance / count) + _SHIFT * np.abs(mean)
    return (
        mean,
        np.where(sound, variance - rounding.mean(axis=1), np.nan),
        np.full(len(mean), float(count)),
        _neighbours(a, b, decode),
        float(far.any(axis=1).mean()),
    )


def _neighbours(a: NDArray[Any], b: NDArray[Any], decode: _Decoder) -> float:
    """Correlation of the difference of two pictures from one pixel to the next, of the green channel."""
    codes = [image[..., 1] if image.ndim == 3 else image for image in (a, b)]
    linear = [decode.table[plane, 1] for plane in codes]
    difference = linear[0] - linear[1]
    sound = (codes[0] > 0) & (codes[0] < decode.white)
    both = sound[:, 1:] & sound[:, :-1]
    left, right = difference[:, :-1][both], difference[:, 1:][both]
    if both.sum() < 100 or left.std() == 0 or right.std() == 0:
        return float("nan")
    return float(np.corrcoef(left, right)[0, 1])


def _refuse_poor(mean: Floats, variance: Floats) -> None:
    sound = np.isfinite(variance)
    if sound.sum(axis=0).min() < _LEAST_PARTS:
        raise NoiseError(
            f"Only {sound.sum(axis=0).min()} parts of the pictures are neither black nor white with noise of "
            f"more than {_LEAST_CODES:g} codes; at least {_LEAST_PARTS} are needed. Use other exposures, or "
            "raise the gain: a denoised picture does not tell the noise."
        )
    for channel in range(3):
        levels = mean[sound[:, channel], channel]
        low, high = np.percentile(levels, (1, 99))
        if high < _LEAST_TOP or high < _LEAST_SPAN * max(low, 1e-6):
            raise NoiseError(
                f"The pictures have radiances from {low:.3f} to {high:.3f} of white; noise at black and "
                f"noise of light cannot be told apart. Take pairs at several exposures, from nearly black to "
                "nearly white."
            )


def _line(mean: Floats, variance: Floats, count: Floats) -> _Line:
    """Weighted robust line through variances whose own scatter is 2 var^2 / (n - 1)."""
    sound = np.isfinite(variance)
    m, v, n = mean[sound], variance[sound], count[sound]
    design = np.stack([np.ones_like(m), m], axis=1)
    model = np.maximum(v, 1e-12)
    robust = np.ones_like(m)
    solution, covariance = np.zeros(2), np.eye(2)
    for _ in range(20):
        sigma = model * np.sqrt(2.0 / (n - 1))
        w = robust / sigma**2
        covariance = np.linalg.inv(design.T @ (w[:, None] * design))
        solution = covariance @ (design.T @ (w * v))
        if solution[0] < 0:  # noise cannot be negative at black
            solution = np.array([0.0, float(np.sum(w * v * m) / np.sum(w * m * m))])
        model = np.maximum(design @ solution, 0.05 * np.median(v))
        standard = (v - design @ solution) / (model * np.sqrt(2.0 / (n - 1)))
        scale = max(1.0, 1.4826 * float(np.median(np.abs(standard))))
        robust = np.maximum(1.0 - (standard / (_TUKEY * scale)) ** 2, 1e-6) ** 2
    covariance = covariance * scale**2
    power, power_sigma = max(float(solution[0]), 0.0), float(np.sqrt(covariance[0, 0]))
    read = float(np.sqrt(power))
    return _Line(
        read,
        power_sigma / (2.0 * max(read, 0.5 * np.sqrt(power_sigma))),
        float(max(solution[1], 0.0)),
        float(np.sqrt(covariance[1, 1])),
        scale,
        float(((v > 2.0 * model) & (robust < 0.1)).mean()),
    )


def _pairs(stills: Sequence[Still]) -> list[tuple[Still, Still]]:
    """Pictures of one brightness that follow each other, each used once."""
    levels = [float(still.image.mean()) for still in stills]
    pairs, number = [], 0
    while number + 1 < len(stills):
        ratio = max(levels[number], 1e-3) / max(levels[number + 1], 1e-3)
        if 1.0 / _PAIR_RATIO < ratio < _PAIR_RATIO:
            pairs.append((stills[number], stills[number + 1]))
            number += 2
        else:
            number += 1
    return pairs


def _checked(still: Still, first: Still) -> NDArray[Any]:
    """The picture, if it is of a kind with the first one."""
    image = still.image
    if image.dtype not in (np.uint8, np.uint16):
        raise NoiseError(f"{still.name} holds {image.dtype} pixels; pictures of 8 or 16 bits are needed.")
    if image.shape != first.image.shape or image.dtype != first.image.dtype:
        raise NoiseError(f"{still.name} and {first.name} are of different sizes or kinds; use one format.")
    return image


def _parts(image: NDArray[Any]) -> NDArray[Any]:
    """[G, n, 3] codes of square parts that tile the picture."""
    height, width = image.shape[:2]
    side = max(_LEAST_SIDE_PX, int(np.sqrt(height * width / _GROUPS)))
    rows, columns = height // side, width // side
    if rows * columns < 4:
        raise NoiseError(f"The pictures are {width} x {height} pixels; at least 16 x 16 are needed.")
    planes = image[: rows * side, : columns * side].reshape(rows, side, columns, side, -1)
    parts = planes.transpose(0, 2, 1, 3, 4).reshape(rows * columns, side * side, -1)
    return np.repeat(parts, 3, axis=2) if parts.shape[2] == 1 else parts[:, :, :3]


def _grouped_median(codes: NDArray[Any]) -> float:
    """Median of rounded numbers, interpolated within its code."""
    flat = codes.ravel()
    middle = int(np.median(flat))
    return middle - 0.5 + (0.5 - float((flat < middle).mean())) / max(float((flat == middle).mean()), 1e-9)
