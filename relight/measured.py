"""What the frames show of a surface, and what all its points share: the lights, the gloss, the noise."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy.spatial import cKDTree

from relight.cloud import SurfaceCloud
from relight.errors import PlanError
from relight.flash_part import BLACK, FlashPart, flash_part, room_radiance
from relight.lamp import Lamp
from relight.observations import Observations
from relight.point_fits import fit_albedo
from relight.reflectance import Reflectance, fit_local_gloss, fit_reflectance
from relight.room_gloss import RoomGloss, fit_room_gloss
from relight.scene import Scene

if TYPE_CHECKING:
    from relight.photometric import SolveConfig

ALBEDO_95 = 0.6
"""Mean-channel albedo given to the 95th percentile of the points: that of fair skin, in the middle of the
range."""

_SAMPLE = 10_000  # points from which global quantities are fitted
_GLOSS_CUBE = 8.0  # spacings: gloss changes with the material, over centimetres
_GLOSS_STEP = 4  # every so many points are enough for what is pooled
_GLOSS_PRIOR = 8.0  # points whose word the subject's mean gloss counts for
_GLOSS_LIMIT = 4.0
_OUTSIDE_LIMIT = (
    0.05  # share of the frames that may show a point off the subject: masks and poses err by a pixel
)
_GAIN_STEPS = 8  # a step carries gains to the frames that see the same points; a lamp droops over all of them


@dataclass(frozen=True, eq=False)
class Separated:
    """What the frames show of points, the room's part and the flash's, as it is observed.

    Attributes:
        on_subject: [P] bool, False for what the masks carve away.
        room: [P, 3] radiance under the room's light, mean over the views.
        room_information: [P] sum of weights that it rests on.
        flash: Its responses as of a flash of unit strength.
        tint: [3] colour of the flash, mean 1.
        level: Calibrated strength of the flash, None = unknown.
    """

    on_subject: torch.Tensor
    room: torch.Tensor
    room_information: torch.Tensor
    flash: FlashPart
    tint: list[float]
    level: float | None


@dataclass(frozen=True, eq=False)
class Measured:
    """What all points of a surface share, and the flash's responses in terms of it.

    Attributes:
        on_subject: [P] bool, False for what the masks carve away.
        flash: In units of the albedo, with each point's gloss.
        scale: Of C_flash.
        gains: [K] of the flash frames.
        reflectance: Of the subject.
        relative: Standard deviation of a flash observation relative to its albedo.
    """

    on_subject: torch.Tensor
    flash: FlashPart
    scale: float
    gains: torch.Tensor
    reflectance: Reflectance
    relative: float

    def without(self, bounced: torch.Tensor) -> FlashPart:
        """The flash's responses without some light [K, P, 3] in the same units, a part of them."""
        seen = self.flash.weight[..., None] > 0
        return replace(self.flash, response=torch.where(seen, self.flash.response - bounced, 0.0))

    def as_observed(self, bounced: torch.Tensor) -> torch.Tensor:
        """Light [K, P, 3] in the units of `Separated.flash`."""
        return bounced * (self.scale * self.gains)[:, None, None]


def separate(scene: Scene, surface: SurfaceCloud, observations: Observations) -> Separated:
    """Tells the flash from the room; it does not depend on the surface's normals.

    Raises:
        PlanError: The frames do not show the surface.
    """
    points = torch.from_numpy(surface.points).to(scene.device)
    # What masks carve away takes no part; it is dropped at the end, for a copy of the observations would be
    # large.
    on_subject = observations.outside <= _OUTSIDE_LIMIT
    observations.cosine.mul_(on_subject)
    if not bool((observations.cosine > 0).any()):
        raise PlanError(
            "No frame shows a point of the cloud, unclipped and inside its mask; are poses and cloud in the "
            "same coordinates, and the frames exposed well?"
        )
    room, room_information = room_radiance(observations)
    tint, level = _strength(scene.lamp)
    flash = flash_part(observations, points, room, room_information, points.new_tensor(tint))
    return Separated(on_subject, room, room_information, flash, tint, level)


