"""Vignetting from pictures of an even surface: the lens passes 1 + a1 r^2 + a2 r^4 + a3 r^6.

No wall is lit evenly. Over the picture its light is a slope, which an even polynomial cannot take for the
lens, and a bowl. Of a bowl's three shapes two (x^2 - y^2 and xy) are no lens either and show how strong it
is; the third (x^2 + y^2) is exactly like a lens. So the size of the two, divided over the pictures, is the
uncertainty that one picture leaves, and several pictures of other places of the wall, or with the camera
turned, make it smaller. They are fitted one by one, and averaged.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.errors import FlatFieldError
from calib.stills import Still
from capture.response import Response

Floats = NDArray[np.float64]

TERMS = 3
_PARTS_ACROSS = 32
_CLIPPED_SHARE, _CLIPPED_PARTS = 0.002, 0.01
_DARKEST = 0.02
_TUKEY = 5.0
_LARGEST_SLOPE, _LARGEST_BOWL = 0.35, 0.06  # of the light, from the centre to the corner
_LARGEST_TEXTURE = 0.012  # relative, of the parts about the fit
_LARGEST_GRAIN = 0.12  # relative, of pixels within a part
_LARGEST_OUTLIERS = 0.05
_LARGEST_RISE = 1.02


@dataclass(frozen=True, eq=False)
class FlatCheck:
    """What one flat is like.

    Attributes:
        name: of the picture.
        slope: relative change of the light from the centre to the corner along its steepest direction.
        bowl: likewise, of what of its curvature is not radial.
        texture: relative standard deviation of parts of the picture about the fit.
        corner: what the lens passes in the corner, by this picture.
    """

    name: str
    slope: float
    bowl: float
    texture: float
    corner: float


@dataclass(frozen=True, eq=False)
class FlatFieldResult:
    """A flat field.

    Attributes:
        terms: [3] a1, a2, a3.
        covariance: [3, 3]: scatter of parts, and the light's bowl.
        flats: of each picture.
        size: (width, height), pixels.
        warnings: sentences.
    """

    terms: Floats
    covariance: Floats
    flats: tuple[FlatCheck, ...]
    size: tuple[int, int]
    warnings: tuple[str, ...]

    @property
    def sigma(self) -> Floats:
        """[3] standard deviations of the terms, which go together."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def passed(self, r: Floats) -> tuple[Floats, Floats]:
        """What the lens passes at radii [n] (1 = corner), and its standard deviation."""
        powers = np.stack([r ** (2 * k) for k in range(1, TERMS + 1)], axis=1)
        return 1.0 + powers @ self.terms, np.sqrt(np.einsum("nk,kl,nl->n", powers, self.covariance, powers))


def fit_flat_field(
    stills: Sequence[Still], response: Response, dark: Floats | None = None
) -> FlatFieldResult:
    """The flat field of one or more flats.

    Args:
        stills: pictures that an evenly lit, plain surface fills; better out of focus, each of another place
            or with the camera turned.
        response: stored value above the dark level -> radiance.
        dark: [3] stored dark level; None = 0.

    Raises:
        FlatFieldError: none, clipped, too dark, textured, or lit so unevenly that it is not radial.
    """
    if not stills:
        raise FlatFieldError("There are no pictures; give one or more of an evenly lit plain surface.")
    fits = []
    for still in stills:
        if still.image.shape[:2] != stills[0].image.shape[:2]:
            raise FlatFieldError(
                f"{still.name} and {stills[0].name} are of different sizes; a flat field holds for one."
            )
        fits.append(_fit_one(still, response, np.zeros(3) if dark is None else dark))
    terms = np.array([fit.terms for fit in fits])
    noise = np.mean([fit.covariance for fit in fits], axis=0) / len(fits)
    # The bowl's two visible shapes, over all pictures, tell the variance of the one that cannot be seen.
    bowl = np.mean([np.mean(fit.bowls**2) for fit in fits]) / len(fits)
    covariance = noise.copy()
    covariance[0, 0] += bowl
    mean = terms.mean(axis=0)
    warnings = []
    if len(fits) > 2:
        # Corners, as they differ from picture to picture, are another estimate of it: the larger counts.
        corners = terms.sum(axis=1)
        scatter = float(np.var(corners, ddof=1)) / len(fits)
        covariance[0, 0] += max(0.0, scatter - float(covariance.sum()))
    else:
        warnings.append(
            f"{'One picture does' if len(fits) == 1 else 'Two pictures do'} not tell a lamp's bowl of light "
            "from the lens; take three or more, each of another place or with the camera turned."
        )
    result = FlatFieldResult(
        mean, covariance, tuple(fit.check for fit in fits), _size(stills[0].image), tuple(warnings)
    )
    passed, _ = result.passed(np.linspace(0.0, 1.0, 41))
    if passed.min() <= 0.05 or passed.max() > _LARGEST_RISE:
        raise FlatFieldError(
            f"The pictures are {passed.max():.2f} times as bright away from the centre as there (least "
            f"{passed.min():.2f}); no lens does that. Light the surface evenly, and let it fill the picture."
        )
    return result


