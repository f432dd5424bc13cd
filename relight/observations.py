"""What every point of the surface looks like in every frame that sees it.

`relight.occlusion` tells which points a frame sees.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from capture.cameras import Camera
from relight.cloud import SurfaceCloud
from relight.occlusion import Sight
from relight.scene import Scene
from relight.stages import Progress, no_progress

_GRAZING = 0.1  # cosine below which a frame says little of a point: 84 degrees
_MASK_MARGIN_PX = 1  # at the edge of the mask a pixel mixes subject and background


@dataclass(frozen=True, eq=False)
class Observations:
    """Samples of P points in K frames.

    Attributes:
        radiance: [K, P, 3] float32, linear; 0 where there is none.
        cosine: [K, P] float32, between normal and direction to the camera; 0 where the frame does not see
            the point, or sees it clipped or outside the mask.
        flash: [K] bool.
        flash_position_world: [K, 3].
        view_direction_world: [K, 3], unit, from the middle of the points to the camera.
        flash_axis_world: [K, 3] unit, where the flash is strongest.
        flash_falloff: mu of cos(angle to the axis)^mu.
        variance: [K, P] float32, of the noise of the channels' mean; None = no noise model is known.
        outside: [P] float32, share of the frames with a mask, of those that have the point in the picture,
            in which it lies outside the mask: what is off the subject in a frame is not the subject,
            whether seen or hidden.
    """

    radiance: torch.Tensor
    cosine: torch.Tensor
    flash: torch.Tensor
    flash_position_world: torch.Tensor
    view_direction_world: torch.Tensor
    outside: torch.Tensor
    flash_axis_world: torch.Tensor
    flash_falloff: float = 0.0
    variance: torch.Tensor | None = None


def observe_points(scene: Scene, surface: SurfaceCloud, progress: Progress = no_progress) -> Observations:
    """Samples all frames of a scene at the points that they see (bilinear, pixel centres at 0.5)."""
    points = torch.from_numpy(surface.points).to(scene.device)
    normals = torch.from_numpy(surface.normals_world).to(scene.device)
    count, total = len(scene.views), len(points)
    radiance = points.new_zeros(count, total, 3)
    cosine = points.new_zeros(count, total)
    variance: torch.Tensor | None = None
    off, in_picture = points.new_zeros(total), points.new_zeros(total)
    for k, view in enumerate(scene.views):
        observation = scene.observe(view)
        uv_px, slant, inside = visible_points(points, normals, view.camera, surface.spacing)
        # What is no measurement may be anything, and of NaN a thousandth in the bilinear sum is NaN as well.
        measured = observation.radiance.where(observation.valid[..., None] > 0, 0.0)
        layers = [measured.permute(2, 0, 1), observation.valid[None]]
        if observation.mask is not None:
            layers.append(_eroded(observation.mask)[None])
        trusted_until = len(layers) + 2
        if observation.variance is not None:
            layers.append(observation.variance.where(observation.valid > 0, 0.0)[None])
            variance = cosine.new_zeros(count, total) if variance is None else variance
        seen = (slant > _GRAZING).nonzero()[:, 0]
        samples = sample_bilinear(torch.cat(layers), uv_px[seen])
        # A clipped or masked neighbour in the bilinear sum already makes it wrong.
        trusted = (samples[:, 3:trusted_until] > 0.999).all(dim=1)
        radiance[k, seen] = torch.where(trusted[:, None], samples[:, :3], 0.0)
        cosine[k, seen] = torch.where(trusted, slant[seen], 0.0)
        if variance is not None:
            variance[k, seen] = samples[:, -1]
        if observation.mask is not None:
            coverage = sample_bilinear(_dilated(observation.mask)[None], uv_px)[:, 0]
            off += inside & (coverage < 0.5)
            in_picture += inside
        progress("observe", (k + 1) / count)
    poses = [view.camera.cam_from_world for view in scene.views]
    offset = np.asarray(scene.flash_offset_cam_m, np.float64)
    flash_positions = torch.stack(
        [
            torch.from_numpy(view.camera.centre_world + view.camera.cam_from_world[:3, :3].T @ offset)
            for view in scene.views
        ]
    )
    axes = torch.stack([torch.from_numpy(scene.lamp.axis_world(pose)) for pose in poses])
    centres = torch.stack([torch.as_tensor(view.camera.centre_world) for view in scene.views]).to(points)
    return Observations(
        radiance=radiance,
        cosine=cosine,
        flash=torch.tensor([view.flash == 1 for view in scene.views], device=scene.device),
        flash_position_world=flash_positions.to(points),
        view_direction_world=torch.nn.functional.normalize(centres - points.mean(dim=0), dim=1),
        outside=off / in_picture.clamp(min=1.0),
        flash_axis_world=axes.to(points),
        flash_falloff=scene.lamp.falloff,
        variance=variance,
    )


def visible_points(
    points: torch.Tensor, normals: torch.Tensor, camera: Camera, spacing: float, *, cell: float = 4.8
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Where points project and how they face a camera that sees them.

    Args:
        points: [P, 3], world.
        normals: [P, 3], unit, world.
        camera: Without distortion.
        spacing: Of the points, world units.
        cell: As for `Sight`.

    Returns:
        uv_px [P, 2]; cosine [P] between the normal and the direction to the camera, 0 where the point is
        hidden, turned away or outside the picture; inside [P] bool, whether it projects into the picture at
        all.
    """
    sight = Sight(points, normals, camera, spacing, cell)
    facing = (sight.cosine > 0).nonzero()[:, 0]
    seen = facing[sight.unhidden(facing)]
    cosine = torch.zeros_like(sight.cosine)
    cosine[seen] = sight.cosine[seen]
    return sight.uv_px, cosine, sight.inside


def sample_bilinear(image: torch.Tensor, uv_px: torch.Tensor) -> torch.Tensor:
    """Values [P, C] of an image [C, H, W] at pixel positions [P, 2], centres at 0.5, the border repeated
    outside."""
    height, width = image.shape[1:]
    grid = uv_px / uv_px.new_tensor([width, height]) * 2.0 - 1.0
    return torch.nn.functional.grid_sample(
        image[None], grid[None, None], mode="bilinear", padding_mode="border", align_corners=False
    )[0, :, 0].T


def _eroded(mask: torch.Tensor) -> torch.Tensor:
    """1 where the mask is full in a neighbourhood, below 1 elsewhere."""
    full = (mask >= 0.99).float()[None, None]
    return -torch.nn.functional.max_pool2d(-full, 2 * _MASK_MARGIN_PX + 1, 1, _MASK_MARGIN_PX)[0, 0]


def _dilated(mask: torch.Tensor) -> torch.Tensor:
    return torch.nn.functional.max_pool2d(mask[None, None], 3, 1, 1)[0, 0]
