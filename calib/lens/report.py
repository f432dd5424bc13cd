"""A page to judge a lens calibration by: what was found, how sure it is, and what speaks against it.

One HTML file without scripts and without anything from elsewhere: it can be sent.
"""

from __future__ import annotations

from html import escape
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.lens.intrinsics import IntrinsicsResult
from calib.lens.projection import project, rays_of
from calib.lens.terms import LENS_MODELS, LENS_NAMES
from calib.lens.uncertainty import pixel_grid, projection_sigma
from calib.plots import arrows, bars, curve_path, dots, heat_map, histogram, svg
from calib.report.page import figure, page, section, table, warnings
from capture.atomic import atomic_write

Floats = NDArray[np.float64]


def write_intrinsics_report(
    result: IntrinsicsResult, path: Path, distance_m: float, found: str, title: str
) -> None:
    """Writes the page.

    Args:
        result: what to show.
        path: the .html file.
        distance_m: at which the projection uncertainty is shown.
        found: a sentence on the pictures that were searched.
        title: what was calibrated.
    """
    sections = [
        _head(result, distance_m, found, title),
        warnings(result.warnings),
        section("The lens", _lenstable(result), ""),
        section("How far a projected pixel may be off", _uncertainty(result, distance_m), ""),
        section(
            "Two halves of the pictures",
            _halves(result),
            "Each half calibrated on its own; the pixels to which both project the same rays should differ "
            "by no "
            "more than the halves' uncertainties say. If they differ by more, the lens moved or the model "
            "does "
            "not follow it.",
        ),
        section("What the residuals say", _residuals(result), ""),
        section(
            "Why this model",
            _models(result),
            "Error on pictures that the lens was not fitted to; the smallest one decides.",
        ),
        section("The pictures", _pictures(result), ""),
    ]
    atomic_write(path, page(title, sections).encode())


def _head(result: IntrinsicsResult, distance_m: float, found: str, title: str) -> str:
    sigma, _ = _map(result, distance_m)
    layout = "" if result.board.layout == "current" else " (legacy layout)"
    return (
        f"<h1>{escape(title)}</h1><p class=quiet>{escape(result.board.describe())}{layout and ' '}<br>"
        f"{escape(found)}.</p><p>{len(result.views)} views, {int(result.observations.seen.sum()):,} corners "
        "with a "
        f"noise of <b>{result.uncertainty.noise_px:.3f} px</b>. A projected pixel is off by "
        f"<b>{np.nanmedian(sigma):.3f} px</b> (median over the picture, one standard deviation in the worst "
        f"direction, at {distance_m:.2f} m), at worst {np.nanmax(sigma):.3f} px.</p>"
    )


def _lenstable(result: IntrinsicsResult) -> str:
    width, height = result.size
    free = {*LENS_NAMES[:4], *LENS_MODELS[result.model]}
    rows = [
        (
            name,
            f"{value:.3f} px" if number < 4 else f"{value:.5f}",
            f"± {sigma:.3f} px" if number < 4 else f"± {sigma:.5f}",
        )
        for number, (name, value, sigma) in enumerate(zip(LENS_NAMES, result.lens, result.sigma, strict=True))
        if name in free
    ]
    if result.bend_m is not None:
        sigma = np.sqrt(np.diag(result.uncertainty.covariance))[-2:]
        rows += [
            (f"board's bend along its {side}", f"{bend * 1e3:.2f} mm", f"± {spread * 1e3:.2f} mm")
            for side, bend, spread in zip(("width", "height"), result.bend_m, sigma, strict=True)
        ]
    view = np.degrees(2 * np.arctan(np.array([width, height]) / (2 * result.lens[:2])))
    return (
        table(("", "value", "one standard deviation"), rows)
        + f"<p class=quiet>Pictures of {width} × {height} pixels; pixel centres at 0.5. Field of view "
        f"(without distortion) {view[0]:.1f}° × {view[1]:.1f}°.</p>"
        + f'<div class="grid">{figure(_distortion(result), _distortion_words(result))}</div>'
    )


def _uncertainty(result: IntrinsicsResult, distance_m: float) -> str:
    sigma, columns = _map(result, distance_m)
    hull = _hull(result)
    near = result.distances_m
    return (
        '<div class="grid">'
        + "".join(
            [
                figure(
                    heat_map(sigma, columns, result.size, hull, "projection uncertainty", "px"),
                    f"One standard deviation in the worst direction, px, of a point {distance_m:.2f} m away; "
                    "dashed: "
                    "what the corners span. The boards were "
                    f"{near.min():.2f} to {near.max():.2f} m away.",
                ),
                figure(
                    dots(
                        result.observations.pixels[result.observations.seen],
                        result.size,
                        "corners used",
                        hull,
                    ),
                    f"The corners used; they span {result.covered_share:.0%} of the picture.",
                ),
            ]
        )
        + "</div>"
    )


