"""Small drawings as SVG, for pages without scripts: a picture's frame, heat maps, points, bars, curves.

Colours come from the page's style sheet (`--ink`, `--line`, `--accent`, `--quiet`), so that a drawing is
readable on light and dark pages; only heat maps bring their own.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# Viridis (Smith & van der Walt 2015), five of its colours.
_HEAT = np.array(
    [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]], dtype=np.float64
)


def svg(width: float, height: float, parts: Iterable[str], label: str) -> str:
    """A drawing that scales to the width it gets."""
    return (
        f'<svg viewBox="0 0 {width:g} {height:g}" role="img" aria-label="{escape(label)}">'
        f"{''.join(parts)}</svg>"
    )


def heat_colour(share: float) -> str:
    """The colour of 0..1, dark to bright."""
    at = float(np.clip(share, 0.0, 1.0)) * (len(_HEAT) - 1)
    low = min(int(at), len(_HEAT) - 2)
    red, green, blue = np.rint(_HEAT[low] + (at - low) * (_HEAT[low + 1] - _HEAT[low])).astype(int)
    return f"#{red:02x}{green:02x}{blue:02x}"


def heat_map(
    values: Floats, columns: int, size: tuple[int, int], outline: Floats | None, label: str, unit: str
) -> str:
    """A picture's frame coloured by values on a grid, with numbers on some of its places.

    Args:
        values: [rows * columns]; NaN = nothing known, left blank.
        columns: of the grid.
        size: (width, height) of the picture.
        outline: [n, 2] polygon in pixels to draw over it.
        label: what it shows.
        unit: of the values.
    """
    width, height = size
    rows = len(values) // columns
    cell_width, cell_height = width / columns, height / rows
    known = values[np.isfinite(values)]
    low, high = (float(known.min()), float(np.percentile(known, 98))) if len(known) else (0.0, 1.0)
    span = max(high - low, 1e-12)
    parts = []
    for number, value in enumerate(values):
        if np.isfinite(value):
            row, column = divmod(number, columns)
            parts.append(
                f'<rect x="{column * cell_width:.1f}" y="{row * cell_height:.1f}" '
                f'width="{cell_width + 0.5:.1f}" height="{cell_height + 0.5:.1f}" '
                f'fill="{heat_colour((float(value) - low) / span)}"/>'
            )
    parts.append(frame(size))
    if outline is not None:
        parts.append(polygon(outline, size))
    text = width / 36
    for row in np.linspace(0.5, rows - 0.5, 5).astype(int):
        for column in np.linspace(0.5, columns - 0.5, 5).astype(int):
            value = values[row * columns + column]
            if np.isfinite(value):
                ink = "#000" if (value - low) / span > 0.55 else "#fff"
                x = float(np.clip((column + 0.5) * cell_width, 1.6 * text, width - 1.6 * text))
                y = float(np.clip((row + 0.5) * cell_height, text, height - 0.4 * text))
                parts.append(
                    f'<text x="{x:.1f}" y="{y:.1f}" font-size="{text:.1f}" fill="{ink}" '
                    f'text-anchor="middle">{value:.2g}</text>'
                )
    return svg(width, height, parts, f"{label}, {unit}")


def frame(size: tuple[int, int]) -> str:
    """The outline of a picture."""
    return (
        f'<rect width="{size[0]}" height="{size[1]}" fill="none" stroke="var(--line)" '
        f'stroke-width="{max(size) / 300:.2f}"/>'
    )


def polygon(corners: Floats, size: tuple[int, int]) -> str:
    """A dashed outline."""
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in corners)
    width = max(size) / 300
    return (
        f'<polygon points="{points}" fill="none" stroke="#fff" stroke-width="{width:.2f}" '
        f'stroke-dasharray="{3 * width:.1f}" style="mix-blend-mode:difference"/>'
    )


def dots(points: Floats, size: tuple[int, int], label: str, outline: Floats) -> str:
    """Points in a picture's frame."""
    radius = max(size) / 400
    marks = (
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:.2f}" fill="var(--accent)" fill-opacity="0.6"/>'
        for x, y in points
    )
    return svg(size[0], size[1], [*marks, frame(size), polygon(outline, size)], label)


def arrows(points: Floats, vectors: Floats, size: tuple[int, int], label: str) -> tuple[str, float]:
    """Vectors in a picture's frame, and by how much they are drawn larger."""
    typical = float(np.median(np.linalg.norm(vectors, axis=1)))
    larger = 0.02 * max(size) / max(typical, 1e-9)
    decade = float(10 ** np.floor(np.log10(larger)))
    larger = 5 * decade if larger >= 5 * decade else decade
    width = max(size) / 700
    marks = (
        f'<path d="M{x:.1f} {y:.1f}l{larger * dx:.1f} {larger * dy:.1f}"/>'
        for (x, y), (dx, dy) in zip(points, vectors, strict=True)
    )
    group = f'<g stroke="var(--accent)" stroke-width="{width:.2f}" fill="none">{"".join(marks)}</g>'
    return svg(size[0], size[1], [group, frame(size)], label), larger


