import io
from dataclasses import replace

import pytest
from rich.console import Console

from capture.devices.bench import VirtualClock
from capture.live.state import Coverage, LiveState
from capture.live.terminal_panel import TerminalPanel, line, panel

STATE = LiveState(
    elapsed_s=11.4,
    left_s=8.6,
    frames=342,
    drops=2,
    level=0.41,
    level_lit=0.63,
    clipped_subject=0.021,
    labels=("unlit",) * 26 + ("partial", "lit", "lit", "partial"),
    pulses_seen=11,
    pulses_expected=12,
    coverage=Coverage(
        azimuth_deg=96.0, elevation_deg=3.0, span_deg=96.0, elevation_span_deg=8.0, bins=(2, 1) * 9, place=9.6
    ),
    motion=0.2,
    advice="move on around the head",
)


class Terminal(io.StringIO):
    def isatty(self):
        return True


class ClosedTerminal(Terminal):
    """A window that is closed while it is drawn into; a pipe whose reader has ended."""

    closed_now = False
    refused = 0

    def write(self, text):
        if self.closed_now:
            self.refused += 1
            raise OSError(5, "Input/output error")
        return super().write(text)


def rendered(state):
    console = Console(file=io.StringIO(), width=80, record=True)
    console.print(panel(state))
    return console.export_text()


def test_a_line_says_it_all():
    text = line(STATE)
    for part in (
        "11.4 s",
        "9 s left",
        "342 frames",
        "2 lost",
        "11 of 12",
        "clipped 2.1 %",
        "around 96°",
        "still",
    ):
        assert part in text
    assert text.endswith("move on around the head")


def test_what_cannot_be_told_is_said_so():
    state = replace(STATE, coverage=Coverage(at_least=True), motion=None)
    assert "around cannot tell" in line(state)
    assert "cannot be told" in rendered(state)
    assert "◆" not in rendered(state)
    assert "at least 96°" in line(replace(STATE, coverage=replace(STATE.coverage, at_least=True)))


@pytest.mark.parametrize(
    "state",
    [
        LiveState(),
        STATE,
        replace(STATE, labels=("unknown", "lit") * 200, advice="x" * 60),
        replace(STATE, drops=99999, frames=10**7, queue=400, level_lit=1.0, motion=1.0, dark=1.0),
        replace(STATE, coverage=replace(STATE.coverage, place=0.0)),
        replace(STATE, coverage=replace(STATE.coverage, place=18.0)),
    ],
)
def test_the_panel_keeps_its_size(state):
    lines = [text for text in rendered(state).split("\n") if text]
    # One size whatever happens: a panel that grows and shrinks would make the terminal jump.
    assert {len(text) for text in lines} <= {78, 80}
    assert len(lines) == len([text for text in rendered(STATE).split("\n") if text])


def test_off_a_terminal_a_line_comes_every_two_seconds():
    stream, clock = io.StringIO(), VirtualClock()
    with TerminalPanel(stream, clock) as shown:
        for _ in range(50):
            shown.show(STATE)
            clock.sleep(0.1)
    lines = stream.getvalue().splitlines()
    assert len(lines) == 4  # at 0, 2 and 4 s, and the last state of all
    assert "\x1b" not in stream.getvalue()


def test_on_a_terminal_it_is_drawn_at_most_eight_times_a_second():
    stream, clock = Terminal(), VirtualClock()
    with TerminalPanel(stream, clock) as shown:
        before = stream.getvalue().count("frames")
        for _ in range(100):
            shown.show(STATE)
            clock.sleep(0.01)
        drawn = stream.getvalue().count("frames") - before
    assert 6 <= drawn <= 8


def test_nothing_is_drawn_when_there_was_nothing_to_show():
    stream = io.StringIO()
    with TerminalPanel(stream, VirtualClock()):
        pass
    assert stream.getvalue() == ""


def test_a_terminal_that_cannot_redraw_gets_lines(monkeypatch):
    monkeypatch.setenv("TERM", "dumb")
    stream = Terminal()
    with TerminalPanel(stream, VirtualClock()) as shown:
        shown.show(STATE)
    assert stream.getvalue() == line(STATE) + "\n"


@pytest.mark.parametrize("on_terminal", [True, False])
def test_a_closed_terminal_does_not_end_the_capture(on_terminal, monkeypatch):
    clock, stream = VirtualClock(), ClosedTerminal()
    monkeypatch.setattr(stream, "isatty", lambda: on_terminal)
    with TerminalPanel(stream, clock) as shown:
        shown.show(STATE)
        stream.closed_now = True
        for _ in range(3):
            clock.sleep(5.0)
            shown.show(STATE)
    assert stream.refused >= 1