@dataclass(frozen=True, eq=False)
class _OneFit:
    terms: Floats  # [3]
    covariance: Floats  # [3, 3]
    bowls: Floats  # [2] x^2 - y^2 and 2 x y at the corner's radius, relative
    check: FlatCheck


def _fit_one(still: Still, response: Response, dark: Floats) -> _OneFit:
    """Light (level, slope, what of a bowl is not radial) times lens, robustly, over parts of the picture."""
    x, y, radiance, grain = _parts(still, response, dark)
    r2 = x * x + y * y
    log_level = np.log(radiance)
    # ln(level) + ln(light) + ln(lens), linearised about the last round's.
    terms, robust = np.zeros(TERMS), np.ones(len(x))
    powers = np.stack([r2**k for k in range(1, TERMS + 1)], axis=1)
    shapes = np.stack([x, y, x * x - y * y, 2 * x * y], axis=1)
    solution = np.zeros(5 + TERMS)
    for number in range(30):
        passed = np.maximum(1.0 + powers @ terms, 0.05)
        light = 1.0 + shapes @ solution[1:5]
        light = np.maximum(light, 0.05)
        model = solution[0] + np.log(light) + np.log(passed)
        design = np.column_stack([np.ones_like(x), shapes / light[:, None], powers / passed[:, None]])
        residual = log_level - model
        scale = max(1.4826 * float(np.median(np.abs(residual - np.median(residual)))), 1e-5)
        robust = np.maximum(1.0 - (residual / (_TUKEY * scale)) ** 2, 1e-6) ** 2 if number > 4 else robust
        normal = design.T @ (robust[:, None] * design)
        step = np.linalg.solve(normal, design.T @ (robust * residual))
        solution = solution + step
        terms = terms + step[5:]
        if np.abs(step).max() < 1e-9 and number > 6:
            break
    sound = robust > 0.1
    texture = float(np.sqrt(np.mean(residual[sound] ** 2)))
    bowls = solution[3:5]
    slope = float(np.hypot(*solution[1:3]))
    check = FlatCheck(still.name, slope, float(np.hypot(*bowls)), texture, float(1.0 + terms.sum()))
    _refuse(check, grain, float((~sound).mean()))
    # Neighbouring parts err together where the surface is mottled: their residuals' correlation counts.
    covariance = np.linalg.inv(normal) * texture**2 * _correlation_factor(x, y, residual * sound)
    return _OneFit(terms, covariance[5:, 5:], bowls, check)


def _refuse(check: FlatCheck, grain: float, outliers: float) -> None:
    if check.texture > _LARGEST_TEXTURE or grain > _LARGEST_GRAIN or outliers > _LARGEST_OUTLIERS:
        raise FlatFieldError(
            f"{check.name} does not show a plain surface: parts of it are {check.texture:.1%} off a smooth "
            f"fall of light ({outliers:.0%} of them far off; pixels within a part {grain:.1%}). Use paper or "
            "a wall without texture, out of focus, that fills the picture."
        )
    if check.slope > _LARGEST_SLOPE or check.bowl > _LARGEST_BOWL:
        raise FlatFieldError(
            f"{check.name} is lit unevenly: by {check.slope:.0%} along a slope and {check.bowl:.1%} in a "
            f"bowl that is not radial (at most {_LARGEST_SLOPE:.0%} and {_LARGEST_BOWL:.0%}). Move the lamp "
            "away, or use an overcast sky through a sheet of paper."
        )


