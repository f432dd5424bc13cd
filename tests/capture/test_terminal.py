"""Exit codes and sentences for what can go wrong, and progress with and without a terminal."""

import io

import pytest

from capture.errors import SessionError
from capture.terminal import StageProgress, run_guarded


def guarded(error, *, debug=False):
    def work():
        raise error

    return run_guarded("prog", work, debug=debug)


def test_done_work_is_silent_and_zero(capsys):
    assert run_guarded("prog", lambda: None, debug=False) == 0
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("error", "code", "sentence"),
    [
        (SessionError("S is no session."), 1, "prog: S is no session.\n"),
        (
            FileNotFoundError(2, "No such file or directory", "a.ply"),
            1,
            "prog: a.ply: No such file or directory.\n",
        ),
        (OSError(28, "No space left on device"), 1, "prog: No space left on device.\n"),
        (KeyboardInterrupt(), 130, "prog: stopped; what was written so far is whole.\n"),
        (
            ZeroDivisionError("by zero"),
            70,
            "prog: unforeseen ZeroDivisionError: by zero. "
            "Run it again with --debug to see where, and report that.\n",
        ),
    ],
    ids=lambda value: type(value).__name__,
)
def test_what_goes_wrong_is_one_sentence_and_a_code(capsys, error, code, sentence):
    assert guarded(error) == code
    assert capsys.readouterr() == ("", sentence)


@pytest.mark.parametrize("error", [SessionError("S is no session."), ValueError("odd")])
def test_debug_shows_the_traceback(capsys, error):
    guarded(error, debug=True)
    said = capsys.readouterr().err
    assert "Traceback" in said
    assert "in work" in said
    assert "--debug" not in said


def test_without_a_terminal_each_stage_is_a_line(capsys):
    stream = io.StringIO()
    with StageProgress(stream) as progress:
        for fraction in (0.0, 0.5, 0.2, 1.0):
            progress("read frames", fraction)
        progress("solve", 0.0)
    lines = stream.getvalue().splitlines()
    assert [line.split(" after ")[0] for line in lines] == ["read frames: done", "solve: done"]
    assert capsys.readouterr() == ("", "")


def test_a_stage_that_fails_is_not_called_done():
    stream = io.StringIO()

    def work():
        with StageProgress(stream) as progress:
            progress("solve", 0.3)
            raise KeyError

    with pytest.raises(KeyError):
        work()
    assert stream.getvalue().startswith("solve: stopped after")


def test_a_terminal_gets_a_bar_for_each_stage():
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    stream = Terminal()
    with StageProgress(stream) as progress:
        progress("read frames", 0.5)
        progress("solve", 2.0)  # beyond the end: drawn as the end
    assert "read frames" in stream.getvalue()
    assert "100%" in stream.getvalue()
