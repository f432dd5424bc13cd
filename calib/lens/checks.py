"""When views of a board do not tell the lens: refused with the reason, or told with a warning."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.errors import IntrinsicsError
from calib.lens.bundle import BEND, Observations, Solution
from calib.lens.cross_validation import HalvesCheck
from calib.lens.projection import fold_radius
from calib.lens.uncertainty import Uncertainty

Floats = NDArray[np.float64]

#: Fewest different views: with fewer, a single bad one moves everything and nothing is left to check with.
FEWEST_VIEWS = 8
_GOOD_VIEWS = 15
# Between the two directions from which the board was seen that differ most. At less, perspective is so weak
# that nearer and longer look the same; 60 to 90 degrees is what one gets when told to tilt.
_SMALLEST_SPREAD_DEG, _GOOD_SPREAD_DEG = 12.0, 40.0
# Share of the picture within the convex hull of all corners.
_SMALLEST_COVER, _GOOD_COVER = 0.25, 0.7
# Standard deviations beyond which a calibration is worth less than the guess from the field of view: of the
# focal length, relative, and of the centre, relative to the picture's diagonal.
_LARGEST_FOCAL_SIGMA, _LARGEST_CENTRE_SIGMA = 0.01, 0.01
# Residuals of a board that fits: a tenth of a pixel, a few tenths in poor light. Relative to the diagonal.
_LARGEST_RMS = 1.5e-3
_POSSIBLE_FOCALS = (0.1, 40.0)  # of the longer side
_CLEAR_CORRELATION = 2.0
_LARGE_BEND = 0.01  # of the board's longer side

_TILT = (
    "show it tilted by 30 to 45 degrees to the left, the right, upwards and downwards, near enough to fill "
    "half "
    "of the picture"
)


def normals_spread_deg(solution: Solution) -> float:
    """Largest angle between the directions in which the board faces in two views, degrees."""
    normals = solution.rotations[:, :, 2]
    cosine = np.clip((normals @ normals.T).min(), -1.0, 1.0)
    return float(np.degrees(np.arccos(cosine)))


def covered_share(observations: Observations) -> float:
    """Area of the convex hull of all corners, of the picture's."""
    corners = observations.pixels[observations.seen].astype(np.float32)
    width, height = observations.size
    return float(cv2.contourArea(cv2.convexHull(corners))) / (width * height)


def check_poses(observations: Observations, solution: Solution) -> None:
    """Refuses views from one direction, or of one part of the picture.

    Raises:
        IntrinsicsError: so they are.
    """
    focal = solution.lens[:2] / max(observations.size)
    spread = normals_spread_deg(solution) if np.isfinite(solution.rotations).all() else 0.0
    if (
        spread < _SMALLEST_SPREAD_DEG
        or not ((focal > _POSSIBLE_FOCALS[0]) & (focal < _POSSIBLE_FOCALS[1])).all()
    ):
        raise IntrinsicsError(
            f"All pictures show the board from nearly the same direction (within {spread:.0f} degrees; at "
            "least "
            f"{_SMALLEST_SPREAD_DEG:.0f} are needed), so the focal length cannot be told from the distance: "
            f"{_TILT}."
        )
    share = covered_share(observations)
    if share < _SMALLEST_COVER:
        corners = observations.pixels[observations.seen]
        (left, top), (right, bottom) = corners.min(0), corners.max(0)
        raise IntrinsicsError(
            f"The board was always in one part of the picture (columns {left:.0f} to {right:.0f}, rows "
            f"{top:.0f} "
            f"to {bottom:.0f}: {share:.0%}, at least {_SMALLEST_COVER:.0%} are needed), so the lens is "
            "unknown "
            "elsewhere; bring it nearer and into every corner of the picture."
        )


def check_fit(observations: Observations, solution: Solution) -> None:
    """Refuses corners that no lens explains.

    Raises:
        IntrinsicsError: so they are.
    """
    rms = float(np.sqrt((solution.residuals**2).sum() / (2 * observations.seen.sum())))
    limit = _LARGEST_RMS * float(np.hypot(*observations.size))
    if not rms <= limit:
        raise IntrinsicsError(
            f"The corners lie {rms:.2f} px from where any lens would put them (limit {limit:.2f} px); the "
            "board "
            "is not flat, its description is wrong, or the camera focuses, zooms or stabilises while it "
            "films: "
            "fix the board to a plate and lock the lens."
        )


