"""What the capture's flash throws on a point by way of other parts of the subject.

A fit that knows nothing of it takes hollows for brighter and flatter than they are (Nayar, Ikeuchi and Kanade
1991, "Shape from interreflections"). With J for what arrives so at a point in frame k, as the radiance of a
white surface over that of one that faces the flash, a flash frame shows

    q = albedo (diffuse(<n, l>) + J) + gloss(<n, l>)

J follows from the surface and the albedo (`relight.interreflection`) once the albedo's scale is known, which
is a convention elsewhere. Here colour tells it. Light that bounced has the subject's colour twice, so hollows
are redder than their albedo by what J has of it, while an error of the normal, of the flash's strength or of
its gain makes all channels brighter alike and cancels in their ratios. A subject without colour says nothing,
and a usual scale is assumed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from relight.flash_part import FlashPart
from relight.interreflection import Interreflection
from relight.lamp import beam
from relight.observations import Observations
from relight.shadows import seen_from

if TYPE_CHECKING:
    from relight.measured import Measured

_USUAL_SCALE = 0.75  # of the albedo's convention (fair skin), which is a bright one
_USUAL_CONTRAST = 1e-3  # of J between channels at that scale, with which frames say as much as it does
_LEAST_SCALE, _LARGEST_SCALE = 0.01, 1.25  # of no light a share cannot be told
_ROUNDS = 5  # the second bounce goes with the square of the scale, and the albedo with what bounced
_REWEIGHTINGS = 6
_SAMPLE = 40_000  # points from which the scale is found
_LEAST_LIT = 0.02  # albedo or cosine, below which ratios are noise
_TELLING = 6  # flash frames from which the scale is found; neighbours say nearly the same
_FRAMES = 8  # whose light is carried to the points at a time


@dataclass(frozen=True, eq=False)
class FlashBounces:
    """Of one surface in the flash frames.

    Attributes:
        light: [K, P, 3], J of the module's docstring.
        scale: Factor on the albedo with which light bounces as strongly as the frames show.
    """

    light: torch.Tensor
    scale: float

    def excess(self, weight: torch.Tensor, diffuse: torch.Tensor) -> torch.Tensor:
        """[P, 3], by which share the flash makes points brighter than it would alone.

        In the sense of least squares over frames with weights [K, P] and direct light [K, P].
        """
        return _excess(weight, diffuse, self.light, 1e-6)


def _excess(weight: torch.Tensor, direct: torch.Tensor, light: torch.Tensor, least: float) -> torch.Tensor:
    """Share [P, 3] of direct light [K, P] that other light [K, P, 3] is of it, by weights [K, P].

    Of a sum of squares below the least one, nothing is told, and the share tends to 0.
    """
    square = (weight * direct**2).sum(dim=0).clamp(min=max(least, 1e-12))
    return torch.einsum("kp,kpc->pc", weight * direct, light) / square[:, None]


@dataclass(frozen=True, eq=False)
class _Solid:
    """A surface that reflects (`relight.interreflection.Reflecting`)."""

    points: torch.Tensor
    normals_world: torch.Tensor
    albedo: torch.Tensor
    spacing: float


def flash_bounces(
    points: torch.Tensor,
    normals_world: torch.Tensor,
    spacing: float,
    albedo: torch.Tensor,
    gauge: float,
    known: torch.Tensor,
    measured: Measured,
    observations: Observations,
) -> FlashBounces:
    """Finds the light and its scale.

    Args:
        points: [P, 3], world.
        normals_world: [P, 3] unit.
        spacing: Of the points, world units.
        albedo: [P, 3] in the units of the measured responses.
        gauge: Factor from it to the albedo.
        known: [P] bool, where the flash frames tell the albedo; the others are taken for the usual one.
        measured: Of the flash frames.
        observations: From where the flash came.
    """
    assumed = torch.where(known[:, None], albedo, albedo[known].median(dim=0).values)
    solid = _Solid(points, normals_world, (gauge * assumed).clamp(0.0, 1.0), spacing)
    inside = Interreflection(solid)
    lamps, axes = (
        values[observations.flash]
        for values in (observations.flash_position_world, observations.flash_axis_world)
    )
    falloff = observations.flash_falloff
    direct = torch.stack(
        [_direct(inside, solid, lamp, axis, falloff) for lamp, axis in zip(lamps, axes, strict=True)]
    )
    fitted, excess = inside.albedo, torch.zeros_like(inside.albedo)
    least = _LEAST_LIT * float(direct.amax()) ** 2

    def arriving(scale: float, frames: slice) -> torch.Tensor:
        """[S, K, 3] from other surfels, whose albedo was fitted with what bounced as it was last found."""
        nonlocal excess
        lit = direct[frames]
        inside.albedo = (scale * fitted / (1.0 + excess)).clamp(max=1.0)
        bounced = inside.indirect(lit.T[..., None].expand(-1, -1, 3))
        excess = _excess(torch.ones_like(lit), lit, bounced.permute(1, 0, 2), least)
        return bounced

    def at_points(bounced: torch.Tensor, ids: torch.Tensor, frames: slice) -> torch.Tensor:
        """[K, N, 3] at points, over what a white surface there would show that faces the flash."""
        light = points.new_empty(bounced.shape[1], len(ids), 3)
        for first in range(0, len(light), _FRAMES):
            some = slice(first, first + _FRAMES)
            values = inside.of_points(bounced[:, some].flatten(1), ids).view(len(ids), -1, 3)
            light[some] = values.permute(1, 0, 2)
        towards = lamps[frames, None] - points[ids]
        square = (towards * towards).sum(dim=-1, keepdim=True)
        if falloff > 0:
            to_lamp = towards / square.sqrt().clamp(min=1e-12)
            square = square / beam(to_lamp, axes[frames, None], falloff)[..., None]
        return light.mul_(square)

    sample = (known & measured.on_subject).nonzero()[:, 0]
    sample = sample[:: max(1, len(sample) // _SAMPLE)]
    telling = slice(None, None, max(1, len(lamps) // _TELLING))
    flash = measured.flash.of_frames(telling).of(sample)
    scale = _USUAL_SCALE
    for _ in range(_ROUNDS):
        light = at_points(arriving(scale, telling), sample, telling)
        share = _share(measured, flash, normals_world[sample], albedo[sample], light, scale)
        scale = min(max(share * scale, _LEAST_SCALE), _LARGEST_SCALE)
    every, whole = torch.arange(len(points), device=points.device), slice(None)
    return FlashBounces(at_points(arriving(scale, whole), every, whole), scale)


def _direct(
    inside: Interreflection, solid: _Solid, lamp: torch.Tensor, axis: torch.Tensor, falloff: float
) -> torch.Tensor:
    """[S] of the surfels under a flash at [3], as the radiance of a white surface."""
    towards = lamp - inside.points_world
    square = (towards * towards).sum(dim=1).clamp(min=1e-12)
    cosine = (inside.normals_world * towards).sum(dim=1).clamp(min=0.0)
    seen = seen_from(solid, lamp, inside.points_world, inside.normals_world)
    # Mean over a disc of the surfel's area, on the lamp's axis: it has a bound where the lamp touches it.
    spread = square + inside.side**2 / (2.0 * math.pi)
    lit = cosine / (square.sqrt() * spread) * seen
    return lit * beam(towards / square.sqrt()[:, None], axis, falloff) if falloff > 0 else lit


def _share(
    measured: Measured,
    flash: FlashPart,
    normals: torch.Tensor,
    albedo: torch.Tensor,
    light: torch.Tensor,
    scale: float,
) -> float:
    """Which share of some bounced light [K, N, 3] some frames show at some points, told by colour alone.

    The prior: at the usual scale it is all of it.
    """
    cosine = flash.cosine(normals)
    diffuse = measured.reflectance.diffuse(cosine)[..., None]
    gloss = measured.reflectance.gloss(cosine) * flash.gloss
    weight = flash.weight * cosine.clamp(min=0.0) * (cosine > _LEAST_LIT)
    weight = (weight * (albedo.amin(dim=1) > _LEAST_LIT))[..., None].double()
    seen = (flash.response - gloss[..., None]) / albedo.clamp(min=_LEAST_LIT)
    square = (weight * diffuse**2).sum(dim=0).clamp(min=1e-9)

    def colour_alone(values: torch.Tensor) -> torch.Tensor:
        """[K, N, 3] without what all channels share, and without what an error of the albedo would do."""
        own = (values - values.mean(dim=-1, keepdim=True)).double()
        return own - diffuse * ((weight * diffuse * own).sum(dim=0) / square)

    # The albedo was fitted with what bounced, and is by that too high for either part of the light.
    excess = _excess(weight[..., 0], diffuse[..., 0].double(), light.double(), 1e-6)
    left, model = colour_alone(seen), colour_alone(light / (1.0 + excess))
    usual = _USUAL_SCALE / scale
    # As strong at any scale, and never nothing, so that where no frame tells the usual one remains.
    prior = max(float(weight.sum()) * 3.0 * (_USUAL_CONTRAST / usual) ** 2, 1e-12)
    share = usual
    for _ in range(_REWEIGHTINGS):
        robust = weight / (1.0 + ((left - share * model) / (2.0 * measured.relative)) ** 2)
        top = float((robust * left * model).sum()) + prior * usual
        share = max(0.0, top / (float((robust * model**2).sum()) + prior))
    return share
