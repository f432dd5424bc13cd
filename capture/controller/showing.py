"""A capture shown while it goes on: the monitor's state in the terminal, and in a browser on demand."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress

import numpy as np

from capture.controller.looking import LookedFrame, Watch
from capture.devices.flash import FlashEdge
from capture.live.monitor import LiveMonitor
from capture.live.preview import PreviewServer
from capture.live.terminal_panel import TerminalPanel

_SHOWN_HZ = 8.0
_USUAL_FPS = 30.0


@contextmanager
def open_watch(duration_s: float, period_s: float, *, preview: int | None, panel: bool) -> Iterator[Watch]:
    """Those who are shown a capture.

    Args:
        duration_s: Of the capture.
        period_s: Of its flash.
        preview: Port of the page on this machine, 0 = any that is free; None = no page.
        panel: Whether the terminal shows it.

    Raises:
        DeviceError: The port is taken.
    """
    with ExitStack() as stack:
        server = None if preview is None else stack.enter_context(PreviewServer(port=preview))
        if server is not None:
            print(f"relight-capture: the preview is at {server.url}", file=sys.stderr, flush=True)
        terminal = stack.enter_context(TerminalPanel()) if panel else None
        yield Display(duration_s, period_s, terminal, server)


class Display:
    """Gives frames to a monitor, and its state to panel and page a few times a second."""

    def __init__(
        self,
        duration_s: float,
        period_s: float,
        panel: TerminalPanel | None,
        server: PreviewServer | None,
    ) -> None:
        """Of a capture."""
        self._duration_s, self._period_s = duration_s, period_s
        self._panel, self._server = panel, server
        self._monitor: LiveMonitor | None = None
        self._shown_s = float("-inf")

    def frame(self, frame: LookedFrame, waiting: int) -> None:
        """See `Watch.frame`."""
        picture = frame.shown
        if self._monitor is None:
            stream = frame.stream_format
            self._monitor = LiveMonitor(
                picture.shape[1],
                picture.shape[0],
                "srgb" if stream.transfer == "linear" else stream.transfer,
                stream.fps or _USUAL_FPS,
                self._period_s,
                self._duration_s,
                rotation_deg=stream.rotation_deg,
            )
        self._monitor.add(picture, frame.pts_s, frame.sequence, queue=waiting)
        now_s = time.monotonic()
        if now_s < self._shown_s + 1.0 / _SHOWN_HZ:
            return
        self._shown_s = now_s
        state = self._monitor.snapshot()
        if self._panel is not None:
            self._panel.show(state)
        if self._server is not None:
            turns = frame.stream_format.rotation_deg // 90
            self._server.update(state, np.ascontiguousarray(np.rot90(frame.rgb, -turns)))

    def edges(self, edges: Sequence[FlashEdge]) -> None:
        """See `Watch.edges`."""
        if self._monitor is not None:
            self._monitor.edges(edges)

    def say(self, sentence: str) -> None:
        """See `Watch.say`; above the panel, which redraws itself below what is printed."""
        with suppress(OSError):  # the terminal may be gone; the capture is not
            print(f"relight-capture: {sentence}", file=sys.stderr, flush=True)