def _halves(result: IntrinsicsResult) -> str:
    if not result.halves:
        return "<p>There are too few pictures for halves that tell anything.</p>"
    _, (columns, _) = pixel_grid(result.size)
    figures = [
        figure(
            heat_map(check.difference_px, columns, result.size, None, "difference of the halves", "px"),
            f"{check.split.capitalize()}: {check.rms_px:.3f} px apart where {check.expected_px:.3f} px are "
            "expected "
            f"(chance of so much: {check.chance:.0%}) — {'agrees' if check.agrees else 'does not agree'}.",
        )
        for check in result.halves
    ]
    return f'<div class="grid">{"".join(figures)}</div>'


def _residuals(result: IntrinsicsResult) -> str:
    seen = result.observations.seen
    residuals = result.solution.residuals[seen]
    drawn, larger = arrows(
        result.observations.pixels[seen], residuals, result.size, "residuals in the picture"
    )
    each = [
        float(np.sqrt((r[s] ** 2).mean())) if s.any() else 0.0
        for r, s in zip(result.solution.residuals, seen, strict=True)
    ]
    whitened = result.solution.residuals / np.maximum(result.uncertainty.view_noise_px, 1e-12)[:, None, None]
    return (
        '<div class="grid">'
        + "".join(
            [
                figure(
                    drawn,
                    f"Found minus projected, {larger:g} times as long. Neighbours that point the same way "
                    "are an error "
                    "of the model; a mess is noise.",
                ),
                figure(
                    histogram(whitened[seen].ravel(), 1.0, "residuals over the noise of their picture"),
                    "Residuals over the noise of their picture, and the normal distribution.",
                ),
                figure(
                    bars(each, result.views, "residual by picture"),
                    f"Root mean square by picture, px, in the order in which they came ({result.rms_px:.3f} "
                    "over all).",
                ),
            ]
        )
        + "</div>"
    )


def _models(result: IntrinsicsResult) -> str:
    if not result.trials:
        return f"<p>The model {escape(result.model)} was asked for.</p>"
    rows = [
        (
            trial.model + (" on a bent board" if trial.bent else ""),
            f"{trial.held_out_px:.4f} px",
            "chosen" if (trial.model, trial.bent) == (result.model, result.bend_m is not None) else "",
        )
        for trial in result.trials
    ]
    return table(("distortion", "held-out error", ""), rows)


def _pictures(result: IntrinsicsResult) -> str:
    tilts = np.degrees(np.arccos(np.clip(result.solution.rotations[:, 2, 2], -1, 1)))
    rows = [
        (name, str(int(seen.sum())), f"{distance:.2f} m", f"{tilt:.0f}°", f"{noise:.3f} px")
        for name, seen, distance, tilt, noise in zip(
            result.views,
            result.observations.seen,
            result.distances_m,
            tilts,
            result.uncertainty.view_noise_px,
            strict=True,
        )
    ]
    corners, views = result.left_out
    note = f"<p class=quiet>Left out as outliers: {corners} corners, and {views} whole pictures.</p>"
    return note + table(("picture", "corners", "distance", "tilt", "noise"), rows)


def _map(result: IntrinsicsResult, distance_m: float) -> tuple[Floats, int]:
    grid, (columns, _) = pixel_grid(result.size)
    sigma, _ = projection_sigma(result.lens, result.uncertainty, grid, distance_m)
    return sigma, columns


def _hull(result: IntrinsicsResult) -> Floats:
    corners = result.observations.pixels[result.observations.seen].astype(np.float32)
    return np.asarray(cv2.convexHull(corners), dtype=np.float64).reshape(-1, 2)


def _distortion(result: IntrinsicsResult) -> str:
    """A square grid of directions as the lens draws it."""
    width, height = result.size
    lines = []
    straight = result.lens.copy()
    straight[4:] = 0.0
    for along, across in ((0, 1), (1, 0)):
        for at in np.linspace(0.0, result.size[across], 9 if across else 13):
            pixels = np.zeros((41, 2))
            pixels[:, along] = np.linspace(0.0, result.size[along], 41)
            pixels[:, across] = at
            bent = project(result.lens, rays_of(straight, pixels))
            lines.append(
                curve_path(pixels[:, 0], pixels[:, 1], f"stroke:var(--line);stroke-width:{width / 900:.2f}")
            )
            lines.append(
                curve_path(bent[:, 0], bent[:, 1], f"stroke:var(--accent);stroke-width:{width / 500:.2f}")
            )
    return svg(width, height, lines, "distortion")


def _distortion_words(result: IntrinsicsResult) -> str:
    straight = result.lens.copy()
    straight[4:] = 0.0
    grid, _ = pixel_grid(result.size)
    moved = np.linalg.norm(project(result.lens, rays_of(straight, grid)) - grid, axis=1)
    return f"A square grid (grey) as the lens draws it (coloured): moved by up to {moved.max():.1f} px."