def _parts(still: Still, response: Response, dark: Floats) -> tuple[Floats, Floats, Floats, float]:
    """Centres x, y (1 = half the diagonal) and mean radiance of parts, each channel's mean brought to 1.

    And the median relative standard deviation of pixels within a part.
    """
    image = still.image
    height, width = image.shape[:2]
    side = max(2, width // _PARTS_ACROSS)
    rows, columns = height // side, width // side
    if min(width, height) < 32 or rows * columns < 60:
        raise FlatFieldError(f"{still.name} is {width} x {height} pixels; at least 32 x 32 are needed.")
    # The parts are centred on the picture, so that what is left over is left over on all sides.
    top, left = (height - rows * side) // 2, (width - columns * side) // 2
    cut = image[top : top + rows * side, left : left + columns * side]
    cut = np.repeat(cut[..., None], 3, axis=2) if cut.ndim == 2 else cut
    clipped: NDArray[Any] = np.zeros(cut.shape[:2], bool)
    if cut.dtype == np.float32:
        linear = cut.astype(np.float64)
    else:
        white = np.iinfo(cut.dtype).max
        clipped = np.asarray((cut >= white).any(axis=2))
        stored = cut / white - dark
        linear = response.to_linear(np.maximum(stored, 0.0)).astype(np.float64)
    blocks = linear.reshape(rows, side, columns, side, 3).transpose(0, 2, 1, 3, 4)
    blocks = blocks.reshape(rows * columns, side * side, 3)
    share = np.asarray(clipped.reshape(rows, side, columns, side).mean(axis=(1, 3)))
    full = share.ravel() > _CLIPPED_SHARE
    if full.mean() > _CLIPPED_PARTS:
        raise FlatFieldError(
            f"{still.name} is clipped in {full.mean():.0%} of the picture; shorten the exposure so that the "
            "brightest place stays below white."
        )
    means = blocks.mean(axis=1)
    if means.mean(axis=0).max() < _DARKEST:
        raise FlatFieldError(
            f"{still.name} is too dark: its mean radiance is {means.mean():.3f} of white; expose it to "
            "about half."
        )
    bright = means.mean(axis=0) > 0.25 * means.mean(axis=0).max()  # a dim channel is mostly noise
    relative = (means[:, bright] / means[:, bright].mean(axis=0)).mean(axis=1)
    grain = blocks[..., bright].std(axis=1) / np.maximum(means[:, bright], 1e-6)
    half = 0.5 * np.hypot(width, height)
    y, x = np.mgrid[0:rows, 0:columns]
    x = (left + (x.ravel() + 0.5) * side - 0.5 * width) / half
    y = (top + (y.ravel() + 0.5) * side - 0.5 * height) / half
    keep = ~full & (relative > 0.02)
    return x[keep], y[keep], relative[keep], float(np.median(grain))


def _correlation_factor(x: Floats, y: Floats, residual: Floats) -> float:
    """What correlation between parts multiplies variances by: the sum of it over shifts of up to four."""
    columns = np.unique(np.round(x, 9), return_inverse=True)[1].ravel()
    rows = np.unique(np.round(y, 9), return_inverse=True)[1].ravel()
    grid = np.full((rows.max() + 1, columns.max() + 1), np.nan)
    grid[rows, columns] = residual
    power = np.nanmean(grid**2)
    total = 1.0
    if not power > 0:
        return total
    reach = min(4, min(grid.shape) - 1)
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            if (dy, dx) == (0, 0):
                continue
            one = grid[max(0, dy) : grid.shape[0] + min(0, dy), max(0, dx) : grid.shape[1] + min(0, dx)]
            two = grid[max(0, -dy) : grid.shape[0] + min(0, -dy), max(0, -dx) : grid.shape[1] + min(0, -dx)]
            total += float(np.nanmean(one * two) / power)
    return max(total, 1.0)


def _size(image: NDArray[Any]) -> tuple[int, int]:
    return image.shape[1], image.shape[0]
