"""How far the solve's normals and albedos can be believed.

Two things make frames say less than their number. What the model leaves is no noise: a highlight, a bounce or
a fold errs alike in frames whose light comes from about the same side. And a cloud is smooth: where a surface
bends within the reach of its smoothing, folds have been rounded, of which no frame's residual need tell.
"""

from __future__ import annotations

import math

import torch
from scipy.spatial import cKDTree

from relight.flash_part import FlashPart
from relight.reflectance import Reflectance

_AROUND = 25  # points that a cloud's smoothing ties together
_ROUNDED = 1.5  # error of a normal over what it differs by from the mean about it; 1 to 2 on heads with truth


def standard_errors(
    points: torch.Tensor,
    normals: torch.Tensor,
    albedo: torch.Tensor,
    sigma: torch.Tensor,
    information: torch.Tensor,
    flash: FlashPart,
    reflectance: Reflectance,
    relative: float,
    prior_sigma_rad: float,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Of the normals, radians, and of the albedos' means over the channels, [P] each.

    Args:
        points: [P, 3], world.
        normals: [P, 3] unit.
        albedo: [P, 3] in the units of the flash's responses.
        sigma: [P] standard error of its mean, were all frames independent.
        information: [P] sum over the frames of weights times squared cosines.
        flash: What the flash frames show.
        reflectance: Of the subject.
        relative: Standard deviation of a response relative to the albedo.
        prior_sigma_rad: Standard error of the cloud's normals.
    """
    alike = _alike(flash, reflectance)
    # A cosine c changes by sin per radian: tangential information is that of the frames times about tan^2 =
    # 0.5.
    photometric = 0.5 * information / alike / relative**2
    of_normal = 1.0 / (1.0 / prior_sigma_rad**2 + photometric) + (_ROUNDED * _bend_rad(points, normals)) ** 2
    # An error of the normal is one of the cosine, by the tangent, whose square is about 0.5, and so of the
    # albedo.
    of_albedo = sigma**2 * alike + 0.5 * of_normal * albedo.mean(dim=1) ** 2
    return of_normal.sqrt(), of_albedo.sqrt()


def _alike(flash: FlashPart, reflectance: Reflectance) -> torch.Tensor:
    """How many of the flash frames that see a point say the same of it [P], at least 1.

    What the model leaves is no noise: a highlight, a bounce or a fold errs alike in frames whose light comes
    from about the same side. They count for one within the width of the subject's gloss, which is the
    narrowest of these.
    """
    lit = flash.weight.sum(dim=1, keepdim=True).clamp(min=1e-9)
    directions = (flash.weight[..., None] * flash.to_light).sum(dim=1) / lit
    directions = torch.nn.functional.normalize(directions, dim=1)
    angle = torch.acos((directions @ directions.T).clamp(-1.0, 1.0)).fill_diagonal_(0.0)
    share = torch.exp(-0.5 * (angle / math.atan(reflectance.alpha)) ** 2)
    frames = (flash.weight**2).sum(dim=0)
    return (((share @ flash.weight) * flash.weight).sum(dim=0) / frames.clamp(min=1e-9)).clamp(min=1.0)


def _bend_rad(points: torch.Tensor, normals: torch.Tensor) -> torch.Tensor:
    """Angle between each point's normal and the mean of those about it, radians [P].

    On a sphere, whose normals turn evenly, it is 0: smoothing a slope leaves it as it is.
    """
    count = min(_AROUND, len(points))
    places = points.cpu().numpy()
    _, near = cKDTree(places).query(places, k=list(range(1, count + 1)), workers=-1)
    total = torch.zeros_like(normals)
    for k in range(count):
        total += normals[torch.from_numpy(near[:, k]).to(points.device)]
    across = torch.linalg.vector_norm(torch.linalg.cross(normals, total), dim=1)
    return torch.atan2(across, (normals * total).sum(dim=1))