def measure(
    separated: Separated,
    surface: SurfaceCloud,
    observations: Observations,
    config: SolveConfig,
    bounced: torch.Tensor | None = None,
) -> Measured:
    """Fits what all points of a surface share to what the frames show of them.

    Args:
        separated: Of the surface.
        surface: With the normals to go by.
        observations: Of the surface.
        config: Of the solve.
        bounced: [K, P, 3] what of the flash's responses came by way of other parts of the subject.

    Raises:
        PlanError: The frames are no brighter with the flash.
    """
    observed = separated.flash
    points = torch.from_numpy(surface.points).to(observed.gloss.device)
    normals = torch.from_numpy(surface.normals_world).to(observed.gloss.device)
    if bounced is not None:
        seen = observed.weight[..., None] > 0
        observed = replace(observed, response=torch.where(seen, observed.response - bounced, 0.0))
    scale, reflectance, gains = _global_quantities(observed, normals, config)
    lamps = observations.flash_position_world[observations.flash]
    if scale < BLACK * float(((lamps - points.mean(dim=0)) ** 2).sum(dim=1).median()):
        raise PlanError(
            f"The flash frames are no brighter than the others (by less than {BLACK} of white); is the "
            "flash flag of the frames right?"
        )
    flash = replace(observed, response=observed.response / (scale * gains)[:, None, None])
    flash = replace(flash, gloss=_local_gloss(flash, points, normals, reflectance, surface.spacing))
    relative = _relative_noise(flash, normals, reflectance)
    return Measured(separated.on_subject, flash, scale, gains, reflectance, relative)


def measure_room_gloss(
    scene: Scene, surface: SurfaceCloud, observations: Observations, separated: Separated, measured: Measured
) -> tuple[torch.Tensor, RoomGloss | None]:
    """The room's radiance [P, 3] without the gloss that moves with the view, and that gloss if there is
    one."""
    centres = [view.camera.centre_world for view in scene.views if view.flash == 0]
    unlit = ~observations.flash
    points = torch.from_numpy(surface.points).to(scene.device)
    moving = (
        points,
        torch.from_numpy(surface.normals_world).to(scene.device),
        measured.flash.gloss,
        measured.reflectance,
        observations.radiance[unlit],
        observations.cosine[unlit],
        torch.from_numpy(np.stack(centres)).to(points),
    )
    gloss = fit_room_gloss(*moving)
    if gloss is None:
        return separated.room, None
    return separated.room - gloss.mean_radiance(*moving[:4], *moving[5:]), gloss


def _strength(lamp: Lamp) -> tuple[list[float], float | None]:
    """Colour of the flash [3], its mean 1, and its strength; white and None where these are not known."""
    if lamp.strength is None:
        return [1.0, 1.0, 1.0], None
    level = float(lamp.strength.mean())
    return (lamp.strength / level).tolist(), level


