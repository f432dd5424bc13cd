"""What the masks came to: numbers for the report, sentences for the user, and when to refuse."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from relight.errors import GeometryError
from relight.masks.config import MaskConfig
from relight.masks.flash import LEAST_SEPARATION
from relight.masks.frames import Floats
from relight.masks.silhouette import Silhouette
from relight.masks.subject import SubjectCloud

NOTHING, EVERYTHING = 0.003, 0.97
"""Shares of a picture that count as nothing and as all of it."""
MOVED_SHARE = 0.009
"""Of the longer side of a picture: outlines further from the cloud's mean a head that moved (5 px of 512)."""

_DISAGREEMENT = 0.85  # intersection over union of masks and silhouettes
_FEWEST_KEPT = 0.5


@dataclass(frozen=True)
class FrameOutcome:
    """One frame's mask.

    Attributes:
        index: Of the frame.
        coverage: Mean of the mask.
        cloud_coverage: Share of the picture that the cloud covers.
        agreement: Intersection over union of mask and cloud.
        shift_px: By how much the mask's outline is displaced from the cloud's, as a whole.
        longest_px: Longer side of the frame.
    """

    index: int
    coverage: float
    cloud_coverage: float
    agreement: float
    shift_px: float
    longest_px: int


def outline_shift_px(mask: Floats, seen: Silhouette) -> NDArray[np.float64]:
    """Displacement [2] (right, down) that takes the cloud's outline nearest to the mask's [H, W].

    The signed distance of the mask's outline from the cloud's is the displacement along the normal, plus a
    constant (masks and clouds may be a bit wide): linear least squares, twice reweighted.
    """
    solid = (mask > 0.5).astype(np.uint8)
    outline = (solid > 0) & (cv2.erode(solid, np.ones((3, 3), np.uint8), borderValue=1) == 0)
    distance = cv2.GaussianBlur(seen.distance_px, (0, 0), 2.0)
    near = outline & (np.abs(distance) < 0.06 * max(mask.shape))
    if np.count_nonzero(near) < 50:
        return np.zeros(2)
    normal = [cv2.Sobel(distance, cv2.CV_32F, dx, 1 - dx, ksize=3)[near] / 8.0 for dx in (1, 0)]
    rows = np.stack([*normal, np.ones_like(normal[0])], axis=1).astype(np.float64)
    values = distance[near].astype(np.float64)
    weight = np.ones_like(values)
    solution = np.zeros(3)
    for _ in range(3):
        left = rows.T @ (weight[:, None] * rows) + 1e-6 * np.eye(3)
        solution = np.linalg.solve(left, rows.T @ (weight * values))
        residual = np.abs(values - rows @ solution)
        weight = 1.0 / (1.0 + (residual / 1.5) ** 2)
    return solution[:2]


def check(outcomes: Sequence[FrameOutcome]) -> None:
    """Refuses masks that say nothing.

    Raises:
        GeometryError: Most masks cover nothing or everything.
    """
    empty = sum(outcome.coverage < NOTHING for outcome in outcomes)
    full = sum(outcome.coverage > EVERYTHING for outcome in outcomes)
    if 2 * max(empty, full) <= len(outcomes):
        return
    if empty >= full:
        raise GeometryError(
            f"The masks of {empty} of {len(outcomes)} frames are empty: the cloud does not lie in these "
            "pictures; check that cloud and poses are in the same coordinates."
        )
    raise GeometryError(
        f"The masks of {full} of {len(outcomes)} frames cover the whole picture: subject and background "
        "cannot be told apart; film from further away, so that the head has some background around it."
    )


def report(
    outcomes: Sequence[FrameOutcome],
    separations: Sequence[float],
    keep: NDArray[np.bool_],
    subject: SubjectCloud,
    config: MaskConfig,
    seconds: float,
) -> dict[str, Any]:
    """Plain numbers for stages.json."""
    agreement = [outcome.agreement for outcome in outcomes]
    return {
        "frames": len(outcomes),
        "coverage": float(np.mean([outcome.coverage for outcome in outcomes])),
        "cloud_agreement": float(np.mean(agreement)),
        "cloud_agreement_worst": float(np.min(agreement)),
        "outline_shift_px": float(np.median([outcome.shift_px for outcome in outcomes])),
        "outline_shift_px_worst": float(np.max([outcome.shift_px for outcome in outcomes])),
        "flash_pairs": len(separations),
        "flash_separation": float(np.median(separations)) if separations else None,
        "points": len(keep),
        "points_of_subject": int(np.count_nonzero(subject.chosen)),
        "points_kept": int(np.count_nonzero(keep)),
        "network": bool(config.u2net),
        "config": asdict(config),
        "seconds": round(seconds, 3),
    }


def warnings(
    outcomes: Sequence[FrameOutcome],
    separations: Sequence[float],
    keep: NDArray[np.bool_],
    config: MaskConfig,
    flashes: Sequence[int | None],
) -> tuple[str, ...]:
    """What a user should know, one sentence each.

    Args:
        outcomes: Of all frames.
        separations: Of the lit frames with unlit neighbours.
        keep: [P] points kept.
        config: What was asked for.
        flashes: Flash flags of the frames.
    """
    sentences = []
    if config.flash:
        sentences += _flash_warnings(separations, flashes)
    empty = [outcome.index for outcome in outcomes if outcome.coverage < NOTHING]
    if empty:
        sentences.append(f"The subject is not in the picture of {_named(empty)}; their masks are empty.")
    full = [outcome.index for outcome in outcomes if outcome.coverage > EVERYTHING]
    if full:
        sentences.append(f"The masks of {_named(full)} cover the whole picture; they separate nothing.")
    moved = [o.index for o in outcomes if o.shift_px > MOVED_SHARE * o.longest_px]
    if moved:
        worst = max(outcome.shift_px for outcome in outcomes)
        sentences.append(
            f"The head lies up to {worst:.0f} px beside its cloud in {_named(moved)}: it moved, or these "
            "poses are off; masks follow the pictures, but a fit will blur there."
        )
    agreement = float(np.mean([outcome.agreement for outcome in outcomes]))
    if agreement < _DISAGREEMENT:
        sentences.append(
            f"Masks and cloud agree by {100 * agreement:.0f} % only (intersection over union): the cloud has "
            "large holes or pieces that are not the subject; look at the masks before you rely on them."
        )
    if len(keep) and keep.mean() < _FEWEST_KEPT:
        sentences.append(
            f"Only {100 * keep.mean():.0f} % of the cloud's points lie in the masks of the frames that have "
            "them in the picture; the others are taken for background."
        )
    return tuple(sentences)


def _flash_warnings(separations: Sequence[float], flashes: Sequence[int | None]) -> list[str]:
    alone = "the masks come from the cloud's outline, parallax and colours"
    for flash, name in ((1, "lit"), (0, "unlit")):
        if flash not in flashes:
            return [f"No frame is {name}, so the flash cannot tell the head from the room; {alone}."]
    if not separations:
        return [f"No lit frame has an unlit neighbour that looks from nearby; {alone}."]
    weak = sum(separation < LEAST_SEPARATION for separation in separations)
    if 2 * weak > len(separations):
        return [
            f"In {weak} of {len(separations)} lit frames the flash brightens head and background alike, so "
            "it cannot tell them apart there; film further from the walls, or with less light in the room."
        ]
    return []


def _named(indices: Sequence[int]) -> str:
    """Some frames, in words."""
    shown = ", ".join(map(str, indices[:5])) + (", ..." if len(indices) > 5 else "")
    return f"{len(indices)} {'frame' if len(indices) == 1 else 'frames'} ({shown})"
