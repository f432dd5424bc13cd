"""Which frames of a video are kept: every fully lit one, and the sharpest unlit one of each interval.

A flash of 100 ms lights two or three of thirty frames a second in full, so evenly spaced frames would miss
most of them; the choice is made after every frame has been looked at and tagged.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from capture.frame_record import EXCLUDING_REASONS, FrameRecord

# Share of the median sharpness around it below which a frame counts as blurred. The measure falls with the
# square of the contrast of fine detail: motion over three to four pixels of the measured plane gets there.
_BLURRED_SHARE = 0.2
_BLUR_NEIGHBOURHOOD_S = 2.0


@dataclass(frozen=True, slots=True)
class Candidate:
    """What the choice needs to know of one frame.

    Attributes:
        pts_s: time; candidates come in order of it.
        flash: 1 = fully lit, 0 = not lit, None = partly lit or unknown.
        sharpness: from `measure_sharpness`.
        sound: nothing speaks against the frame.
        posed: a pose is known for it.
    """

    pts_s: float
    flash: int | None
    sharpness: float
    sound: bool = True
    posed: bool = False


def measure_sharpness(luma: NDArray[Any]) -> float:
    """Mean squared Laplacian over squared mean of a plane of 0.1 to 1 megapixel, uint8 or uint16.

    Larger is sharper. The division makes it blind to how strongly the scene is lit. Noise adds the same to
    all frames of a capture.
    """
    kind = cv2.CV_16S if luma.dtype == np.uint8 else cv2.CV_32F
    energy = cv2.norm(cv2.Laplacian(luma, kind), cv2.NORM_L2SQR) / luma.size
    mean = cv2.mean(luma)[0]
    return float(energy / (mean * mean)) if mean > 0 else 0.0


def select_frames(
    candidates: Sequence[Candidate], rate_hz: float = 6.0, max_frames: int | None = None
) -> frozenset[int]:
    """Positions of the frames to keep.

    All fully lit frames are kept. Time is cut into intervals of 1 / rate_hz from the first frame on, and the
    sharpest sound unlit frame of each is kept, one with a pose before one without. Partly lit and unknown
    frames are not.

    Args:
        candidates: in order of time.
        rate_hz: unlit frames kept each second, > 0.
        max_frames: at most so many in all; then both kinds are thinned, evenly in time, the unlit ones only
            as far as half of the number.
    """
    if not rate_hz > 0 or not math.isfinite(rate_hz):
        raise ValueError(f"rate_hz is {rate_hz}; it must be a positive number.")
    lit = [position for position, candidate in enumerate(candidates) if candidate.flash == 1]
    unlit = _best_of_intervals(candidates, 0, rate_hz)
    if max_frames is not None and len(lit) + len(unlit) > max_frames:
        unlit_share = min(len(unlit), max(max_frames - len(lit), max_frames // 2))
        unlit = _spread(unlit, unlit_share)
        lit = _spread(lit, max_frames - len(unlit))
    return frozenset(lit) | frozenset(unlit)


def select_records(
    records: Sequence[FrameRecord],
    picture: Callable[[FrameRecord], str | None],
    *,
    rate_hz: float = 6.0,
    max_frames: int | None = None,
    posed: Collection[int] = (),
) -> list[FrameRecord]:
    """The records with the pictures of those to keep, and with the reason where one is not kept.

    Args:
        records: tagged, in order of time.
        picture: the file of a frame that is kept.
        rate_hz: see `select_frames`.
        max_frames: see `select_frames`.
        posed: indices of frames whose pose is known.
    """
    candidates = [
        Candidate(
            pts_s=record.pts_s or 0.0,
            flash=None if "unreadable" in record.reasons else record.flash,
            sharpness=record.sharpness or 0.0,
            sound=EXCLUDING_REASONS.isdisjoint(record.reasons),
            posed=record.index in posed,
        )
        for record in records
    ]
    kept = select_frames(candidates, rate_hz, max_frames)
    blurred = find_blurred(candidates, kept)
    selected = []
    for position, record in enumerate(records):
        if position in kept:
            remark = ("blurred",) if position in blurred else ()
            selected.append(replace(record, file=picture(record), reasons=(*record.reasons, *remark)))
        elif EXCLUDING_REASONS.isdisjoint(record.reasons):
            selected.append(replace(record, file=None, reasons=(*record.reasons, "not_selected")))
        else:
            selected.append(replace(record, file=None))
    return selected


def find_blurred(candidates: Sequence[Candidate], positions: Collection[int]) -> frozenset[int]:
    """Those of `positions` that are far less sharp than the frames of the same flash state around them."""
    times = np.array([candidate.pts_s for candidate in candidates])
    states = np.array([-1 if candidate.flash is None else candidate.flash for candidate in candidates])
    sharpness = np.array([candidate.sharpness for candidate in candidates])
    blurred = set()
    for position in positions:
        low, high = np.searchsorted(times, times[position] + np.array([-1, 1]) * _BLUR_NEIGHBOURHOOD_S)
        around = sharpness[low:high][states[low:high] == states[position]]
        if sharpness[position] < _BLURRED_SHARE * np.median(around):
            blurred.add(position)
    return frozenset(blurred)


def _best_of_intervals(candidates: Sequence[Candidate], flash: int, rate_hz: float) -> list[int]:
    best: dict[int, int] = {}
    for position, candidate in enumerate(candidates):
        if candidate.flash != flash or not candidate.sound:
            continue
        interval = math.floor((candidate.pts_s - candidates[0].pts_s) * rate_hz)
        rival = best.get(interval)
        if rival is None or _rank(candidate) > _rank(candidates[rival]):
            best[interval] = position
    return sorted(best.values())


def _rank(candidate: Candidate) -> tuple[bool, float]:
    return candidate.posed, candidate.sharpness


def _spread(positions: list[int], count: int) -> list[int]:
    """`count` of the positions, evenly along the list."""
    if count <= 0:
        return []
    steps = (np.arange(count) + 0.5) * len(positions) / count
    return [positions[int(step)] for step in steps]