def _global_quantities(
    flash: FlashPart, normals: torch.Tensor, config: SolveConfig
) -> tuple[float, Reflectance, torch.Tensor]:
    """Scale of C_flash, reflectance of the subject and gain of each flash frame [K], from a sample of the
    points."""
    step = max(1, flash.weight.shape[1] // _SAMPLE)
    flash, normals = flash.of(slice(None, None, step)), normals[::step]
    gains = flash.response.new_ones(len(flash.response))
    matte = Reflectance()
    cosine, weight, response = flash.cosine(normals), flash.weight, flash.response.mean(dim=-1)
    albedo, information, _, _ = fit_albedo(flash, normals, matte, None)
    seen = information > config.known
    if not bool(seen.any()):
        return 1.0, matte, gains
    scale = float(torch.quantile(albedo[seen].mean(dim=1), 0.95).clamp(min=1e-9)) / ALBEDO_95
    reflectance = matte
    for _ in range(2):
        scaled = response / scale / gains[:, None]
        if config.fit_gloss:
            reflectance = fit_reflectance(cosine, scaled, weight)
        for _ in range(_GAIN_STEPS if config.fit_gains else 0):
            gains = gains * _frame_gains(cosine, response / scale / gains[:, None], weight, reflectance)
    return scale, reflectance, gains


def _frame_gains(
    cosine: torch.Tensor, response: torch.Tensor, weight: torch.Tensor, reflectance: Reflectance
) -> torch.Tensor:
    """Gain of each frame [K] against the points' albedos from all frames: a median of ratios; 1 on the
    whole."""
    diffuse, gloss = reflectance.diffuse(cosine), reflectance.gloss(cosine)
    weight = weight * (cosine > 0.5)
    norm = (weight * diffuse**2).sum(dim=0)
    albedo = (weight * diffuse * (response - gloss)).sum(dim=0) / norm.clamp(min=1e-6)
    gains = response.new_ones(len(response))
    for k in range(len(response)):
        used = (weight[k] > 0) & (albedo > 10 * BLACK) & ((weight > 0).sum(dim=0) >= 3)
        if int(used.sum()) >= 100:  # the median of fewer is no better known than lamps are equal
            model = albedo[used] * diffuse[k, used] + gloss[k, used]
            gains[k] = (response[k, used] / model).median()
    return (gains / gains.median()).clamp(0.5, 2.0)


def _local_gloss(
    flash: FlashPart, points: torch.Tensor, normals: torch.Tensor, reflectance: Reflectance, spacing: float
) -> torch.Tensor:
    """Factor on f0 for each point [P], pooled over cubes and smoothed between them.

    Few points see a light near enough to their mirror direction to know their own gloss; a few hundred do.
    """
    if reflectance.f0 <= 0:
        return torch.ones_like(flash.gloss)
    some = slice(None, None, _GLOSS_STEP)
    sample, places = flash.of(some), points[some]
    cosine, response = sample.cosine(normals[some]), sample.response.mean(dim=-1)
    sides = torch.stack(fit_local_gloss(cosine, response, sample.weight, reflectance), dim=1)
    cube = ((places - places.min(dim=0).values) / (_GLOSS_CUBE * spacing)).long()
    _, member = torch.unique(cube, dim=0, return_inverse=True)
    count = int(member.max()) + 1
    sums = places.new_zeros(count, 5).index_add_(0, member, torch.cat([sides, places], dim=1))
    sizes = torch.bincount(member, minlength=count).to(points)
    tree = cKDTree((sums[:, 2:] / sizes[:, None]).cpu().numpy())
    distances, near = tree.query(points.cpu().numpy(), k=list(range(1, min(8, count) + 1)), workers=-1)
    weight = torch.from_numpy(np.exp(-0.5 * (distances / (_GLOSS_CUBE * spacing)) ** 2)).to(points)
    pooled = (weight[..., None] * sums[torch.from_numpy(near).to(points.device), :2]).sum(dim=1)
    known = sides[:, 1][sides[:, 1] > 0]
    prior = _GLOSS_PRIOR * float(known.median()) if len(known) else 1.0
    own = (pooled[:, 0] + prior * reflectance.f0) / (pooled[:, 1] + prior)
    return (own / reflectance.f0).clamp(0.0, _GLOSS_LIMIT)


def _relative_noise(flash: FlashPart, normals: torch.Tensor, reflectance: Reflectance) -> float:
    """Robust standard deviation of a flash observation relative to its albedo, with the geometric normals."""
    step = max(1, flash.weight.shape[1] // _SAMPLE)
    sample = flash.of(slice(None, None, step))
    albedo, information, residual, _ = fit_albedo(sample, normals[::step], reflectance, None)
    used = (information > 0.5) & (albedo.mean(dim=1) > 10 * BLACK)
    if not bool(used.any()):
        return 0.06
    return float(residual[used].median().clamp(0.01, 0.5))
