"""A surface made to fit its own shading under the flash: heights, and so normals that are those of a surface.

With the lamp beside the lens and the camera on an arc, flash frames tell the slope along the arc well and the
slope across it hardly (`relight.photometric` leaves that to the cloud's normals). Two things say more of it:

- normals are the slopes of one surface (`relight.height_field`), so slopes that are known along the arc at
  neighbouring points tie those across it;
- gloss. Its lobe is steepest where a point nearly faces the lamp, in every direction, so where the normal
  tilts across the arc the highlight tells.

Each round makes the model linear about the current normals (Gauss-Newton), takes the albedo of each point out
of the problem, and solves for the heights of all points at once. The cloud speaks twice: its heights are
right to its noise, alike over centimetres, and its slopes are right but for features that smoothing took
away, which is why large corrections of them count for less (Cauchy).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch

from relight.height_field import HeightField, SlopeTerms
from relight.reflectance import GRAZING, Reflectance

_STEP = 1e-3  # of a cosine, for the reflectance's derivative
_FLOOR = 0.004  # albedo that is as good as black
_ALIKE = 180.0  # points of a smoothed cloud that share one error of height
_LEAST_NOISE = 0.1  # of a cloud, in spacings: what is moved by less cannot be told
_ROBUST = 2  # reweightings of a point's albedo
_STEEPEST = 1.0  # slope of a correction: beyond 45 degrees it is another surface
_CHUNK = 1 << 16


@dataclass(frozen=True)
class ShapeConfig:
    """How far the shading may change the cloud's surface.

    Attributes:
        slope_sigma: Standard deviation of the cloud's slopes about the truth, features included.
        bend_sigma: Standard deviation of the neighbours' height over a point's, in spacings: a surface is
            smooth.
        rounds: Of linearising and solving.
        iterations: Of conjugate gradients a round.
    """

    slope_sigma: float = 0.25
    bend_sigma: float = 0.05
    rounds: int = 4
    iterations: int = 40


@dataclass(frozen=True, eq=False)
class FlashResponses:
    """What the flash adds to P points in K frames, in units of the albedo (q of `relight.photometric`).

    Attributes:
        response: [K, P], mean of the channels.
        weight: [K, P], 0 where nothing was observed.
        to_light: [K, P, 3], unit, from the points.
        gloss: [P], factor on the reflectance's f0.
        noise: Standard deviation of a response relative to the albedo.
    """

    response: torch.Tensor
    weight: torch.Tensor
    to_light: torch.Tensor
    gloss: torch.Tensor
    noise: float


@dataclass(frozen=True, eq=False)
class RefinedShape:
    """The surface that fits.

    Attributes:
        points: [P, 3] moved along their normals.
        normals_world: [P, 3] unit.
        moved: [P], by how much, world units.
    """

    points: torch.Tensor
    normals_world: torch.Tensor
    moved: torch.Tensor


def refine_shape(
    points: torch.Tensor,
    normals_world: torch.Tensor,
    flash: FlashResponses,
    reflectance: Reflectance,
    *,
    spacing: float,
    cloud_noise: float,
    config: ShapeConfig = ShapeConfig(),
) -> RefinedShape:
    """Moves the points of a smooth cloud such that their shading under the flash is explained.

    Args:
        points: [P, 3], world.
        normals_world: [P, 3] unit, the cloud's own.
        flash: What was observed.
        reflectance: Of the subject.
        spacing: Of the points, world units.
        cloud_noise: Standard deviation of the cloud's heights, world units.
        config: See there.

    Returns:
        The shape; as given where no flash frame saw the points.
    """
    field = HeightField(points, normals_world, spacing)
    heights = torch.zeros_like(points[:, 0])
    normals = normals_world
    anchor = 1.0 / (_ALIKE * max(cloud_noise, _LEAST_NOISE * spacing) ** 2)
    for _ in range(config.rounds):
        slopes = field.slopes(heights)
        terms = _slope_terms(field, flash, reflectance, normals, slopes)
        trust = 1.0 / (1.0 + (slopes * slopes).sum(dim=0) / (2.0 * config.slope_sigma) ** 2)
        trust = trust / config.slope_sigma**2
        terms = SlopeTerms(terms.uu + trust, terms.uv, terms.vv + trust, terms.right)
        heights = field.fit(
            terms,
            anchor=anchor,
            bending=1.0 / config.bend_sigma**2,
            start=heights,
            iterations=config.iterations,
        )
        normals = field.normals(heights)
    # Where a correction is no small one it is no correction: edges of the cloud, where neighbours are few.
    sane = (field.slopes(heights) ** 2).sum(dim=0) < _STEEPEST**2
    normals = torch.where(sane[:, None], normals, normals_world)
    return RefinedShape(points + heights[:, None] * normals_world, normals, heights)


def _slope_terms(
    field: HeightField,
    flash: FlashResponses,
    reflectance: Reflectance,
    normals: torch.Tensor,
    slopes: torch.Tensor,
) -> SlopeTerms:
    """What the flash frames say of the slopes [2, P], linear about normals [P, 3] that have these slopes."""
    uu, uv, vv = (torch.empty_like(slopes[0]) for _ in range(3))
    right = torch.empty_like(slopes)
    for part in _chunks(len(normals)):
        cosine = (normals[part] * flash.to_light[:, part]).sum(dim=-1)
        diffuse, gloss = reflectance.diffuse(cosine), reflectance.gloss(cosine) * flash.gloss[part]
        matte = flash.response[:, part] - gloss
        weight = flash.weight[:, part] * (cosine > GRAZING) * cosine.clamp(min=0.0)
        robust = weight
        for _ in range(_ROBUST + 1):
            albedo = (robust * diffuse * matte).sum(dim=0) / (robust * diffuse**2).sum(dim=0).clamp(min=1e-6)
            spread = flash.noise * albedo.abs() + _FLOOR
            left = matte - albedo * diffuse
            robust = weight / (1.0 + (0.5 * left / spread) ** 2)
        precision = robust / spread**2
        # A slope along u tilts the normal against u; the cosine changes by as much of l as lies along u.
        slant = albedo * _derivative(reflectance.diffuse, cosine)
        slant = slant + flash.gloss[part] * _derivative(reflectance.gloss, cosine)
        by_u, by_v = (
            -slant * (flash.to_light[:, part] * axis[part]).sum(dim=-1) for axis in (field.u, field.v)
        )
        # The albedo is free: what it explains is no news of the slope (variable projection).
        own = (precision * diffuse * diffuse).sum(dim=0).clamp(min=1e-6)
        cross_u, cross_v = ((precision * diffuse * by).sum(dim=0) / own for by in (by_u, by_v))
        by_u, by_v = by_u - cross_u * diffuse, by_v - cross_v * diffuse
        uu[part], vv[part] = (precision * by_u**2).sum(dim=0), (precision * by_v**2).sum(dim=0)
        uv[part] = (precision * by_u * by_v).sum(dim=0)
        along_u, along_v = slopes[:, part]
        right[0, part] = (precision * by_u * left).sum(dim=0) + uu[part] * along_u + uv[part] * along_v
        right[1, part] = (precision * by_v * left).sum(dim=0) + uv[part] * along_u + vv[part] * along_v
    return SlopeTerms(uu, uv, vv, right)


def _derivative(curve: Callable[[torch.Tensor], torch.Tensor], cosine: torch.Tensor) -> torch.Tensor:
    return (curve(cosine + _STEP) - curve(cosine - _STEP)) / (2.0 * _STEP)


def _chunks(count: int) -> Iterator[slice]:
    for start in range(0, count, _CHUNK):
        yield slice(start, min(start + _CHUNK, count))
