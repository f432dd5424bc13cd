"""The live display in the terminal: a panel that is redrawn in place, or a line every two seconds elsewhere.

Nothing in it flashes: a flash is one more coloured cell at the end of a strip that moves on, and no area
changes its colour with it.
"""

from __future__ import annotations

import math
import os
import sys
from contextlib import suppress
from types import TracebackType
from typing import TYPE_CHECKING, Self, TextIO

from capture.devices.bench import Clock, MonotonicClock
from capture.live.state import BINS, Coverage, LiveState

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.live import Live
    from rich.text import Text

_CANNOT_REDRAW = ("dumb", "unknown")
_REDRAW_S = 0.125
_LINE_S = 2.0
_BAR = 24
_STRIP = {"lit": ("█", "bright_yellow"), "partial": ("▄", "yellow"), "unlit": ("▁", "grey50")}
_UNKNOWN = ("·", "grey35")
_DOTS = {0: ("·", "grey42"), 1: ("●", "cyan"), 2: ("◉", "bright_yellow")}
_CLIPPED_WARN, _CLIPPED_BAD = 0.01, 0.04
_GAUGE_ROWS, _GAUGE_COLUMNS = 7, 29


class TerminalPanel:
    """Shows states on stderr; a context manager that leaves the last one standing."""

    def __init__(
        self, stream: TextIO | None = None, clock: Clock | None = None, title: str = "recording"
    ) -> None:
        """Begins nothing yet.

        Args:
            stream: where to; stderr when None.
            clock: paces the redrawing.
            title: above the panel.
        """
        self._stream = sys.stderr if stream is None else stream
        self._clock = clock or MonotonicClock()
        self._title = title
        self._live: Live | None = None
        self._shown_s = -math.inf
        self._last: LiveState | None = None
        self._gone = False

    def __enter__(self) -> Self:
        if self._stream.isatty() and os.environ.get("TERM") not in _CANNOT_REDRAW:
            from rich.console import Console
            from rich.live import Live

            self._live = Live(console=Console(file=self._stream), auto_refresh=False, transient=False)
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._last is not None:
            self._draw(self._last)
        if self._live is not None:
            with suppress(OSError):
                self._live.stop()
            self._live = None

    def show(self, state: LiveState) -> None:
        """Shows a state, unless the last one is too recent; called as often as one likes."""
        now_s = self._clock.now_s()
        self._last = state
        if now_s - self._shown_s >= (_LINE_S if self._live is None else _REDRAW_S):
            self._shown_s = now_s
            self._draw(state)

    def _draw(self, state: LiveState) -> None:
        if self._gone:
            return
        try:
            if self._live is not None:
                self._live.update(panel(state, self._title), refresh=True)
            else:
                print(line(state), file=self._stream, flush=True)
        except OSError:  # whoever looked has closed the window; the capture goes on
            self._gone = True
        self._last = None


def line(state: LiveState) -> str:
    """A state in one line of plain text."""
    parts = [
        f"{state.elapsed_s:5.1f} s, {state.left_s:.0f} s left",
        f"{state.frames} frames",
        f"{state.drops} lost",
        f"pulses {_pulses(state)}",
        f"level {100 * state.level:.0f} %",
        f"clipped {100 * state.clipped_subject:.1f} %",
        f"around {span(state.coverage)}",
        f"head {_motion_word(state.motion)}",
    ]
    return ", ".join(parts) + (f": {state.advice}" if state.advice else "")


def span(coverage: Coverage) -> str:
    """How far around, in words."""
    if coverage.span_deg is None:
        return "cannot tell"
    return f"{'at least ' if coverage.at_least else ''}{coverage.span_deg:.0f}°"


def panel(state: LiveState, title: str = "recording") -> RenderableType:
    """A state as a panel of 78 columns."""
    from rich import box
    from rich.columns import Columns
    from rich.console import Group
    from rich.panel import Panel
    from rich.table import Table
    from rich.text import Text

    meters = Table.grid(padding=(0, 1))
    meters.add_column(justify="right", style="grey62", width=9)
    meters.add_column(no_wrap=True)
    for name, value in _rows(state):
        meters.add_row(name, value)
    body = Columns([meters, _gauge(state.coverage)], padding=(0, 2))
    advice = Text(f"▸ {state.advice}" if state.advice else " ", style="bold bright_white")
    head = Text.assemble(
        (title, "bold"), f"  {state.elapsed_s:.1f} s", (f"  {state.left_s:.0f} s left", "cyan")
    )
    return Panel(
        Group(body, _strip(state), advice),
        title=head,
        title_align="left",
        border_style="grey42",
        box=box.ROUNDED,
        width=78,
        padding=(0, 1),
    )


