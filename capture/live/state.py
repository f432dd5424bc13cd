"""What the displays are given: plain numbers of one moment."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

#: Width of a bin of view directions, degrees, and how many make the half circle of the gauge.
BIN_DEG = 10
BINS = 18


@dataclass(frozen=True, kw_only=True)
class Coverage:
    """How far around the head the camera has been; angles in degrees, from where it started.

    Attributes:
        azimuth_deg: now, positive towards the right of the picture (the sitter's left); None = cannot tell.
        elevation_deg: now, positive upwards; None = cannot tell.
        span_deg: from the least to the largest azimuth so far; None = cannot tell.
        elevation_span_deg: likewise.
        at_least: parts of the way could not be measured: the spans are what was seen of it.
        bins: `BINS` of `BIN_DEG` degrees from left to right: 0 = not been there, 1 = seen, 2 = seen with the
            flash too. The end where the walk began is at one end.
        place: of the camera among the bins, 0..`BINS`; None = cannot tell.
    """

    azimuth_deg: float | None = None
    elevation_deg: float | None = None
    span_deg: float | None = None
    elevation_span_deg: float | None = None
    at_least: bool = False
    bins: tuple[int, ...] = (0,) * BINS
    place: float | None = None


@dataclass(frozen=True, kw_only=True)
class LiveState:
    """A moment of a recording, for display.

    Attributes:
        elapsed_s: since the first frame.
        left_s: until the planned end; not negative.
        frames: so far.
        drops: frames that the sequence numbers say were lost.
        queue: frames that wait to be written.
        level: median display value of the subject area of unlit frames, 0..1.
        level_lit: the same of the last flash; None = none seen.
        clipped: share of the whole picture at white clip, unlit or lit, whichever was more lately.
        clipped_subject: the same of the subject area.
        dark: share of the subject area of unlit frames at black.
        labels: of the last frames, oldest first: "lit", "unlit", "partial", "unknown".
        pulses_seen: flashes told from the pictures.
        pulses_expected: flashes that should have been by now; None = no train runs.
        coverage: of view directions.
        motion: of the head against the room, 0 still .. 1 restless; None = cannot tell.
        sharpness: of the last frame against the sharpest of late, 0..1.
        advice: one short sentence, or nothing.
        finished: the planned time is over.
    """

    elapsed_s: float = 0.0
    left_s: float = 0.0
    frames: int = 0
    drops: int = 0
    queue: int = 0
    level: float = 0.0
    level_lit: float | None = None
    clipped: float = 0.0
    clipped_subject: float = 0.0
    dark: float = 0.0
    labels: tuple[str, ...] = ()
    pulses_seen: int = 0
    pulses_expected: int | None = None
    coverage: Coverage = field(default_factory=Coverage)
    motion: float | None = None
    sharpness: float = 1.0
    advice: str = ""
    finished: bool = False

    def to_json(self) -> dict[str, Any]:
        """Plain values, for the browser."""
        return asdict(self)
