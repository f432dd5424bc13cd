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

What the model cannot explain of a point (hair, which is no surface; light from other parts of the subject) is
that point's own noise: its residual tells how much its frames are to be believed.

Only the normals are to be believed. Slopes that err alike over a centimetre sum up to heights that err by
more than the cloud does: points that follow them blur outlines and pictures.

Corrections are found on a quarter of the points first: what is wide travels from neighbour to neighbour, and
there in half as many steps of a quarter of the cost.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree

from relight.height_field import HeightField, SlopeTerms
from relight.reflectance import GRAZING, Reflectance

_STEP = 1e-3  # of a cosine, for the reflectance's derivative
_FLOOR = 0.004  # albedo that is as good as black
_ALIKE = 60.0  # points of a smoothed cloud that share one error of height: half of a smoothing disc
_LEAST_NOISE = 0.1  # of a cloud, in spacings: what is moved by less cannot be told
_ROBUST = 2  # reweightings of a point's albedo
_SHARED = 2.0  # points that share one error of a picture: they lie closer than pixels, sampled between four
_USUAL = 4.0  # frames whose word the subject's noise counts for in a point's own
_COARSE = 2.0  # spacing of the points to begin with, in spacings
_FEWEST = 4000  # points for which a coarse start is worth its while
_SPREAD = 4  # coarse points that a point has its first height from
_STEEPEST = 1.0  # slope of a correction: beyond 45 degrees it is another surface
_CHUNK = 1 << 16


@dataclass(frozen=True)
class ShapeConfig:
    """How far the shading may change the cloud's surface.

    Attributes:
        slope_sigma: Standard deviation of the cloud's slopes about the truth, features included.
        bend_sigma: Standard deviation of the neighbours' height over a point's, in spacings: a surface is
            smooth.
        coarse_rounds: Of linearising and solving, on a quarter of the points.
        coarse_iterations: Of conjugate gradients in each of them.
        rounds: On all points.
        iterations: In each of them.
    """

    slope_sigma: float = 0.25
    bend_sigma: float = 0.05
    coarse_rounds: int = 3
    coarse_iterations: int = 40
    rounds: int = 2
    iterations: int = 20


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

    def of(self, some: torch.Tensor) -> FlashResponses:
        """Those of some of the points, [N] indices."""
        return FlashResponses(
            self.response[:, some], self.weight[:, some], self.to_light[:, some], self.gloss[some], self.noise
        )