def check_determined(observations: Observations, solution: Solution, uncertainty: Uncertainty) -> None:
    """Refuses a lens that the views leave open.

    Raises:
        IntrinsicsError: focal length or centre are too uncertain, or the model folds inside the board.
    """
    sigma = np.sqrt(np.diag(uncertainty.covariance))
    focal = solution.lens[:2]
    uncertain = not (sigma[:2] <= _LARGEST_FOCAL_SIGMA * focal).all()
    if uncertain and uncertainty.correlation_factor > _CLEAR_CORRELATION:
        raise IntrinsicsError(
            f"The pictures contradict each other: the focal length is {focal.mean():.0f} px to within "
            f"{sigma[:2].max():.0f} px (limit {_LARGEST_FOCAL_SIGMA:.0%}), far more than the corners' noise "
            f"of {uncertainty.noise_px:.2f} px explains. The squares are not square (printed to fit the "
            "page?), the "
            "board is not flat, or the camera focuses, zooms or stabilises while it films."
        )
    if uncertain:
        raise IntrinsicsError(
            f"The focal length is {focal.mean():.0f} px with an uncertainty of {sigma[:2].max():.0f} px "
            "(limit "
            f"{_LARGEST_FOCAL_SIGMA:.0%}): the pictures hardly tell it from the distance. The board was seen "
            f"within {normals_spread_deg(solution):.0f} degrees; {_TILT}."
        )
    limit_px = _LARGEST_CENTRE_SIGMA * float(np.hypot(*observations.size))
    if not (sigma[2:4] <= limit_px).all():
        raise IntrinsicsError(
            f"The centre of the picture is uncertain by {sigma[2:4].max():.0f} px (limit {limit_px:.0f} px): "
            f"{_TILT}, and turn the camera on its side for some."
        )
    points = observations.corners_m @ np.swapaxes(solution.rotations, 1, 2) + solution.translations_m[:, None]
    tangent = np.linalg.norm(points[..., :2], axis=-1) / points[..., 2]
    if float(tangent[observations.seen].max()) > fold_radius(solution.lens):
        raise IntrinsicsError(
            "The distortion that fits folds the picture over itself within the board; the lens is wider than "
            "this model can follow (a fisheye), or wrong corners were found: use the camera's main lens."
        )


def warnings_of(
    observations: Observations,
    solution: Solution,
    uncertainty: Uncertainty,
    halves: Sequence[HalvesCheck],
    dropped: int,
) -> list[str]:
    """What a person should know of a calibration that is not refused."""
    sentences = []
    count = len(observations.pixels)
    if count < _GOOD_VIEWS:
        sentences.append(f"Only {count} views were used; {_GOOD_VIEWS} or more are good.")
    if (spread := normals_spread_deg(solution)) < _GOOD_SPREAD_DEG:
        sentences.append(f"The board was tilted little (within {spread:.0f} degrees); {_TILT}.")
    if (share := covered_share(observations)) < _GOOD_COVER:
        sentences.append(
            f"The corners cover {share:.0%} of the picture; outside of them the lens is extrapolated."
        )
    if dropped:
        sentences.append(f"{dropped} pictures were left out because they fit no lens that fits the others.")
    if uncertainty.correlation_factor > _CLEAR_CORRELATION:
        sentences.append(
            "The errors of a picture hang together (a board that is not flat or that moves, or a "
            "stabiliser); the uncertainties were made "
            f"{np.sqrt(uncertainty.correlation_factor):.1f} times as large for it. Stills of a board at "
            "rest, on a plate, do better."
        )
    for check in halves:
        if not check.agrees:
            sentences.append(
                f"Two calibrations ({check.split}) differ by {check.rms_px:.2f} px where "
                f"{check.expected_px:.2f} px are expected: the lens moved, or the model does not follow it. "
                "The "
                "uncertainties were made as large as that shows."
            )
    across_m = float(np.ptp(observations.corners_m[:, :2], axis=0).max())
    bend_m = float(np.abs(solution.shared[list(BEND)]).max())
    if bend_m > _LARGE_BEND * across_m:
        sentences.append(f"The board is bent by {bend_m * 1e3:.1f} mm; fix it to a plate.")
    return sentences
