"""Whether the head moves in the room: what of its motion through the picture the room's does not explain.

While the camera walks around a head and wavers, the head's motion through the picture lies between that of a
point that the camera circles (a little against the room's, for what is nearer than the middle) and the
room's own (the hand turns the camera). What is outside of that is the head's.

Modest: with a camera that stands, swaying by a centimetre or two degrees a second shows; while it walks,
only what is sudden, as a nod; a slow swaying hides in the walk. A camera that is shifted sideways by some
centimetres without turning looks like a head that is.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from capture.live.coverage import SurroundingsTurn
from capture.live.flow import Flow, in_middle

_AGAINST, _ALONG = -0.45, 1.1  # shares of the room's motion that a head at rest may show
_HALF_WIDTH = 0.24  # of the head's inner part, short sides: the outline's corners slide along it
_LEAST_CORNERS = 8
_SHARE = 60  # percentile of the corners: more than half of the head must move
_REST_RAD_S, _FULL_RAD_S = 0.012, 0.045  # unexplained motion of a hand-held camera; of a nod
_STEPS = 3


class HeadMotion:
    """Restlessness of late."""

    def __init__(self) -> None:
        self._speeds: deque[float | None] = deque(maxlen=_STEPS)

    def add(self, flow: Flow, turn: SurroundingsTurn, focal_px: float) -> None:
        """A step, with the surroundings' turn in it."""
        self._speeds.append(unexplained_speed(flow, turn, focal_px))

    def restlessness(self) -> float | None:
        """0 still .. 1 restless, over the last half second or so; None = cannot tell."""
        known = [speed for speed in self._speeds if speed is not None]
        if not known:
            return None
        return float(np.clip((np.mean(known) - _REST_RAD_S) / (_FULL_RAD_S - _REST_RAD_S), 0.0, 1.0))


def unexplained_speed(flow: Flow, turn: SurroundingsTurn, focal_px: float) -> float | None:
    """Angular speed of the head that the room's motion does not explain, radians a second."""
    points = flow.middle
    head = in_middle(points, flow.width, flow.height)
    head &= np.abs(points[:, 0] - flow.width / 2) < _HALF_WIDTH * min(flow.width, flow.height)
    if not turn.known or head.sum() < _LEAST_CORNERS or flow.interval_s <= 0:
        return None
    motion = (flow.after - flow.before)[head] / focal_px
    room = np.array([turn.right_rad, turn.down_rad])
    low, high = np.minimum(_AGAINST * room, _ALONG * room), np.maximum(_AGAINST * room, _ALONG * room)
    beyond = np.maximum(0.0, np.maximum(low - motion, motion - high))
    return float(np.percentile(np.hypot(*beyond.T), _SHARE)) / flow.interval_s
