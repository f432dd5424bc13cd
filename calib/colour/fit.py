"""The matrix from linear camera RGB to linear sRGB, by the patches of a chart.

Sought is the matrix whose result is nearest to the reference in CIELAB; a matrix, because light adds up, and
what the flash adds is taken as a difference of pictures. Beside it, for judging it, stands the
root-polynomial correction (Finlayson, Mackiewicz and Hurlbert 2015), which does not add up. Light that falls
on the chart as a slope is found along with the matrix: it changes the patches' brightness but not their
colour. Every error is also stated for patches that the matrix was not fitted to.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from calib.colour.chart import ChartReading
from calib.colour.reference import (
    EDITIONS,
    NEUTRAL,
    PATCHES,
    PLACES,
    Reference,
    delta_e,
    lab_of,
    load_reference,
    luminance,
)
from calib.errors import ColourError

Floats = NDArray[np.float64]
Correct = Callable[[NDArray[np.int64]], Floats]

_ROUNDS = 6
_LARGEST_SLOPE = 0.4  # of the light, from the middle of the chart to its end
_LARGEST_ERROR, _DOUBTFUL_ERROR = 6.0, 3.5  # mean CIEDE2000 of patches left out
_LARGEST_GAIN = 6.0  # of noise, by the matrix


@dataclass(frozen=True, eq=False)
class Errors:
    """Differences from the reference, CIEDE2000 by patch.

    Attributes:
        fitted: [24] with all patches fitted.
        left_out: [24] of each patch by what the 23 others give.
    """

    fitted: Floats
    left_out: Floats

    def describe(self) -> str:
        """Mean, 95 %, largest; and mean of those left out."""
        return (
            f"mean {self.fitted.mean():.2f}, 95 % {np.percentile(self.fitted, 95):.2f}, largest "
            f"{self.fitted.max():.2f}; left out {self.left_out.mean():.2f}"
        )


@dataclass(frozen=True, eq=False)
class ColourFit:
    """A colour correction for one light.

    Attributes:
        matrix: [3, 3] linear camera RGB -> linear sRGB; white in this light keeps its green.
        sigma: [3, 3] standard deviation.
        white: [3] camera RGB of a perfect white in this light, its green 1.
        level: green of a perfect white by the scale of `patches`.
        patches: [24, 3] camera RGB that was fitted, slope of the light taken out, scale of the reference.
        reference: the edition of the chart that fits better.
        errors: of the matrix.
        polynomial_errors: of the root-polynomial of degree two.
        uncorrected: [24] CIEDE2000 of camera RGB with nothing but its white brought to white.
        slopes: [n] how much the light changes from the middle of the chart to its end, by picture.
        names: of the pictures.
        warnings: sentences.
    """

    matrix: Floats
    sigma: Floats
    white: Floats
    level: float
    patches: Floats
    reference: Reference
    errors: Errors
    polynomial_errors: Errors
    uncorrected: Floats
    slopes: Floats
    names: tuple[str, ...]
    warnings: tuple[str, ...]

    @property
    def corrected(self) -> Floats:
        """[24, 3] linear sRGB of the patches, to be compared with the reference."""
        return apply_matrix(self.matrix, self.patches) / self.level


def fit_colour(readings: Sequence[ChartReading], edition: str | None = None) -> ColourFit:
    """The correction of one light.

    Args:
        readings: of one chart in that light, of one or more pictures.
        edition: of the chart; None = the one of `EDITIONS` that fits better.

    Raises:
        ColourError: the patches are not those of the chart, or lit too unevenly.
    """
    if not readings:
        raise ColourError("There is no picture of a chart to fit.")
    if edition is not None and edition not in EDITIONS:
        raise ColourError(f"The edition {edition!r} is unknown; known are {', '.join(EDITIONS)}.")
    names = [edition] if edition is not None else list(EDITIONS)
    tried = [_fit_edition(readings, load_reference(name)) for name in names]
    found = min(tried, key=lambda fit: float(fit.errors.left_out.mean()))
    if not found.errors.left_out.mean() <= _LARGEST_ERROR:
        raise ColourError(
            "The patches are not those of a ColorChecker Classic in one even light: patches left out are "
            f"{found.errors.left_out.mean():.1f} CIEDE2000 off (at most {_LARGEST_ERROR:g}). Keep glare, "
            "shadows and coloured reflections off the chart, and calibrate the response."
        )
    if np.abs(found.slopes).max() > _LARGEST_SLOPE:
        raise ColourError(
            f"The light on the chart changes by {np.abs(found.slopes).max():.0%} from its middle to its end "
            f"(at most {_LARGEST_SLOPE:.0%}); hold it squarely and farther away."
        )
    return found


def apply_matrix(matrix: Floats, patches: Floats) -> Floats:
    """Linear sRGB [..., 3] of linear camera RGB [..., 3]."""
    corrected: Floats = patches @ matrix.T
    return corrected


def _fit_edition(readings: Sequence[ChartReading], reference: Reference) -> ColourFit:
    patches = np.array([reading.patches for reading in readings])
    level = luminance(reference.srgb)
    bright = level > 0.05  # of black a little stray light changes the ratio most
    design = np.column_stack([np.ones(PATCHES), PLACES])
    shade = np.ones((len(readings), PATCHES))
    for number, one in enumerate(patches):
        shade[number] = one[NEUTRAL][0].mean() / reference.srgb[NEUTRAL][0].mean()
    matrix, slopes = np.eye(3), np.zeros((len(readings), 2))
    for _ in range(_ROUNDS):
        even = (patches / shade[..., None]).mean(axis=0)
        matrix = _solve(even, reference)
        for number, one in enumerate(patches):
            ratio = luminance(apply_matrix(matrix, one))[bright] / level[bright]
            if not (ratio > 0).all():
                raise ColourError(
                    f"{readings[number].name} shows patches without light; expose the chart more."
                )
            plane = np.linalg.lstsq(design[bright], np.log(ratio), rcond=None)[0]
            slopes[number] = plane[1:]
            shade[number] = np.exp(design @ plane)
    even = (patches / shade[..., None]).mean(axis=0)
    matrix = _solve(even, reference)
    white = np.linalg.solve(matrix, np.ones(3))
    sigma = _sigma(matrix, even, reference) * white[1]
    scaled = matrix * white[1]
    errors = Errors(
        delta_e(lab_of(apply_matrix(matrix, even)), reference.lab),
        _left_out(reference, lambda some: _matrix_of(some, even, reference)),
    )
    polynomial = Errors(
        delta_e(lab_of(_polynomial_of(np.arange(PATCHES), even, reference)), reference.lab),
        _left_out(reference, lambda some: _polynomial_of(some, even, reference)),
    )
    balanced = even / white
    return ColourFit(
        matrix=scaled,
        sigma=sigma,
        white=white / white[1],
        level=float(white[1]),
        patches=even,
        reference=reference,
        errors=errors,
        polynomial_errors=polynomial,
        uncorrected=delta_e(lab_of(balanced), reference.lab),
        slopes=np.linalg.norm(slopes, axis=1),
        names=tuple(reading.name for reading in readings),
        warnings=tuple(_warnings(scaled, errors)),
    )


def _warnings(matrix: Floats, errors: Errors) -> list[str]:
    said = []
    if errors.left_out.mean() > _DOUBTFUL_ERROR:
        said.append(
            f"Patches left out are {errors.left_out.mean():.1f} CIEDE2000 off: the light has gaps in its "
            "spectrum, or glare lies on the chart."
        )
    gain = float(np.linalg.norm(matrix, axis=1).max())
    if gain > _LARGEST_GAIN:
        said.append(f"The matrix makes noise {gain:.1f} times as large; is the light nearly of one colour?")
    return said


def _solve(patches: Floats, reference: Reference, chosen: NDArray[np.int64] | None = None) -> Floats:
    """The matrix that is nearest in CIELAB, for some of the patches."""
    some = np.arange(PATCHES) if chosen is None else chosen
    start = np.linalg.lstsq(patches[some], reference.srgb[some], rcond=None)[0].T
    wanted = reference.lab[some]

    def off(entries: Floats) -> Floats:
        return (lab_of(apply_matrix(entries.reshape(3, 3), patches[some])) - wanted).ravel()

    return np.asarray(least_squares(off, start.ravel(), x_scale="jac", max_nfev=40).x).reshape(3, 3)


def _sigma(matrix: Floats, patches: Floats, reference: Reference) -> Floats:
    """[3, 3] from what the fit leaves, noise and what no matrix can correct together."""
    step = 1e-6
    wanted = reference.lab
    base = (lab_of(apply_matrix(matrix, patches)) - wanted).ravel()
    columns = []
    for entry in range(9):
        changed = matrix.ravel().copy()
        changed[entry] += step
        columns.append(
            ((lab_of(apply_matrix(changed.reshape(3, 3), patches)) - wanted).ravel() - base) / step
        )
    slopes = np.array(columns).T
    variance = float(base @ base) / (len(base) - 9)
    return np.asarray(np.sqrt(np.diag(np.linalg.inv(slopes.T @ slopes)) * variance)).reshape(3, 3)


def _left_out(reference: Reference, correct: Correct) -> Floats:
    """[24] CIEDE2000 of each patch by what the others give; `correct` takes those and gives all, linear."""
    errors = np.zeros(PATCHES)
    for number in range(PATCHES):
        others = np.delete(np.arange(PATCHES), number)
        found = correct(others)[number]
        errors[number] = float(delta_e(lab_of(found), reference.lab[number]))
    return errors


def _matrix_of(some: NDArray[np.int64], patches: Floats, reference: Reference) -> Floats:
    """All patches [24, 3] by the matrix of some."""
    return apply_matrix(_solve(patches, reference, some), patches)


def _polynomial_of(some: NDArray[np.int64], patches: Floats, reference: Reference) -> Floats:
    """All patches [24, 3] by the root-polynomial of some."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from colour.characterisation import (
            apply_matrix_colour_correction_Finlayson2015,
            matrix_colour_correction_Finlayson2015,
        )

        terms = matrix_colour_correction_Finlayson2015(patches[some], reference.srgb[some], 2, True)
        return np.asarray(apply_matrix_colour_correction_Finlayson2015(patches, terms, 2, True), np.float64)
