"""How far around the head the camera has been, from the motion of what is around the head in the picture.

Somebody walks around a head and keeps it in the middle. By the angle that he has walked, the camera has
turned; what is far away moves through the picture by that turn. What is not so far moves less: a wall at
distance Z behind a head at distance D by the share 1 - D / Z of it (small-motion flow, Longuet-Higgins and
Prazdny 1980, of a rotation about a point at distance D). D / Z is taken to be 1/4, as with a head at 0.6 m
and walls at 2.4 m, which is what the simulated rooms are; with walls at 1.5 m the gauge shows 80 % of the
truth, at 5 m 117 %. Nothing in the picture tells this ratio well enough from so short steps.

The turn is fitted robustly to the corners that are surely not the head: the largest group that moves alike,
by a full rotation so that wide-angle pictures are not taken for more. Where there is no such group (bare
walls) nothing is told, and after too much of that the whole gauge says that it cannot tell.

Not seen: a chair that turns before a camera that stands (the surroundings do not move), and which way the
face looks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from capture.live.flow import Flow
from capture.live.state import BIN_DEG, BINS, Coverage

#: D / Z: how much nearer the head is than what is behind it.
NEARNESS = 0.25
#: Focal length that is taken when none is known, in long sides of the picture: 58 degrees across.
TYPICAL_FOCAL = 0.9

_HEAD_AXES = (0.36, 0.50)  # half axes of what may be the head, short sides; certain at _SURE times that
_SURE = 0.35
_BODY_FROM, _BODY_WEIGHT = 0.15, 0.1  # below the middle by this, shoulders are likelier than room
_ALIKE_PX, _ALIKE_SHARE = 1.2, 0.12  # corners move alike within this and this share of their motion
_LEAST_EVIDENCE = 1.8  # sum of the weights of the corners that agree
_STILL_PX = 0.35  # when nearly all corners move less in a step, the camera stands, whatever they are
_STILL_CORNERS = 12
_BRIDGE_S = 0.8  # so long a gap is bridged at the last speed
_TURN_PRIOR_RAD = 0.05  # of roll and zoom in a step: free where corners tell, zero where they do not
_LOST, _HOPELESS = 0.12, 0.4  # shares of the time without evidence
_SETTLED_S = 1.5
_DECIDED_DEG = 6.0  # walked so far, the direction is known

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class SurroundingsTurn:
    """How the surroundings moved through the picture in a step.

    Attributes:
        right_rad: turn of the picture's content towards the right.
        down_rad: likewise, downwards.
        evidence: sum of the weights of the corners that agree on it.
        known: enough of them do, or nothing moves at all.
    """

    right_rad: float
    down_rad: float
    evidence: float
    known: bool


def surroundings_turn(flow: Flow, focal_px: float) -> SurroundingsTurn:
    """The turn of what is not the head.

    Args:
        flow: of a step.
        focal_px: of the followed picture.
    """
    moved = np.abs(flow.after - flow.before).max(axis=1, initial=0.0)
    if len(flow) >= _STILL_CORNERS and float(np.percentile(moved, 85)) < _STILL_PX:
        return SurroundingsTurn(0.0, 0.0, float(len(flow)), True)
    weights = _surroundings(flow)
    used = weights > 0.05
    if used.sum() < 4:
        return SurroundingsTurn(0.0, 0.0, 0.0, False)
    weights = weights[used]
    x, y = ((flow.middle[used] - np.array([flow.width, flow.height]) / 2) / focal_px).T.astype(float)
    motion = ((flow.after - flow.before)[used] / focal_px).astype(float)
    chosen = weights * _largest_group(x, y, motion, weights, focal_px)
    columns = _rotation_columns(x, y)
    prior = np.diag([0.0, 0.0, 1.0, 1.0]) / (focal_px * _TURN_PRIOR_RAD) ** 2
    for _ in range(5):
        normal = np.einsum("n,nij,nik->jk", chosen, columns, columns) + prior + 1e-12 * np.eye(4)
        turn = np.linalg.solve(normal, np.einsum("n,nij,ni->j", chosen, columns, motion))
        left = np.linalg.norm(motion - columns @ turn, axis=1)
        usual = 3 * 1.4826 * float(np.median(left[chosen > 0.02 * weights])) if chosen.any() else 0.0
        width = min(max(usual, 0.8 / focal_px), 3.0 / focal_px + 0.3 * math.hypot(turn[0], turn[1]))
        chosen = weights * np.clip(1 - (left / width) ** 2, 0, 1) ** 2  # Tukey's biweight
    evidence = float(chosen[weights > _BODY_WEIGHT].sum())  # shoulders alone prove nothing of the room
    return SurroundingsTurn(float(turn[1]), float(-turn[0]), evidence, evidence >= _LEAST_EVIDENCE)


def _surroundings(flow: Flow) -> Floats:
    """[N] how surely each corner is not of the sitter, 0..1."""
    side = min(flow.width, flow.height)
    x, y = ((flow.middle - np.array([flow.width, flow.height]) / 2) / side).T
    outside = (x / _HEAD_AXES[0]) ** 2 + (y / _HEAD_AXES[1]) ** 2 - 1
    return np.asarray(np.clip(outside / _SURE, 0, 1) * np.where(y > _BODY_FROM, _BODY_WEIGHT, 1.0), float)


def _largest_group(
    x: Floats, y: Floats, motion: Floats, weights: Floats, focal_px: float
) -> NDArray[np.bool_]:
    """[N] corners that move like the one which most others move like."""
    turn = motion / np.stack([1 + x * x, 1 + y * y], axis=1)
    apart = np.abs(turn[:, None] - turn[None]).max(axis=-1)
    alike = _ALIKE_PX / focal_px + _ALIKE_SHARE * np.abs(turn).max(axis=1)
    votes = (weights[None] * (apart < alike[:, None])).sum(axis=1)
    best = int(np.argmax(votes * weights**0.25))
    return np.asarray(apart[best] < 1.5 * alike[best])


def _rotation_columns(x: Floats, y: Floats) -> Floats:
    """[N, 2, 4] motion in the image plane by a small rotation about x, y, z, and by a zoom."""
    pitch = np.stack([-x * y, -(1 + y * y)], axis=1)
    yaw = np.stack([1 + x * x, x * y], axis=1)
    roll, zoom = np.stack([-y, x], axis=1), np.stack([x, y], axis=1)
    return np.stack([pitch, yaw, roll, zoom], axis=2)


class CoverageGauge:
    """Adds the steps up."""

    def __init__(self) -> None:
        self._azimuth = self._elevation = 0.0  # degrees from the start
        self._low = self._high = self._lowest = self._highest = 0.0
        self._rate = np.zeros(2)  # degrees a second, of the last step that was known
        self._gap_s = self._lost_s = self._total_s = 0.0
        self._seen: dict[int, int] = {0: 1}
        self._direction = 0

    def add(self, turn: SurroundingsTurn, interval_s: float) -> None:
        """A step; what is not known is bridged at the last speed for a moment, and then is lost."""
        self._total_s += interval_s
        if turn.known:
            step = np.degrees([turn.right_rad, -turn.down_rad]) / (1 - NEARNESS)
            self._rate, self._gap_s = step / max(interval_s, 1e-3), 0.0
        else:
            self._gap_s += interval_s
            self._lost_s += interval_s
            bridged = self._gap_s <= _BRIDGE_S
            step = self._rate * interval_s if bridged else np.zeros(2)
        before = self._azimuth
        self._azimuth += float(step[0])
        self._elevation += float(step[1])
        self._low, self._high = min(self._low, self._azimuth), max(self._high, self._azimuth)
        self._lowest, self._highest = min(self._lowest, self._elevation), max(self._highest, self._elevation)
        first, last = sorted((_bin(before), _bin(self._azimuth)))
        for place in range(first, last + 1):
            self._seen.setdefault(place, 1)
        if not self._direction and abs(self._azimuth) > _DECIDED_DEG:
            self._direction = 1 if self._azimuth > 0 else -1

    def flash(self) -> None:
        """A fully lit frame was taken where the camera is now."""
        self._seen[_bin(self._azimuth)] = 2

    def coverage(self) -> Coverage:
        """As it stands."""
        lost = self._lost_s / self._total_s if self._total_s > _SETTLED_S else 0.0
        if lost > _HOPELESS:
            return Coverage(at_least=True)
        # The half circle begins at the end from which the walk set out.
        first = _bin(self._low) if self._direction >= 0 else _bin(self._high) - BINS + 1
        bins = tuple(self._seen.get(first + place, 0) for place in range(BINS))
        place = min(max(self._azimuth / BIN_DEG - first, 0.0), float(BINS))
        return Coverage(
            azimuth_deg=self._azimuth,
            elevation_deg=self._elevation,
            span_deg=self._high - self._low,
            elevation_span_deg=self._highest - self._lowest,
            at_least=lost > _LOST,
            bins=bins,
            place=place,
        )


def _bin(azimuth_deg: float) -> int:
    return math.floor(azimuth_deg / BIN_DEG)
