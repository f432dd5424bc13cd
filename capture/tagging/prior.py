"""A schedule or a log of flash commands against the pulses that the frames show."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from capture.errors import TaggingError
from capture.tagging.result import FlashPrior, PriorCheck

Floats = NDArray[np.float64]

# Pulses belong to commands within this time of their common offset: the jank of a phone's user interface.
_TOLERANCE_S = 0.12
# Fewer matches than this share of the smaller side contradict the prior.
_LEAST_MATCHED = 0.5
# Mean pulse lengths farther apart than this are worth a word: a frame or so of latency in switching off is
# usual.
_LENGTH_SLACK_S = 0.05
_MOST_CANDIDATES = 4000


def check_prior(
    prior: FlashPrior, on_s: Floats, off_s: Floats, begin_s: float, end_s: float
) -> tuple[PriorCheck, list[str]]:
    """Fit the constant offset, and compare.

    Args:
        prior: to check.
        on_s: [P] observed starts of pulses.
        off_s: [P] observed ends.
        begin_s: time of the first frame.
        end_s: time of the last frame.

    Raises:
        TaggingError: no offset makes the two agree.
    """
    asked = np.sort(np.asarray(prior.times_s, float))
    if not len(asked) or not np.all(np.isfinite(asked)):
        raise TaggingError(
            f"The flash times of {prior.source} are empty or not numbers; leave them out or mend them."
        )
    offset = _best_offset(asked, on_s)
    partner = np.array([_nearest(asked + offset, t) for t in on_s])
    late = on_s - (asked + offset)[partner]
    near = np.abs(late) <= _TOLERANCE_S
    inside = (asked + offset > begin_s) & (asked + offset < end_s)
    expected = int(inside.sum())
    matched = len(set(partner[near].tolist()))
    if matched < _LEAST_MATCHED * max(expected, len(on_s)):
        raise TaggingError(
            f"{prior.source} has {expected} pulses in this sequence and the frames show {len(on_s)}, of "
            f"which only {matched} "
            f"fit within {1e3 * _TOLERANCE_S:.0f} ms at any offset; it belongs to another recording, leave "
            "it out."
        )
    offset += float(np.median(late[near]))
    late = on_s[near] - (asked + offset)[partner[near]]
    check = PriorCheck(
        offset_s=offset,
        jitter_s=1.4826 * float(np.median(np.abs(late))),
        matched=matched,
        missing_s=tuple(float(t) for t in np.delete(asked + offset, partner[near]) if begin_s < t < end_s),
        extra_s=tuple(float(t) for t in on_s[~near]),
    )
    return check, _warnings(prior, check, on_s, off_s)


def _warnings(prior: FlashPrior, check: PriorCheck, on_s: Floats, off_s: Floats) -> list[str]:
    out = []
    if check.missing_s:
        out.append(
            f"{len(check.missing_s)} pulses of {prior.source} are not in the frames (first at "
            f"{check.missing_s[0]:.2f} s)."
        )
    if check.extra_s:
        out.append(
            f"{len(check.extra_s)} pulses in the frames are not in {prior.source} (first at "
            f"{check.extra_s[0]:.2f} s)."
        )
    length = float(np.median(off_s - on_s))
    if prior.on_s is not None and abs(length - prior.on_s) > _LENGTH_SLACK_S:
        out.append(
            f"Pulses are {1e3 * length:.0f} ms long in the frames and {1e3 * prior.on_s:.0f} ms in "
            f"{prior.source}."
        )
    return out


def _best_offset(asked: Floats, seen: Floats) -> float:
    """The offset that brings most pulses near a command.

    Every pair gives a candidate. Regular commands leave the offset open by whole periods when an end is not
    seen; among offsets that do equally well (to a hundredth of a second) the smallest is taken.
    """
    candidates = (seen[:, None] - asked[None]).ravel()
    if (
        len(candidates) > _MOST_CANDIDATES
    ):  # a long recording: its first pulses give every offset there can be
        candidates = (seen[: max(_MOST_CANDIDATES // len(asked), 3), None] - asked[None]).ravel()

    def merit(offset: float) -> tuple[int, int, float]:
        distance = np.abs(seen - (asked + offset)[[_nearest(asked + offset, t) for t in seen]])
        near = distance <= _TOLERANCE_S
        return int(near.sum()), -round(100 * float(np.mean(distance[near]))), -abs(offset)

    return float(max(candidates, key=merit))


def _nearest(times: Floats, t: float) -> int:
    return int(np.argmin(np.abs(times - t)))
