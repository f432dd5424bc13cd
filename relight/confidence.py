"""How far the pixels of a view can be believed, from what is known of the portrait's points.

    albedo_sigma       standard error of the albedo (mean of channels)
    normal_sigma       standard error of the normal, radians
    unobserved_flash   1 where no flash frame saw enough to know the albedo: it is taken from elsewhere
    unobserved_view    1 where no frame saw the surface at all: its shape is a guess too

Each pixel takes the values of a point seen in it. They are those of the points' fit whatever makes the maps,
so a network that sharpens or completes them is not credited with it.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch

from capture.cameras import Camera
from relight.maps import Maps
from relight.observations import visible_points
from relight.portrait import Portrait

NAMES = ("albedo_sigma", "normal_sigma", "unobserved_flash", "unobserved_view")

_KNOWN = 0.5  # of a point's confidence: with more its albedo comes from its own flash frames
_UNKNOWN_SIGMA = (
    1.0  # of pixels that no point is near: any albedo, any normal of the half that faces the view
)
_GRAZING = 0.1  # cosine below which a frame says little of a point: 84 degrees
_CAMERAS = 24  # neighbouring frames of a film see the same


def seen_by_any(portrait: Portrait, cameras: Sequence[Camera]) -> torch.Tensor:
    """Whether each point [P] bool is seen by one of some cameras, of which two dozen are looked through."""
    seen = torch.zeros_like(portrait.confidence, dtype=torch.bool)
    for camera in cameras[:: max(1, -(-len(cameras) // _CAMERAS))]:
        _, cosine, _ = visible_points(portrait.points, portrait.normals_world, camera, portrait.spacing)
        seen |= cosine > _GRAZING
    return seen


def confidence_maps(
    portrait: Portrait, maps: Maps, seen: torch.Tensor | None = None
) -> dict[str, torch.Tensor]:
    """Maps [H, W] by name, 0 off the subject.

    Args:
        portrait: The one that the maps are of.
        maps: Of a view.
        seen: [P] bool of `seen_by_any`; without it, or the cameras that it needs, points that any flash frame
            saw count as seen.
    """
    seen = portrait.confidence > 0 if seen is None else seen
    on, known = maps.mask > 0, maps.point_ids >= 0
    ids = maps.point_ids[on & known]
    of_points = {
        "albedo_sigma": (portrait.albedo_sigma, _UNKNOWN_SIGMA),
        "normal_sigma": (portrait.normal_sigma_rad, _UNKNOWN_SIGMA),
        "unobserved_flash": ((portrait.confidence < _KNOWN).to(maps.mask), 1.0),
        "unobserved_view": ((~seen).to(maps.mask), 1.0),
    }
    result = {}
    for name, (values, unknown) in of_points.items():
        image = torch.where(on, unknown, 0.0).to(maps.mask)
        image[on & known] = values[ids]
        result[name] = image
    return result
