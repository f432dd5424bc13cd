"""What commands owe a person at a terminal: progress while it lasts, one sentence and a code when it fails.

0    the work is done
1    it is not, and the sentence on stderr says why and what to do next
2    the command line was not understood
70   an error that nobody foresaw; `--debug` shows where
130  stopped by Ctrl-C
"""

from __future__ import annotations

import os
import sys
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from types import TracebackType
from typing import TYPE_CHECKING, Self, TextIO

from capture.errors import RelightError

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID


def run_guarded(program: str, work: Callable[[], None], *, debug: bool) -> int:
    """Does `work`; whatever it raises becomes one sentence on stderr and an exit code."""
    try:
        work()
        sys.stdout.flush()
    except RelightError as error:
        _complain(program, str(error), debug)
        return 1
    except KeyboardInterrupt:
        _complain(program, "stopped; what was written so far is whole.", debug)
        return 130
    except BrokenPipeError:
        # The reader of our output went away (`relight plan S | head`): there is nowhere left to say anything.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        _complain(program, f"{place}{error.strerror or error}.", debug)
        return 1
    except Exception as error:
        hint = "" if debug else " Run it again with --debug to see where, and report that."
        _complain(program, f"unforeseen {type(error).__name__}: {error}.{hint}", debug)
        return 70
    return 0


class StageProgress:
    """Shows progress on stderr: a bar on a terminal, a line a stage elsewhere.

    A callable `(stage, fraction)` for functions that report progress, and the context that draws it.

    A stage begins when it is first named and ends when another one is, or the context does. Fractions are
    0..1; one that falls back within a stage is taken as it is (a loop may turn out longer).
    """

    def __init__(self, stream: TextIO | None = None) -> None:
        self._stream = sys.stderr if stream is None else stream
        self._stage: str | None = None
        self._started_s = 0.0
        self._bars: Progress | None = None
        self._bar: TaskID | None = None

    def __enter__(self) -> Self:
        if self._stream.isatty():
            self._bars = _bars(self._stream)
            self._bars.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._end_stage(finished=kind is None)
        if self._bars is not None:
            self._bars.stop()

    def __call__(self, stage: str, fraction: float) -> None:
        """Says how far `stage` has come."""
        if stage != self._stage:
            self._end_stage(finished=True)
            self._stage, self._started_s = stage, time.monotonic()
            if self._bars is not None:
                self._bar = self._bars.add_task(stage, total=1.0)
        if self._bars is not None and self._bar is not None:
            self._bars.update(self._bar, completed=min(max(fraction, 0.0), 1.0))

    def _end_stage(self, *, finished: bool) -> None:
        if self._stage is None:
            return
        if self._bars is not None and self._bar is not None:
            self._bars.stop_task(self._bar)
            if finished:
                self._bars.update(self._bar, completed=1.0)
        else:
            word = "done" if finished else "stopped"
            seconds = time.monotonic() - self._started_s
            print(f"{self._stage}: {word} after {seconds:.1f} s", file=self._stream, flush=True)
        self._stage = None


def _bars(stream: TextIO) -> Progress:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

    return Progress(
        TextColumn("{task.description:28}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        console=Console(file=stream),
    )


def _complain(program: str, sentence: str, debug: bool) -> None:
    with suppress(OSError):  # the terminal may be gone
        if debug:
            traceback.print_exc()
        print(f"{program}: {sentence}", file=sys.stderr)