def bars(values: Sequence[float], names: Sequence[str], label: str) -> str:
    """One bar a value; the name shows when it is pointed at."""
    width, height = 640.0, 150.0
    top = 1.15 * max([*values, 1e-12])  # room for the note
    step = width / max(len(values), 1)
    marks = (
        f'<rect x="{(i + 0.1) * step:.1f}" y="{height * (1 - value / top):.1f}" '
        f'width="{0.8 * step:.1f}" height="{height * value / top:.1f}" fill="var(--accent)">'
        f"<title>{escape(name)}: {value:.3g}</title></rect>"
        for i, (value, name) in enumerate(zip(values, names, strict=True))
    )
    axis = f'<path d="M0 {height}H{width}" stroke="var(--line)"/>'
    note = f'<text x="4" y="14" font-size="13" fill="var(--quiet)">highest {top / 1.15:.3g}</text>'
    return svg(width, height + 2, [*marks, axis, note], label)


def histogram(values: Floats, sigma: float, label: str) -> str:
    """How often values occur, with the normal distribution of a standard deviation."""
    width, height, reach = 640.0, 220.0, 4.5
    edges = np.linspace(-reach, reach, 61)
    counts, _ = np.histogram(values / max(sigma, 1e-12), edges)
    density = counts / max(len(values), 1) / np.diff(edges)
    at = np.linspace(-reach, reach, 121)
    normal = np.exp(-(at**2) / 2) / np.sqrt(2 * np.pi)
    top = 1.1 * max(float(density.max()), float(normal.max()))
    step = width / len(counts)
    marks = [
        f'<rect x="{i * step:.1f}" y="{height * (1 - value / top):.1f}" width="{step - 0.6:.1f}" '
        f'height="{height * value / top:.1f}" fill="var(--accent)" fill-opacity="0.55"/>'
        for i, value in enumerate(density)
    ]
    line = curve_path(
        (at + reach) / (2 * reach) * width, height * (1 - normal / top), "stroke:var(--ink);stroke-width:1.5"
    )
    ticks = [
        f'<text x="{(s + reach) / (2 * reach) * width:.0f}" y="{height + 16:.0f}" font-size="12" '
        f'fill="var(--quiet)" text-anchor="middle">{s * sigma:.2g}</text>'
        for s in (-4, -2, 0, 2, 4)
    ]
    return svg(width, height + 22, [*marks, line, *ticks], label)


def graph(
    curves: Sequence[tuple[Floats, Floats, str]],
    label: str,
    axes: tuple[str, str],
    band: tuple[Floats, Floats, Floats] | None = None,
    points: tuple[Floats, Floats] | None = None,
) -> str:
    """Curves over numbered axes.

    Args:
        curves: x [n], y [n] and the colour of each, such as "var(--ink)".
        label: what it shows.
        axes: names of x and y.
        band: x [n], lower [n] and upper [n] end of a shaded region.
        points: x [m] and y [m] of dots.
    """
    width, height, left, bottom = 640.0, 260.0, 64.0, 40.0
    marks = (np.zeros(0), np.zeros(0)) if points is None else points
    ends = [] if band is None else [band[1], band[2]]
    x_all = np.concatenate([marks[0], *(x for x, _, _ in curves)])
    y_all = np.concatenate([marks[1], *(y for _, y, _ in curves), *ends])
    low, high = np.array([x_all.min(), y_all.min()]), np.array([x_all.max(), y_all.max()])
    span = np.maximum(high - low, 1e-12)

    def at(x: Floats, y: Floats) -> tuple[Floats, Floats]:
        across = left + (x - low[0]) / span[0] * (width - left - 8)
        return across, (height - bottom) - (y - low[1]) / span[1] * (height - bottom - 12)

    parts = []
    if band is not None:
        x, lower = at(band[0], band[1])
        _, upper = at(band[0], band[2])
        rim = [f"{a:.1f},{b:.1f}" for a, b in zip(x, lower, strict=True)]
        rim += [f"{a:.1f},{b:.1f}" for a, b in zip(x[::-1], upper[::-1], strict=True)]
        parts.append(f'<polygon points="{" ".join(rim)}" fill="var(--accent)" fill-opacity="0.25"/>')
    parts += [
        f'<circle cx="{a:.1f}" cy="{b:.1f}" r="2" fill="var(--accent)" fill-opacity="0.6"/>'
        for a, b in zip(*at(*marks), strict=True)
    ]
    parts += [curve_path(*at(x, y), f"stroke:{colour};stroke-width:1.6") for x, y, colour in curves]
    small = 'font-size="12" fill="var(--quiet)"'
    for share in (0.0, 0.5, 1.0):
        value = low + share * span
        x, y = at(value[:1], value[1:])
        parts.append(
            f'<text x="{x[0]:.0f}" y="{height - bottom + 16:.0f}" {small} text-anchor="middle">'
            f'{value[0]:.3g}</text><text x="{left - 6:.0f}" y="{y[0] + 4:.0f}" {small} text-anchor="end">'
            f"{value[1]:.3g}</text>"
        )
    corner = f"M{left} 8V{height - bottom}H{width - 8}"
    parts += [
        f'<path d="{corner}" fill="none" stroke="var(--line)"/>',
        f'<text x="{width / 2:.0f}" y="{height - 4:.0f}" {small} text-anchor="middle">'
        f"{escape(axes[0])}</text>",
        f'<text x="4" y="12" {small}>{escape(axes[1])}</text>',
    ]
    return svg(width, height, parts, label)


def curve_path(x: Floats, y: Floats, style: str) -> str:
    """A line through points."""
    points = "L".join(f"{a:.1f} {b:.1f}" for a, b in zip(x, y, strict=True))
    return f'<path d="M{points}" fill="none" style="{style}"/>'