@dataclass(frozen=True, eq=False)
class RefinedShape:
    """The surface that fits.

    Attributes:
        normals_world: [P, 3] unit.
        heights: [P], world units, over the cloud's points along its normals.
    """

    normals_world: torch.Tensor
    heights: torch.Tensor


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
    """Heights over a smooth cloud, and their normals, such that the shading under the flash is explained.

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
    anchor = 1.0 / (_ALIKE * max(cloud_noise, _LEAST_NOISE * spacing) ** 2)
    heights = torch.zeros_like(points[:, 0])
    if len(points) >= _FEWEST and config.coarse_rounds > 0:
        few = _thinned(points, _COARSE * spacing)
        coarse = HeightField(points[few], normals_world[few], _COARSE * spacing)
        level = _Level(config.coarse_rounds, config.coarse_iterations, _COARSE * config.bend_sigma)
        found = _fit(coarse, flash.of(few), reflectance, heights[few], anchor, config.slope_sigma, level)
        heights = _carried(coarse, found, points[few], points, _COARSE * spacing)
    field = HeightField(points, normals_world, spacing)
    level = _Level(config.rounds, config.iterations, config.bend_sigma)
    heights = _fit(field, flash, reflectance, heights, anchor, config.slope_sigma, level)
    normals = field.normals(heights)
    # Where a correction is no small one it is no correction: edges of the cloud, where neighbours are few.
    sane = (field.slopes(heights) ** 2).sum(dim=0) < _STEEPEST**2
    normals = torch.where(sane[:, None], normals, normals_world)
    return RefinedShape(normals, heights)


@dataclass(frozen=True)
class _Level:
    """How long to solve at one spacing, and how smooth corrections are there."""

    rounds: int
    iterations: int
    bend_sigma: float


def _fit(
    field: HeightField,
    flash: FlashResponses,
    reflectance: Reflectance,
    heights: torch.Tensor,
    anchor: float,
    slope_sigma: float,
    level: _Level,
) -> torch.Tensor:
    """Heights [P] that explain the shading, from some to begin with."""
    for _ in range(level.rounds):
        slopes, normals = field.slopes(heights), field.normals(heights)
        terms = _slope_terms(field, flash, reflectance, normals, slopes, slope_sigma)
        trust = 1.0 / (1.0 + (slopes * slopes).sum(dim=0) / (2.0 * slope_sigma) ** 2)
        trust = trust / slope_sigma**2
        heights = field.fit(
            SlopeTerms(terms.uu + trust, terms.uv, terms.vv + trust, terms.right),
            anchor=anchor,
            bending=1.0 / level.bend_sigma**2,
            start=heights,
            iterations=level.iterations,
        )
    return heights


def _thinned(points: torch.Tensor, cell: float) -> torch.Tensor:
    """Indices of the first of the points in each cell of a grid."""
    x, y, z = ((points - points.amin(dim=0)) / cell).long().T
    # One number a cell: unique rows take ten times as long.
    _, member = torch.unique((x * (int(y.max()) + 1) + y) * (int(z.max()) + 1) + z, return_inverse=True)
    first = member.new_full((int(member.max()) + 1,), len(points))
    first.scatter_reduce_(0, member, torch.arange(len(points), device=points.device), "amin")
    return first.sort().values


def _carried(
    coarse: HeightField, heights: torch.Tensor, places: torch.Tensor, points: torch.Tensor, spacing: float
) -> torch.Tensor:
    """Heights [P] of points from those of coarse points at places [N, 3], along their slopes."""
    count = min(_SPREAD, len(places))
    distances, near = cKDTree(places.cpu().numpy()).query(
        points.cpu().numpy(), k=list(range(1, count + 1)), workers=-1
    )
    weight = torch.from_numpy(np.exp(-0.5 * (distances / spacing) ** 2)).to(points)
    slope_u, slope_v = coarse.slopes(heights)
    slant = slope_u[:, None] * coarse.u + slope_v[:, None] * coarse.v
    total, result = torch.zeros_like(points[:, 0]), torch.zeros_like(points[:, 0])
    for k in range(count):
        index = torch.from_numpy(near[:, k]).to(points.device)
        height = heights[index] + ((points - places[index]) * slant[index]).sum(dim=1)
        result += weight[:, k] * height
        total += weight[:, k]
    return result / total.clamp(min=1e-12)


def _slope_terms(
    field: HeightField,
    flash: FlashResponses,
    reflectance: Reflectance,
    normals: torch.Tensor,
    slopes: torch.Tensor,
    slope_sigma: float,
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
        square_u, square_v = (precision * by_u**2).sum(dim=0), (precision * by_v**2).sum(dim=0)
        cross = (precision * by_u * by_v).sum(dim=0)
        pull_u, pull_v = (precision * by_u * left).sum(dim=0), (precision * by_v * left).sum(dim=0)
        # What slopes within the cloud's spread would explain of the residual is no noise.
        a, c = square_u + slope_sigma**-2, square_v + slope_sigma**-2
        explained = (c * pull_u**2 - 2.0 * cross * pull_u * pull_v + a * pull_v**2) / (a * c - cross**2)
        noise = ((precision * left * left).sum(dim=0) - explained).clamp(min=0.0)
        frames = (robust.clamp(max=1.0).sum(dim=0) - 2.0).clamp(min=0.0)
        belief = (_USUAL + frames) / (_USUAL + noise) / _SHARED
        uu[part], uv[part], vv[part] = belief * square_u, belief * cross, belief * square_v
        along_u, along_v = slopes[:, part]
        right[0, part] = belief * pull_u + uu[part] * along_u + uv[part] * along_v
        right[1, part] = belief * pull_v + uv[part] * along_u + vv[part] * along_v
    return SlopeTerms(uu, uv, vv, right)


def _derivative(curve: Callable[[torch.Tensor], torch.Tensor], cosine: torch.Tensor) -> torch.Tensor:
    return (curve(cosine + _STEP) - curve(cosine - _STEP)) / (2.0 * _STEP)


def _chunks(count: int) -> Iterator[slice]:
    for start in range(0, count, _CHUNK):
        yield slice(start, min(start + _CHUNK, count))
