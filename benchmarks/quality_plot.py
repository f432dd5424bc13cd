"""Curves of error over time as a picture: a panel a measure, a line a preset, logarithmic time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

Curve = Sequence[tuple[float, float]]
"""[(seconds, value)], ascending."""

_WIDTH, _HEIGHT = 400, 260  # of a panel, pixels
_LEFT, _RIGHT, _TOP, _BOTTOM = 52, 14, 34, 34
_COLOURS = ((90, 90, 90), (30, 90, 200), (200, 60, 30), (20, 140, 70), (150, 60, 170))
_INK, _GRID = (40, 40, 40), (225, 225, 225)
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_TICKS_S = (10, 30, 60, 120, 300, 600, 1500, 3600)


@dataclass(frozen=True)
class Panel:
    """One measure.

    Attributes:
        title: With its unit.
        curves: By the name of what was measured.
    """

    title: str
    curves: Mapping[str, Curve]


def draw(panels: Sequence[Panel], path: Path, columns: int = 3) -> None:
    """Writes the panels as a PNG, the names of the curves below."""
    times = [time_s for panel in panels for curve in panel.curves.values() for time_s, _ in curve]
    if not times:
        return
    span_s = (min(5.0, *times), 1.15 * max(times))
    names = list(dict.fromkeys(name for panel in panels for name in panel.curves))
    drawn = [_panel(panel, span_s, names) for panel in panels]
    drawn += [np.full_like(drawn[0], 255)] * (-len(drawn) % columns)
    rows = [np.hstack(drawn[first : first + columns]) for first in range(0, len(drawn), columns)]
    path.parent.mkdir(parents=True, exist_ok=True)
    picture = np.vstack([*rows, _legend(names, columns * _WIDTH)])
    cv2.imwrite(str(path), picture[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])


def _panel(panel: Panel, span_s: tuple[float, float], names: Sequence[str]) -> NDArray[np.uint8]:
    picture = np.full((_HEIGHT, _WIDTH, 3), 255, np.uint8)
    values = [value for curve in panel.curves.values() for _, value in curve]
    low, high = (min(values), max(values)) if values else (0.0, 1.0)
    room = 0.08 * max(high - low, 1e-3)
    low, high = low - room, high + room

    def place(time_s: float, value: float) -> tuple[int, int]:
        across = math.log(time_s / span_s[0]) / math.log(span_s[1] / span_s[0])
        up = (value - low) / (high - low)
        x = _LEFT + across * (_WIDTH - _LEFT - _RIGHT)
        return round(x), round(_HEIGHT - _BOTTOM - up * (_HEIGHT - _BOTTOM - _TOP))

    for time_s in (tick for tick in _TICKS_S if span_s[0] <= tick <= span_s[1]):
        (x, bottom), (_, top) = place(time_s, low), place(time_s, high)
        cv2.line(picture, (x, bottom), (x, top), _GRID, 1)
        label = f"{time_s} s" if time_s < 60 else f"{time_s // 60} min"
        _write(picture, label, (x - 4 * len(label), bottom + 18))
    step = _step(high - low)
    for number in range(math.ceil(low / step), math.floor(high / step) + 1):
        (left, y), (right, _) = place(span_s[0], number * step), place(span_s[1], number * step)
        cv2.line(picture, (left, y), (right, y), _GRID, 1)
        _write(picture, f"{number * step:.4g}", (4, y + 4))
    for name, curve in panel.curves.items():
        colour = _COLOURS[names.index(name) % len(_COLOURS)]
        corners = np.array([place(*point) for point in curve], np.int32).reshape(-1, 1, 2)
        cv2.polylines(picture, [corners], False, colour, 2, cv2.LINE_AA)
        for point in curve:
            cv2.circle(picture, place(*point), 4, colour, -1, cv2.LINE_AA)
    _write(picture, panel.title, (_LEFT, 20), 0.45)
    return picture


def _legend(names: Sequence[str], width: int) -> NDArray[np.uint8]:
    picture = np.full((30, width, 3), 255, np.uint8)
    for number, name in enumerate(names):
        x = _LEFT + 160 * number
        cv2.circle(picture, (x, 12), 4, _COLOURS[number % len(_COLOURS)], -1, cv2.LINE_AA)
        _write(picture, name, (x + 10, 16))
    return picture


def _write(picture: NDArray[np.uint8], text: str, at: tuple[int, int], size: float = 0.4) -> None:
    cv2.putText(picture, text, at, _FONT, size, _INK, 1, cv2.LINE_AA)


def _step(span: float) -> float:
    """A round distance of some five lines over a span."""
    decade = 10.0 ** math.floor(math.log10(span / 5.0))
    return next(step * decade for step in (1, 2, 5, 10) if step * decade >= span / 5.0)
