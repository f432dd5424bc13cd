"""Whether pulses are seen at all, told while a capture runs: the quick split over the last seconds."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from capture.errors import TaggingError
from capture.tagging.config import TaggingConfig
from capture.tagging.split import split_frames
from capture.tagging.windows import runs_of

# The split looks at so many seconds, again after so many.
_WINDOW_S, _AGAIN_S = 10.0, 0.5
# A pulse is counted when so much after it has been seen; a command is missed when its pulse has not been
# seen so long after it was reported: a phone's or a lamp's latency, and the split's own delay.
_SETTLED_S, _PATIENCE_S = 0.3, 1.0
_LEAST_FRAMES = 24


@dataclass(frozen=True)
class PulseStatus:
    """How the flash fares, by the light.

    Attributes:
        seen: pulses seen so far.
        expected: pulses that the flash has reported so far.
        unseen: reported ones, in a row up to now, without a pulse in the frames; those of the last second
            are not counted, their frames may be on the way.
        last_seen_s: when the latest pulse was seen, on the frames' axis; None = none yet.
        separation: of lit frames from unlit ones, in spreads of the unlit ones; 0 = no two classes.
    """

    seen: int
    expected: int
    unseen: int
    last_seen_s: float | None
    separation: float


class PulseWatch:
    """Counts pulses a second or so after they come; what it counts is not checked as tags are."""

    def __init__(self, config: TaggingConfig) -> None:
        """Nothing has been seen."""
        self._config = config
        self._frames: deque[tuple[float, NDArray[np.float32]]] = deque()
        self._reported: deque[float] = deque()
        self._expected = self._seen = 0
        self._looked_s = -np.inf
        self._last_s: float | None = None
        self._separation = 0.0

    def add(self, pts_s: float, square: NDArray[np.float32]) -> None:
        """Takes a frame's mean linear light of blocks [n, n]."""
        if self._frames and pts_s - self._frames[-1][0] > self._config.longest_period_s:
            self._frames.clear()
            self._reported.clear()  # nobody looked
        self._frames.append((pts_s, square))
        while self._frames[0][0] < pts_s - _WINDOW_S:
            self._frames.popleft()

    def expect(self, times_s: Sequence[float]) -> None:
        """The flash has reported pulses; their frames may come much later on a machine that is busy."""
        now_s = self._frames[-1][0] if self._frames else -np.inf
        self._expected += len(times_s)
        self._reported.extend(max(now_s, time_s) for time_s in times_s)

    def status(self) -> PulseStatus:
        """How it stands."""
        if self._frames and self._frames[-1][0] - self._looked_s >= _AGAIN_S:
            self._look()
        last_s = -np.inf if self._last_s is None else self._last_s
        while self._reported and self._reported[0] <= last_s + _PATIENCE_S:
            self._reported.popleft()
        now_s = self._frames[-1][0] if self._frames else -np.inf
        unseen = sum(1 for reported_s in self._reported if reported_s <= now_s - _PATIENCE_S)
        return PulseStatus(self._seen, self._expected, unseen, self._last_s, self._separation)

    def _look(self) -> None:
        self._looked_s = self._frames[-1][0]
        self._separation = 0.0
        if len(self._frames) < _LEAST_FRAMES:
            return
        pts_s = np.array([t for t, _ in self._frames])
        try:
            split = split_frames(pts_s, np.stack([square for _, square in self._frames]), self._config)
        except TaggingError:
            return
        self._separation = split.separation
        # the same pulse is in many windows: it is new when it begins after the last one's end
        for first, last in runs_of(split.core):
            new = self._last_s is None or pts_s[first] > self._last_s + 0.5 * self._config.shortest_period_s
            if new and pts_s[last] < pts_s[-1] - _SETTLED_S:
                self._seen += 1
                self._last_s = float(pts_s[last])