def _rows(state: LiveState) -> list[tuple[str, Text]]:
    from rich.text import Text

    clipped = state.clipped_subject
    colour = "green" if clipped < _CLIPPED_WARN else "yellow" if clipped < _CLIPPED_BAD else "red"
    lit = state.level_lit
    motion = state.motion
    moving = (
        Text("cannot tell", "grey62")
        if motion is None
        else _bar(motion, "yellow" if motion > 0.6 else "green")
    )
    done = state.elapsed_s / max(state.elapsed_s + state.left_s, 1e-6)
    lost = "red" if state.drops else "grey62"
    return [
        ("time", _bar(done, "cyan")),
        ("room", _bar(state.level, "grey74", f"{100 * state.level:.0f} %")),
        (
            "flash",
            Text("not seen yet", "grey62")
            if lit is None
            else _bar(lit, "bright_yellow", f"{100 * lit:.0f} %"),
        ),
        ("clipped", _bar(min(1.0, clipped / 0.1), colour, f"{100 * clipped:.1f} %")),
        ("dark", _bar(min(1.0, state.dark), "blue", f"{100 * state.dark:.0f} %")),
        ("sharp", _bar(state.sharpness, "green" if state.sharpness > 0.55 else "yellow")),
        ("head", moving.append("" if motion is None else f" {_motion_word(motion)}")),
        ("pulses", Text(_pulses(state))),
        (
            "frames",
            Text.assemble(f"{state.frames}  ", (f"{state.drops} lost", lost), f"  {state.queue} waiting"),
        ),
    ]


def _bar(share: float, colour: str, words: str = "") -> Text:
    from rich.text import Text

    full = round(_BAR * min(max(share, 0.0), 1.0))
    return Text.assemble(("━" * full, colour), ("─" * (_BAR - full), "grey27"), f" {words}" if words else "")


def _strip(state: LiveState) -> Text:
    from rich.text import Text

    text = Text("    flash  ", style="grey62", no_wrap=True)
    cells = state.labels[-62:]
    text.append(" " * (62 - len(cells)))
    for label in cells:
        text.append(*_STRIP.get(label, _UNKNOWN))
    return text


def _gauge(coverage: Coverage) -> Text:
    """The half circle around the head, seen from above; whoever stands before the sitter is below."""
    from rich.text import Text

    grid: list[list[tuple[str, str]]] = [[(" ", "")] * _GAUGE_COLUMNS for _ in range(_GAUGE_ROWS + 2)]
    middle = _GAUGE_COLUMNS // 2
    for place in range(BINS):
        row, column = _spot((place + 0.5) / BINS, 1.0)
        grid[row][column] = _DOTS[coverage.bins[place]] if coverage.span_deg is not None else _DOTS[0]
    if coverage.place is not None:
        row, column = _spot(coverage.place / BINS, 0.78)
        grid[row][column] = ("◆", "bright_white")
    for column, sign in zip(range(middle - 1, middle + 2), "(ʘ)", strict=True):
        grid[0][column] = (sign, "grey78")
    grid[1][middle] = ("˅", "grey78")
    text = Text(no_wrap=True)
    for cells in grid[:-1]:
        for sign, style in cells:
            text.append(sign, style)
        text.append("\n")
    words = "the walk cannot be told" if coverage.span_deg is None else f"around {span(coverage)}"
    text.append(words.center(_GAUGE_COLUMNS), "cyan" if coverage.span_deg is not None else "grey62")
    height = coverage.elevation_span_deg
    words = " " if height is None else f"up and down {height:.0f}°"
    text.append("\n" + words.center(_GAUGE_COLUMNS), "grey62")
    return text


def _spot(part: float, radius: float) -> tuple[int, int]:
    """Row and column of a part 0..1 of the half circle, from left to right."""
    angle = math.pi * (1 - part)
    aside = radius * (_GAUGE_COLUMNS // 2) * math.cos(angle)
    # Rounded away from the middle, so that left and right are alike.
    column = _GAUGE_COLUMNS // 2 + int(math.copysign(math.floor(abs(aside) + 0.5), aside))
    return round(radius * (_GAUGE_ROWS - 1) * math.sin(angle)), column


def _pulses(state: LiveState) -> str:
    expected = "" if state.pulses_expected is None else f" of {state.pulses_expected}"
    return f"{state.pulses_seen}{expected}"


def _motion_word(motion: float | None) -> str:
    if motion is None:
        return "cannot tell"
    return "still" if motion < 0.25 else "moving a little" if motion < 0.6 else "moving"
