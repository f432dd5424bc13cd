"""Whether what was found is a face: the reason why a face prior is used or dropped."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from relight.face.frame import HeadFrame
from relight.face.symmetry import Symmetry

# Between what heads give (agreement 0.69 and more, rival 0.7 and less, nose 0.08 and more, sigma 0.6 degrees
# and less; with noise, outliers, one side cut off) and what balls, vases, boxes and rocks do.
_LEAST_AGREEMENT = 0.5
_MOST_RIVAL = 0.85
_LEAST_OVERLAP = 0.3
_MOST_SIGMA_DEG = 2.5
_LEAST_NOSE = 0.04


@dataclass(frozen=True)
class FaceDecision:
    """What becomes of the face prior.

    Attributes:
        found: Whether there is a face to rely on.
        reason: For a person, one sentence without its full stop.
    """

    found: bool
    reason: str


def decide(symmetry: Symmetry | None, frame: HeadFrame | None) -> FaceDecision:
    """Judges a plane of symmetry and the head's frame on it.

    Args:
        symmetry: None = the cloud was too small to look for one.
        frame: None = not looked for.
    """
    if symmetry is None:
        return FaceDecision(False, "the cloud has too few points with normals to look for a face")
    if symmetry.agreement < _LEAST_AGREEMENT:
        return FaceDecision(
            False,
            f"nothing here is symmetric as a face is: at best {symmetry.agreement:.0%} of the surface "
            f"agrees with its mirror image (at least {_LEAST_AGREEMENT:.0%} is needed)",
        )
    if symmetry.overlap < _LEAST_OVERLAP:
        return FaceDecision(
            False,
            f"only {symmetry.overlap:.0%} of the surface was seen on both sides of its mirror plane (at "
            f"least {_LEAST_OVERLAP:.0%} is needed); film the other half of the face too",
        )
    if symmetry.rival > _MOST_RIVAL:
        return FaceDecision(
            False,
            "the subject is symmetric about many planes, as a ball or a vase is: another plane agrees "
            f"{symmetry.rival:.0%} as well as the best (at most {_MOST_RIVAL:.0%} on a face)",
        )
    if np.degrees(symmetry.sigma_rad) > _MOST_SIGMA_DEG:
        return FaceDecision(
            False,
            f"the plane of symmetry is known to {np.degrees(symmetry.sigma_rad):.1f} degrees only (limit "
            f"{_MOST_SIGMA_DEG:g}); the cloud is too coarse or the two halves too different",
        )
    if frame is None or frame.nose_height < _LEAST_NOSE:
        height = 0.0 if frame is None else frame.nose_height
        return FaceDecision(
            False,
            f"the subject is symmetric but has no nose: its middle stands out by {height:.1%} of its breadth "
            f"(at least {_LEAST_NOSE:.0%} on a face), as of a helmet or a box",
        )
    return FaceDecision(
        True,
        f"a face was found: {symmetry.agreement:.0%} of the surface agrees with its mirror image, the plane "
        f"is known to {np.degrees(symmetry.sigma_rad):.1f} degrees",
    )
