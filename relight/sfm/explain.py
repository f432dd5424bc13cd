"""Why no poses were found, in sentences that help."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pycolmap

from relight.sfm.attempts import Outcome
from relight.sfm.matching import Pair
from relight.sfm.survey import Look

_FEW_FEATURES = 150
_FEW_MATCHES = 30
_MOSTLY = 0.8
_NO_MOTION = 0.02  # of the longer side, between the frames that are farthest apart and still match

_KINDS = pycolmap.TwoViewGeometryConfiguration
_FLAT = (int(_KINDS.PLANAR), int(_KINDS.PANORAMIC), int(_KINDS.PLANAR_OR_PANORAMIC))
_MARKERS = "put a few printed markers (ArUco or AprilTag) or posters into view"


def explain(
    looks: Sequence[Look], outcomes: Sequence[Outcome], mapped: Sequence[Look], posed: int = 0
) -> str:
    """What was seen and what to do, for a session whose poses could not be found.

    Args:
        looks: All frames that could be read.
        outcomes: What was tried on them, at least one.
        mapped: The keyframes of the last attempt.
        posed: Frames that have a pose, too few of all.
    """
    last = outcomes[-1]
    best = max(outcomes, key=lambda outcome: outcome.registered)
    seen, advice = _seen(mapped, last.pairs)
    if best.sparse is not None:
        if len(best.pieces) > 1 and not best.complaints:
            sizes = " and ".join(str(size) for size in best.pieces[:3])
            seen.append(f"the frames fell into pieces of {sizes} that share too little")
            advice.append("film in one slow sweep without gaps")
        elif best.complaints:
            seen.append(f"the best reconstruction has {'; '.join(best.complaints)}")
        else:
            seen.append(f"only {best.registered} of {len(mapped)} frames could be put together")
    if not advice:
        advice = ["film in one slow sweep around the head", _MARKERS]
    if best.assessment is not None and not best.assessment.parallax:
        advice = ["walk around the head instead of turning the camera on the spot"]
    found = (
        f"Only {posed} of {len(looks)} frames could be posed"
        if posed
        else (f"No poses were found for {len(looks)} frames")
    )
    return (
        f"{found}: {'; '.join(seen) or 'they do not fit together'}. "
        f"To help, {', or '.join(dict.fromkeys(advice))}."
    )


def all_flat(pairs: Sequence[Pair]) -> bool:
    """Whether the frames match well and yet show no parallax: other features would not change that."""
    verified = [pair for pair in pairs if pair.verified]
    flat = [pair for pair in verified if pair.geometry is not None and pair.geometry.config in _FLAT]
    return len(verified) >= max(3, len(pairs) // 4) and len(flat) > _MOSTLY * len(verified)


def _seen(looks: Sequence[Look], pairs: Sequence[Pair]) -> tuple[list[str], list[str]]:
    """What the features and matches alone show, and what would change it."""
    seen, advice = [], []
    count = float(np.median([len(look.features) for look in looks])) if looks else 0.0
    if count < _FEW_FEATURES:
        seen.append(f"a frame has {count:.0f} features (the background is plain or the pictures are blurred)")
        advice += [_MARKERS, "keep the flash on the skin and the head in focus"]
    neighbours = [pair for pair in pairs if pair.second - pair.first == 1]
    shared = float(np.median([len(pair.inliers) for pair in neighbours])) if neighbours else 0.0
    if shared < _FEW_MATCHES:
        seen.append(f"neighbouring frames share {shared:.0f} points")
        advice += ["film more slowly", _MARKERS]
    motion = _widest_motion(looks, pairs)
    if motion is not None and motion < _NO_MOTION:
        seen.append(f"nothing moves by more than {100 * motion:.1f} % of the picture between any two frames")
        advice = ["walk around the head while filming"]
    if all_flat(pairs):
        seen.append(
            "all motion is that of a plane or of a camera that turned on the spot: there is no parallax"
        )
        advice.append("walk around the head instead of turning the camera")
    return seen, advice


def _widest_motion(looks: Sequence[Look], pairs: Sequence[Pair]) -> float | None:
    """Upper quartile of the motion of matches in the pairs that are farthest apart; share of the side."""
    motions = []
    for pair in pairs:
        inliers = pair.inliers
        if len(inliers):
            a = looks[pair.first].features.places_px[inliers[:, 0]]
            b = looks[pair.second].features.places_px[inliers[:, 1]]
            shift = np.linalg.norm(a - b, axis=1) / max(looks[pair.first].size)
            motions.append(float(np.percentile(shift, 75.0)))
    return max(motions) if motions else None
