"""Metres for a reconstruction whose unit is unknown, with where they come from and how far to trust them.

Poses and points from pictures alone have no size. In the order of trust:

- a board or marker of known size fixes the unit while the poses are found, and is no business of this module;
- a flash some centimetres beside the lens, at a known place (`relight.scale_from_flash`);
- a typical adult head: its breadth above the ears and the face's breadth before them, against those of a
  population. Hair makes a head wider, so where the sides are not of the face's albedo only the face counts;
- nothing: the cameras are taken to be at a phone's usual distance.

The population is that of ANSUR II (Gordon et al. 2014, "2012 Anthropometric Survey of U.S. Army Personnel:
Methods and Summary Statistics", NATICK/TR-15/007; 6,068 men and women): head breadth 152.2 mm, standard
deviation 6.2; bizygomatic breadth 139.7 mm, standard deviation 7.3. British adults have head breadths of 155
(men) and 145 mm (women), standard deviation 6 each; those of Hong Kong 160 and 150 (Pheasant, "Bodyspace").
Children are smaller: say the size where it matters.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture.cameras import Camera
from relight.face.frame import HeadFrame
from relight.face.head import HeadFound, find_head
from relight.face.plane import Floats
from relight.face.samples import Samples
from relight.scale_from_flash import FlashSamples, scale_from_flash

CAMERA_DISTANCE_M = 0.55
"""Distance from camera to head that a phone is held at, where nothing else is known."""

FALLBACK_SIGMA = 0.3
MOST_FLASH_SIGMA = 0.12
"""A scale from the flash that is known no better than this says less than a head."""

_HEAD_M, _HEAD_SIGMA_M = 0.1522, 0.0062
_FACE_M, _FACE_SIGMA_M = 0.1397, 0.0073
_CORRELATION = 0.74  # of the two breadths
_POPULATION = 1.3  # soldiers vary less than people
_MEASURED = 0.03  # relative: how well a breadth is taken from a cloud
_HEAD_LEVELS = (0.42, 0.78)  # breadths above the tip of the nose: over the ears, under the vault's curve
_FACE_LEVELS = (0.0, 0.35)
_FACE_DEPTHS = (0.08, 0.4)  # breadths before the head's axis: ears begin behind
_LATERAL = 0.9
_SKIN = (0.5, 2.0)  # albedo of the sides over the face's
_FEWEST = 12


@dataclass(frozen=True)
class Scale:
    """What a unit of the reconstruction is.

    Attributes:
        metres_per_unit: Multiply lengths by it.
        sigma_relative: Its standard error.
        source: "flash", "head" or "distance".
        reason: For a person, one sentence without its full stop.
    """

    metres_per_unit: float
    sigma_relative: float
    source: str
    reason: str

    def as_json(self) -> dict[str, Any]:
        """For a report."""
        return asdict(self)


@dataclass(frozen=True)
class HeadSize:
    """A head's measures in the unit of the reconstruction.

    Attributes:
        head_breadth: Above the ears; None where hair hides it or it was not seen.
        face_breadth: Before the ears; None where it was not seen.
    """

    head_breadth: float | None
    face_breadth: float | None


def find_scale(
    points: Floats,
    normals_world: Floats,
    albedo: Floats | None,
    cameras: Mapping[int, Camera],
    *,
    flash: FlashSamples | None = None,
    flash_offset_cam_m: Floats | None = None,
    head: HeadFound | None = None,
    confidence: Floats | None = None,
    rotation_deg: int = 0,
) -> Scale:
    """The best scale that there is.

    Args:
        points: [P, 3] of the subject (masks applied), in the reconstruction's unit.
        normals_world: [P, 3] unit, outwards.
        albedo: [P, 3] linear, or None: then hair cannot be told from skin.
        cameras: By frame index.
        flash: What the flash adds, from `relight.scale_from_flash.flash_samples`; None = not tried.
        flash_offset_cam_m: [3] lens to flash in camera axes, metres, as calibrated; None = not known.
        head: From an earlier `find_head`; None = looked for here.
        confidence: [P] 0..1, how far the albedo is known.
        rotation_deg: Clockwise turn that makes the pictures upright.

    Raises:
        ValueError: There are no cameras, or no finite point.
    """
    points = np.asarray(points, np.float64)
    if not cameras or not np.isfinite(points).all(axis=1).any():
        raise ValueError("a scale needs cameras and points")
    head = head or find_head(
        points,
        np.asarray(normals_world, np.float64),
        None if albedo is None else np.asarray(albedo, np.float64),
        cameras,
        confidence,
        rotation_deg,
    )
    choice = _from_head(head)
    if choice is None:
        choice = _from_distance(points, cameras, head)
    if flash is not None and flash_offset_cam_m is not None:
        seen = scale_from_flash(flash, flash_offset_cam_m, choice.metres_per_unit)
        if seen is not None and seen.sigma_relative < min(MOST_FLASH_SIGMA, choice.sigma_relative):
            offset_mm = 1000.0 * float(np.linalg.norm(flash_offset_cam_m))
            choice = Scale(
                seen.metres_per_unit,
                seen.sigma_relative,
                "flash",
                f"the flash is known to be {offset_mm:.0f} mm from the lens, {seen.offset_share:.0%} of the "
                "distance, which shows in the shading",
            )
        elif seen is not None:
            why = "too near to the lens" if math.isinf(seen.sigma_relative) else "seen too weakly"
            error = "" if math.isinf(seen.sigma_relative) else f" (± {seen.sigma_relative:.0%})"
            choice = Scale(
                choice.metres_per_unit,
                choice.sigma_relative,
                choice.source,
                f"{choice.reason}; the flash's known offset is {why} to tell more{error}",
            )
    return choice


def head_size(samples: Samples, frame: HeadFrame) -> HeadSize:
    """Breadths of a head in the unit of its cloud.

    Args:
        samples: Of the head.
        frame: Of the head.
    """
    local, turned = frame.local(samples.points), samples.normals @ frame.axes.T
    level = np.ones(len(local)) if samples.albedo is None else samples.albedo.mean(axis=1)
    front = (np.abs(local[:, 0]) < 0.35) & (np.abs(local[:, 1]) < 0.25) & (local[:, 2] > 0.2)
    skin = float(np.median(level[front])) if front.any() else 1.0
    ratio = level / max(skin, 1e-9)
    is_skin = (ratio > _SKIN[0]) & (ratio < _SKIN[1])
    lateral = np.abs(turned[:, 0]) > _LATERAL
    height, depth = local[:, 1], local[:, 2]
    before_ears = (height > _FACE_LEVELS[0]) & (height < _FACE_LEVELS[1])
    before_ears &= (depth > _FACE_DEPTHS[0]) & (depth < _FACE_DEPTHS[1]) & lateral & is_skin
    face = _reach(local[before_ears, 0], 85.0)
    widest = None
    for low in np.arange(_HEAD_LEVELS[0], _HEAD_LEVELS[1], 0.04):
        here = (height >= low) & (height < low + 0.06)
        sides = here & lateral
        if sides.sum() >= _FEWEST and is_skin[sides].mean() > 0.5:
            reach = _reach(local[here, 0], 97.0)
            widest = reach if widest is None or (reach is not None and reach > widest) else widest
    breadth = frame.breadth
    return HeadSize(
        None if widest is None else 2.0 * widest * breadth, None if face is None else 2.0 * face * breadth
    )


def _reach(across: NDArray[np.float64], percentile: float) -> float | None:
    """Distance from the plane that a percentile of the points stays within: of the side seen further out."""
    sides = [across[across * sign > 0] * sign for sign in (-1, 1)]
    reaches = [float(np.percentile(side, percentile)) for side in sides if len(side) >= _FEWEST]
    return max(reaches) if reaches else None


def _from_head(head: HeadFound) -> Scale | None:
    if not head.decision.found or head.frame is None or head.samples is None:
        return None
    size = head_size(head.samples, head.frame)
    logs, sigmas, words = [], [], []
    for name, value, mean, sigma in (
        ("head breadth", size.head_breadth, _HEAD_M, _HEAD_SIGMA_M),
        ("face breadth", size.face_breadth, _FACE_M, _FACE_SIGMA_M),
    ):
        if value is not None and value > 0:
            logs.append(math.log(mean / value))
            sigmas.append(math.hypot(_POPULATION * sigma / mean, _MEASURED))
            words.append(f"{name} {1000 * mean:.0f} mm")
    if not logs:
        return None
    covariance = np.diag(np.square(sigmas))
    if len(logs) == 2:
        covariance[0, 1] = covariance[1, 0] = _CORRELATION * sigmas[0] * sigmas[1]
    weight = np.linalg.inv(covariance).sum(axis=1)
    weight = np.maximum(weight, 0.0) / np.maximum(weight, 0.0).sum()
    sigma = float(np.sqrt(weight @ covariance @ weight))
    if len(logs) == 2:  # a head that contradicts itself is no typical one, or was badly measured
        sigma = math.hypot(sigma, 0.5 * abs(logs[0] - logs[1]))
    return Scale(
        float(np.exp(weight @ np.array(logs))),
        sigma,
        "head",
        f"the head is taken for a typical adult's ({' and '.join(words)})",
    )


def _from_distance(points: Floats, cameras: Mapping[int, Camera], head: HeadFound) -> Scale:
    middle = np.median(points[np.isfinite(points).all(axis=1)], axis=0)
    distances = [float(np.linalg.norm(camera.centre_world - middle)) for camera in cameras.values()]
    distance = max(float(np.median(distances)), 1e-12)
    why = "" if head.decision.found else f", for there is no head to measure: {head.decision.reason}"
    return Scale(
        CAMERA_DISTANCE_M / distance,
        FALLBACK_SIGMA,
        "distance",
        f"the cameras are taken to be {CAMERA_DISTANCE_M:g} m from the subject{why}",
    )
