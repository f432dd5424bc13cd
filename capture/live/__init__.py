"""What the operator sees while recording: meters, tag strip, coverage, motion, in the terminal or a browser.

    monitor = LiveMonitor(width, height, transfer="srgb", fps=30, train_period_s=1.0, duration_s=20)
    monitor.add(small_picture, stamp_s, sequence)     for every frame, cheap
    state = monitor.snapshot()                        a few times a second, plain numbers
    panel.show(state)                                 `terminal_panel.TerminalPanel`
    server.update(state, small_picture)               `preview.PreviewServer`

Everything here is for showing: causal, coarse and cheap. What goes into a session is measured by
`capture.tagging` and what follows it.

    meters.py          level, clipping, sharpness of one picture
    live_tags.py       lit, unlit or partial, from what has been seen so far
    flow.py            corners followed through the unlit frames
    coverage.py        how far around the head the camera has been, from the surroundings' motion
    motion.py          whether the head moves, from what of its motion the surroundings do not explain
    advice.py          the one sentence
    monitor.py         all of it, frame by frame
    terminal_panel.py, preview.py, preview_page.py    showing
"""

from capture.live.monitor import LiveMonitor
from capture.live.state import LiveState

__all__ = ["LiveMonitor", "LiveState"]
