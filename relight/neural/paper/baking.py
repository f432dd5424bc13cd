"""The network's maps brought into the points: what shadows, exports and reports read of a portrait.

The maps of some fitted frames are sampled at the points that these see and averaged, weighted by how squarely
a frame faces a point and how surely its pixel is the subject's. Points that none sees keep what the solve
found, in the scale of the network's albedo.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from relight.neural.paper.decoder import PaperDecoder
from relight.neural.paper.lighting import room_image
from relight.observations import sample_bilinear, visible_points
from relight.portrait import Portrait
from relight.reflectance import Reflectance
from relight.scene import View

_GRAZING = 0.15  # cosine under which a frame says nothing of a point
_SEEN = 0.05  # sum of weights from which a point has values of its own


def baked(
    solved: Portrait,
    decoder: PaperDecoder,
    c_room: torch.Tensor,
    c_flash: torch.Tensor,
    views: Sequence[View],
) -> Portrait:
    """The portrait of a decoder.

    Args:
        solved: From the photometric solve, of the same points.
        decoder: The network.
        c_room: [3].
        c_flash: [3].
        views: Frames to take the maps of.

    Returns:
        A portrait with the decoder. Its sigmas are what the frames disagree by; its reflectance is Lambert's
        under the flash and in the room, its flash where the lens is, as the paper has them.
    """
    points = solved.points
    weight = points.new_zeros(len(points))
    sums = points.new_zeros(len(points), 11)  # albedo, normal, shading, room radiance, squared albedo
    for view in views:
        maps = decoder.neural_maps(points, view.camera)
        uv_px, cosine, _ = visible_points(points, solved.normals_world, view.camera, solved.spacing)
        seen = (cosine > _GRAZING).nonzero()[:, 0]
        room = room_image(maps, c_room)
        layers = torch.cat([maps.albedo, maps.normals_world, maps.shading, room, maps.mask])
        samples = sample_bilinear(layers, uv_px[seen])
        share = cosine[seen] * samples[:, 10]
        squared = samples[:, :3].mean(dim=1, keepdim=True) ** 2
        sums.index_add_(0, seen, share[:, None] * torch.cat([samples[:, :10], squared], dim=1))
        weight.index_add_(0, seen, share)
    known = weight > _SEEN
    mean = sums / weight.clamp(min=_SEEN)[:, None]
    albedo, normal, shading, room, squared = mean.split([3, 3, 1, 3, 1], dim=1)
    length = torch.linalg.vector_norm(normal, dim=1)
    turned = known & (length > 0.1)  # frames that contradict each other leave the solve's
    spread = (squared[:, 0] - albedo.mean(dim=1) ** 2).clamp(min=0.0).sqrt()
    scale = _scale(albedo, solved.albedo, known)
    return replace(
        solved,
        albedo=torch.where(known[:, None], albedo, solved.albedo * scale),
        normals_world=torch.where(
            turned[:, None], normal / length.clamp(min=1e-6)[:, None], solved.normals_world
        ),
        shading=torch.where(known, shading[:, 0], solved.shading),
        room_radiance=torch.where(known[:, None], room, solved.room_radiance),
        albedo_sigma=torch.where(known, spread, solved.albedo_sigma),
        normal_sigma_rad=torch.where(
            turned, (2.0 * (1.0 - length).clamp(min=0.0)).sqrt(), solved.normal_sigma_rad
        ),
        c_room=_vector(c_room),
        c_flash=_vector(c_flash),
        flash_offset_cam_m=(0.0, 0.0, 0.0),
        reflectance=Reflectance(),
        flash_bounce=torch.zeros_like(solved.flash_bounce),  # it has no bounces
        bounce_scale=solved.bounce_scale / max(float(scale.mean()), 1e-3),
        room_gloss=None,
        decoder=decoder,
    )


def _scale(albedo: torch.Tensor, other: torch.Tensor, known: torch.Tensor) -> torch.Tensor:
    """[3] from the other albedo's scale to this one's, by the points that have both; 1 where none has."""
    ratios = (albedo / other.clamp(min=1e-3))[known]
    return ratios.median(dim=0).values if len(ratios) else albedo.new_ones(3)


def _vector(values: torch.Tensor) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z
