"""Photometric solve: albedo, normals and room shading of every point from flash and no-flash frames.

With poses and points known the light model (Sevastopolsky 2020, eq. 4) is nearly linear per point. In a
no-flash frame a point shows its room radiance; a flash frame adds

    q = (L - room) d^2 / C_flash = albedo * diffuse(<n, l>) + gloss(<n, l>)

(`relight.reflectance`), seen under as many light directions l as there are flash frames. The steps:

1. room radiance: robust mean over the no-flash frames; to be taken off a flash frame, that of the no-flash
   frames taken from about the same place, for the room's gloss moves with the camera;
2. the scale of C_flash, the three reflectance numbers of the subject, and a gain for each flash frame
   (lamps droop);
3. normals: robust least squares for b = albedo * n under the frames' light directions (Woodham 1980), with
   the geometric normal as a prior in the directions that the lights do not span. The prior's weight is the
   ratio of the two variances, the photometric one measured from the residual;
   or, with `SolveConfig.shape`, as those of a surface that bends until its shading fits
   (`relight.shape_from_flash`), with which steps 1 and 2 are then done again;
4. albedo: robust least squares per channel;
5. points that the flash did not reach are filled, on a face from its other side (`relight.mirror_infill`),
   else from their neighbours (`relight.infill`).

Robust: frames in which gloss, a shadow, a wrong visibility or a moved pose spoils a point lose weight by a
Cauchy function of their residual. Clipped pixels never had any.

A calibrated flash (`relight.lamp`) brings its beam, its strength and its colour; with a noise model frames
count for less where noise is not small against what the model itself leaves.

Units: radiance 1.0 = white clip. Only albedo * C is observable. With the flash's strength known the albedo is
absolute; else a scale has to be chosen: the brightest twentieth of the points that the flash saw has albedo
`ALBEDO_95` (mean of the channels), and the flash is taken for white.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from scipy.spatial import cKDTree

from relight.cloud import CloudConfig, SurfaceCloud, prepare_cloud
from relight.errors import PlanError
from relight.infill import infill
from relight.lamp import Lamp, beam, beam_as_json
from relight.mirror_infill import mirror_infill
from relight.observations import Observations, observe_points
from relight.portrait import Portrait
from relight.reflectance import GRAZING, Reflectance, fit_local_gloss, fit_reflectance
from relight.room_gloss import RoomGloss, fit_room_gloss
from relight.scene import Scene
from relight.shape_from_flash import FlashResponses, ShapeConfig, refine_shape
from relight.stages import Progress, no_progress

ALBEDO_95 = 0.6
"""Mean-channel albedo given to the 95th percentile of the points: that of fair skin, in the middle of the
range."""

_CHUNK = 1 << 16  # points at a time: [K, chunk, 3] arrays stay in tens of megabytes
_SAMPLE = 10_000  # points from which global quantities are fitted
_ROOM_RELATIVE = 0.06  # spread of a point's room radiance over the views that counts as noise, e.g. gloss
_FLOOR = 0.004  # radiance of one 8-bit code in the shadows, and albedo that is as good as black
_BESIDE_RAD = 0.07  # 4 degrees: a good deal less than the width of a highlight of skin
_ROOM_MOVING = 0.5  # of the mean: a moving highlight stays within, what passes before the camera does not
_ROOM_PRIOR = 0.3  # weight of the mean over all views, in frames that face the point
_GLOSS_CUBE = 8.0  # spacings: gloss changes with the material, over centimetres
_GLOSS_STEP = 4  # every so many points are enough for what is pooled
_GLOSS_PRIOR = 8.0  # points whose word the subject's mean gloss counts for
_GLOSS_LIMIT = 4.0
_MIRROR_WORTH = 0.03  # of the points that no flash reached, from which on a face is looked for
_OUTSIDE_LIMIT = (
    0.05  # share of the frames that may show a point off the subject: masks and poses err by a pixel
)
_MODEL_ERROR = 0.06  # of what the flash adds: gloss, poses and normals leave about so much
_ALBEDO_95_LIMITS = (0.1, 1.3)  # of a subject under a flash whose strength is right
_ITERATIONS = 4
_GAIN_STEPS = 8  # a step carries gains to the frames that see the same points; a lamp droops over all of them


@dataclass(frozen=True)
class SolveConfig:
    """Settings of the photometric solve.

    Attributes:
        cloud: How the cloud is prepared.
        normal_sigma_rad: Standard error of the geometric normals, the weight of the prior.
        fit_gloss: Whether the subject's gloss and retro-reflection are fitted; otherwise it is taken as
            Lambertian.
        fit_gains: Whether the flash frames' gains are fitted; otherwise all flashes are taken as equal.
        mirror: Whether what no flash reached of a face is taken from its other side, before its neighbours.
        shape: How the cloud's surface is made to fit its shading (`relight.shape_from_flash`); None = it
            stays as the cloud has it, and only normals are fitted.
        room_gloss: Whether the gloss of the room's light, which moves with the camera, is fitted
            (`relight.room_gloss`); otherwise the room is the mean over the views.
        known: Information (sum of weighted squared cosines over the flash frames) that makes an albedo
            known: 0.25 is one flash frame at 60 degrees.
    """

    cloud: CloudConfig = field(default_factory=CloudConfig)
    normal_sigma_rad: float = 0.06
    fit_gloss: bool = True
    fit_gains: bool = True
    mirror: bool = True
    shape: ShapeConfig | None = None
    room_gloss: bool = False
    known: float = 0.25


@dataclass(frozen=True, eq=False)
class _Flash:
    """The flash frames' part of the observations for some points.

    Attributes:
        response: [K, P, 3], q of the module's docstring.
        weight: [K, P], 0 where nothing was observed.
        to_light: [K, P, 3], unit.
        gloss: [P], factor on the subject's gloss.
    """

    response: torch.Tensor
    weight: torch.Tensor
    to_light: torch.Tensor
    gloss: torch.Tensor

    def of(self, part: slice) -> _Flash:
        """Some of the points."""
        return _Flash(self.response[:, part], self.weight[:, part], self.to_light[:, part], self.gloss[part])

    def cosine(self, normals: torch.Tensor) -> torch.Tensor:
        """[K, P] between normals and light directions."""
        return (normals * self.to_light).sum(dim=-1)


def solve(scene: Scene, config: SolveConfig = SolveConfig(), progress: Progress = no_progress) -> Portrait:
    """Solves a scene.

    Args:
        scene: With at least one flash and one no-flash frame.
        config: See there.
        progress: Told ("cloud" | "observe" | "shape" | "solve", fraction).

    Raises:
        PlanError: There are no flash or no no-flash frames, or too few points, or the frames do not see the
            cloud.
    """
    flags = [view.flash for view in scene.views]
    if not any(flags) or all(flags):
        kind = "flash" if not any(flags) else "no-flash"
        raise PlanError(f"The scene has no {kind} frames; the solve needs frames with and without the flash.")
    progress("cloud", 0.0)
    normals_given = None if scene.normals_world is None else scene.normals_world.cpu().numpy()
    surface = prepare_cloud(
        scene.points.cpu().numpy(), normals_given, [view.camera for view in scene.views], config.cloud
    )
    progress("cloud", 1.0)
    observations = observe_points(scene, surface, progress)
    progress("solve", 0.0)
    if config.shape is not None:
        measured = _measure(scene, surface, observations, replace(config, room_gloss=False))
        surface = _shaped(surface, measured, config.shape, progress)
        progress("solve", 0.0)
    measured = _measure(scene, surface, observations, config)
    flash, relative, reflectance = measured.flash, measured.relative, measured.reflectance
    points = torch.from_numpy(surface.points).to(scene.device)
    prior = torch.from_numpy(surface.normals_world).to(scene.device)
    normals, sigma = prior.clone(), points.new_empty(len(points))
    albedo, information, residual = torch.empty_like(prior), torch.empty_like(sigma), torch.empty_like(sigma)
    prior_weight = (relative / config.normal_sigma_rad) ** 2
    for part in _chunks(len(points)):
        chunk = flash.of(part)
        if config.shape is None:  # else they fit the frames already
            normals[part] = _fit_normals(chunk, prior[part], reflectance, prior_weight, relative)
        albedo[part], information[part], residual[part], sigma[part] = _fit_albedo(
            chunk, normals[part], reflectance, relative
        )
        progress("solve", part.stop / len(points))
    known = information > config.known
    if not bool(known.any()):
        raise PlanError(
            "The flash frames do not light any point enough to solve for it; is the flash flag of the frames "
            "right, and is the subject what the flash lights?"
        )
    room, room_information = measured.room, measured.room_information
    filled, worth, from_mirror = albedo, information, 0.0
    if config.mirror and float(known.float().mean()) < 1.0 - _MIRROR_WORTH:
        mirrored = mirror_infill(scene, points, normals, albedo, information, config.known)
        filled, worth = mirrored.values, mirrored.information
        from_mirror = float(mirrored.filled.float().mean())
    albedo = infill(points, filled, worth, known=config.known, nearest=surface.spacing)
    room = infill(points, room, room_information, known=0.3, nearest=surface.spacing)
    gauge, warnings = _gauge(albedo[known].mean(dim=1), measured.scale, measured.level)
    albedo = (albedo * gauge).clamp(min=0.0)
    c_room, shading = _split_room(room, albedo, information > config.known)
    alike = _alike(flash, reflectance)
    normal_sigma = _normal_sigma(information / alike, relative, config.normal_sigma_rad)
    # An error of the normal is one of the cosine, by the tangent, whose square is about 0.5, and so of the
    # albedo.
    sigma = (sigma**2 * alike + 0.5 * (normal_sigma * albedo.mean(dim=1) / gauge) ** 2).sqrt()
    share = information / config.known
    portrait = Portrait(
        points=points,
        normals_world=normals,
        albedo=albedo,
        room_radiance=room.clamp(min=0.0),
        shading=shading,
        gloss=flash.gloss,
        confidence=share / (1.0 + share),
        albedo_sigma=(sigma * gauge).clamp(max=1.0),
        normal_sigma_rad=normal_sigma,
        residual=residual,
        spacing=surface.spacing,
        c_room=_three(c_room),
        c_flash=_three([measured.scale / gauge * share for share in measured.tint]),
        flash_offset_cam_m=_three(torch.as_tensor(scene.flash_offset_cam_m)),
        reflectance=Reflectance(reflectance.retro, reflectance.alpha, reflectance.f0 * gauge),
        info={
            "solver": "photometric",
            "frames": len(scene.views),
            "flash_frames": sum(flags),
            "flash_gains": [round(float(gain), 4) for gain in measured.gains],
            "relative_noise": round(relative, 4),
            "cloud_noise": surface.noise,
            "known_share": round(float(known.float().mean()), 4),
            "mirrored_share": round(from_mirror, 4),
            "flash_beam": beam_as_json(scene.lamp),
            "absolute_albedo": measured.level is not None and not warnings,
            "warnings": warnings,
        },
        room_gloss=measured.room_gloss,
    )
    return portrait if bool(measured.on_subject.all()) else portrait.subset(measured.on_subject)


@dataclass(frozen=True, eq=False)
class _Measured:
    """What the frames show of a surface.

    Attributes:
        on_subject: [P] bool, False for what the masks carve away.
        room: [P, 3] radiance under the room's light.
        room_information: [P] sum of weights that it rests on.
        flash: In units of the albedo, with each point's gloss.
        scale: Of C_flash.
        gains: [K] of the flash frames.
        reflectance: Of the subject.
        relative: Standard deviation of a flash observation relative to its albedo.
        tint: [3] colour of the flash, mean 1.
        level: Calibrated strength of the flash, None = unknown.
        room_gloss: What of the room's light is not in `room`, for it moves with the camera.
    """

    on_subject: torch.Tensor
    room: torch.Tensor
    room_information: torch.Tensor
    flash: _Flash
    scale: float
    gains: torch.Tensor
    reflectance: Reflectance
    relative: float
    tint: list[float]
    level: float | None
    room_gloss: RoomGloss | None


def _measure(
    scene: Scene, surface: SurfaceCloud, observations: Observations, config: SolveConfig
) -> _Measured:
    """Fits what all points of a surface share to what the frames show of them.

    Raises:
        PlanError: The frames do not show the surface, or are no brighter with the flash.
    """
    points = torch.from_numpy(surface.points).to(scene.device)
    normals = torch.from_numpy(surface.normals_world).to(scene.device)
    # What masks carve away takes no part; it is dropped at the end, for a copy of the observations would be
    # large.
    on_subject = observations.outside <= _OUTSIDE_LIMIT
    observations.cosine.mul_(on_subject)
    if not bool((observations.cosine > 0).any()):
        raise PlanError(
            "No frame shows a point of the cloud, unclipped and inside its mask; are poses and cloud in the "
            "same coordinates, and the frames exposed well?"
        )
    room, room_information = _room_radiance(observations)
    tint, level = _strength(scene.lamp)
    flash = _flash_part(observations, points, room, room_information, points.new_tensor(tint))
    scale, reflectance, gains = _global_quantities(flash, normals, config)
    lamps = observations.flash_position_world[observations.flash]
    if scale < _FLOOR * float(((lamps - points.mean(dim=0)) ** 2).sum(dim=1).median()):
        raise PlanError(
            f"The flash frames are no brighter than the others (by less than {_FLOOR} of white); is the "
            "flash flag of the frames right?"
        )
    flash = _normalised(flash, scale, gains)
    flash = replace(flash, gloss=_local_gloss(flash, points, normals, reflectance, surface.spacing))
    relative = _relative_noise(flash, normals, reflectance)
    room_gloss = None
    if config.room_gloss:
        centres = [view.camera.centre_world for view in scene.views if view.flash == 0]
        unlit = ~observations.flash
        moving = (
            points,
            normals,
            flash.gloss,
            reflectance,
            observations.radiance[unlit],
            observations.cosine[unlit],
            torch.from_numpy(np.stack(centres)).to(points),
        )
        room_gloss = fit_room_gloss(*moving)
        if room_gloss is not None:
            room = room - room_gloss.mean_radiance(*moving[:4], *moving[5:])
    return _Measured(
        on_subject,
        room,
        room_information,
        flash,
        scale,
        gains,
        reflectance,
        relative,
        tint,
        level,
        room_gloss,
    )


def _shaped(
    surface: SurfaceCloud, measured: _Measured, config: ShapeConfig, progress: Progress
) -> SurfaceCloud:
    """The surface with the normals that explain the shading under the flash."""
    progress("shape", 0.0)
    flash = measured.flash
    shape = refine_shape(
        torch.from_numpy(surface.points).to(flash.gloss.device),
        torch.from_numpy(surface.normals_world).to(flash.gloss.device),
        FlashResponses(
            flash.response.mean(dim=-1), flash.weight, flash.to_light, flash.gloss, measured.relative
        ),
        measured.reflectance,
        spacing=surface.spacing,
        cloud_noise=surface.noise,
        config=config,
    )
    progress("shape", 1.0)
    return replace(surface, normals_world=shape.normals_world.cpu().numpy())


def _room_radiance(observations: Observations) -> tuple[torch.Tensor, torch.Tensor]:
    """Robust mean over the no-flash frames [P, 3], and the sum of weights [P]; 0 where no frame sees the
    point."""
    dark = ~observations.flash
    rooms, informations = [], []
    for part in _chunks(observations.cosine.shape[1]):
        samples, weight = observations.radiance[dark, part], observations.cosine[dark, part]
        luminance, robust = samples.sum(dim=-1) / 3.0, weight
        for _ in range(_ITERATIONS - 1):
            mean = (robust * luminance).sum(dim=0) / robust.sum(dim=0).clamp(min=1e-6)
            deviation = (luminance - mean) / (2.0 * (_ROOM_RELATIVE * mean + _FLOOR))
            robust = weight / (1.0 + deviation * deviation)
        total = robust.sum(dim=0).clamp(min=1e-6)
        room = torch.einsum("kp,kpc->pc", robust, samples) / total[:, None]
        rooms.append(room)
        informations.append(weight.sum(dim=0))
    return torch.cat(rooms), torch.cat(informations)


def _strength(lamp: Lamp) -> tuple[list[float], float | None]:
    """Colour of the flash [3], its mean 1, and its strength; white and None where these are not known."""
    if lamp.strength is None:
        return [1.0, 1.0, 1.0], None
    level = float(lamp.strength.mean())
    return (lamp.strength / level).tolist(), level


def _gauge(albedo: torch.Tensor, scale: float, level: float | None) -> tuple[float, list[str]]:
    """Factor from solved albedos [P] (mean of the channels) to albedo, and a sentence where the flash's
    strength cannot be right."""
    top = float(torch.quantile(_sampled(albedo), 0.95).clamp(min=1e-6))
    low, high = _ALBEDO_95_LIMITS
    if level is None or low <= top * scale / level <= high:
        return (ALBEDO_95 / top if level is None else scale / level), []
    return ALBEDO_95 / top, [
        "With the calibrated strength of the flash the subject's albedo would reach "
        f"{top * scale / level:.2g}: the flash is not the one that was calibrated, or not at its level. The "
        "albedo's scale is a convention as without it."
    ]


def _flash_part(
    observations: Observations,
    points: torch.Tensor,
    room: torch.Tensor,
    room_information: torch.Tensor,
    tint: torch.Tensor,
) -> _Flash:
    """Flash-added radiance times d^2, as of a white flash without beam and scale, and where it comes from.

    What the room alone would have shown in a flash frame is taken from the no-flash frames beside it: the
    room's gloss on the subject moves with the camera, and the mean over all views would not know.
    """
    lit, dark = observations.flash, ~observations.flash
    weight = (observations.cosine[lit] > 0).float() * (room_information > 0.5)
    response, to_light = (points.new_empty(len(weight), len(points), 3) for _ in range(2))
    nearness = _nearness(observations.view_direction_world[lit], observations.view_direction_world[dark])
    positions, axes = observations.flash_position_world[lit], observations.flash_axis_world[lit]
    for part in _chunks(len(points)):
        share = observations.cosine[dark, part]
        luminance, mean = observations.radiance[dark, part].mean(dim=-1), room[part].mean(dim=-1)
        deviation = (luminance - mean) / (_ROOM_MOVING * mean + _FLOOR)
        share = share / (1.0 + deviation * deviation) ** 2
        beside = nearness @ (share[..., None] * observations.radiance[dark, part]).flatten(1)
        total = (nearness @ share)[..., None] + _ROOM_PRIOR
        beside = (beside.view(len(nearness), -1, 3) + _ROOM_PRIOR * room[part]) / total
        towards = positions[:, None] - points[part]
        square = (towards * towards).sum(dim=-1, keepdim=True)
        to_light[:, part] = towards / square.sqrt().clamp(min=1e-12)
        added = observations.radiance[lit, part] - beside
        whole = square / tint
        if observations.flash_falloff > 0:
            share = beam(to_light[:, part], axes[:, None], observations.flash_falloff)
            whole = whole / share[..., None]
        response[:, part] = added * whole * weight[:, part, None]
        if observations.variance is not None:
            variance = observations.variance[dark, part].mean(dim=0) / total[..., 0]
            variance = (observations.variance[lit, part] + variance) * whole.mean(dim=-1) ** 2
            weight[:, part] *= _noise_weight(response[:, part].mean(dim=-1), variance, weight[:, part])
    return _Flash(response, weight, to_light, points.new_ones(len(points)))


def _noise_weight(response: torch.Tensor, variance: torch.Tensor, seen: torch.Tensor) -> torch.Tensor:
    """Weight [K, P] of responses whose noise has a variance [K, P], against the others of their point.

    What the model itself leaves counts as noise too, relative to the point's mean over its frames: relative
    to the single observation, noise that makes it brighter would also make it count for more. The mean weight
    of a point is 1: how well it is known is told by its residual.
    """
    mean = (response * seen).sum(dim=0) / seen.sum(dim=0).clamp(min=1.0)
    model = (_MODEL_ERROR * mean.clamp(min=0.0)) ** 2 + 1e-12
    weight = model / (model + variance)
    return weight * seen.sum(dim=0).clamp(min=1.0) / (weight * seen).sum(dim=0).clamp(min=1e-12)


def _nearness(of: torch.Tensor, others: torch.Tensor) -> torch.Tensor:
    """How much views [K, 3] have in common with others [N, 3], by the angle between them: [K, N]."""
    angle = torch.acos((of @ others.T).clamp(-1.0, 1.0))
    # A capture may be sparse: its nearest neighbours count nevertheless.
    width = angle.min(dim=1, keepdim=True).values.clamp(min=_BESIDE_RAD)
    return torch.exp(-0.5 * (angle / width) ** 2)


def _global_quantities(
    flash: _Flash, normals: torch.Tensor, config: SolveConfig
) -> tuple[float, Reflectance, torch.Tensor]:
    """Scale of C_flash, reflectance of the subject and gain of each flash frame [K], from a sample of the
    points."""
    step = max(1, flash.weight.shape[1] // _SAMPLE)
    flash, normals = flash.of(slice(None, None, step)), normals[::step]
    gains = flash.response.new_ones(len(flash.response))
    matte = Reflectance()
    cosine, weight, response = flash.cosine(normals), flash.weight, flash.response.mean(dim=-1)
    albedo, information, _, _ = _fit_albedo(flash, normals, matte, None)
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
        used = (weight[k] > 0) & (albedo > 10 * _FLOOR) & ((weight > 0).sum(dim=0) >= 3)
        if int(used.sum()) >= 100:  # the median of fewer is no better known than lamps are equal
            model = albedo[used] * diffuse[k, used] + gloss[k, used]
            gains[k] = (response[k, used] / model).median()
    return (gains / gains.median()).clamp(0.5, 2.0)


def _normalised(flash: _Flash, scale: float, gains: torch.Tensor) -> _Flash:
    """The observations in units of the albedo; in place, for a copy would be large."""
    flash.response.mul_((1.0 / (scale * gains))[:, None, None])
    return flash


def _local_gloss(
    flash: _Flash, points: torch.Tensor, normals: torch.Tensor, reflectance: Reflectance, spacing: float
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


def _relative_noise(flash: _Flash, normals: torch.Tensor, reflectance: Reflectance) -> float:
    """Robust standard deviation of a flash observation relative to its albedo, with the geometric normals."""
    step = max(1, flash.weight.shape[1] // _SAMPLE)
    sample = flash.of(slice(None, None, step))
    albedo, information, residual, _ = _fit_albedo(sample, normals[::step], reflectance, None)
    used = (information > 0.5) & (albedo.mean(dim=1) > 10 * _FLOOR)
    if not bool(used.any()):
        return 0.06
    return float(residual[used].median().clamp(0.01, 0.5))


def _fit_normals(
    flash: _Flash, prior: torch.Tensor, reflectance: Reflectance, prior_weight: float, relative: float
) -> torch.Tensor:
    """Unit normals [P, 3], the prior where nothing was observed or the result strays over 45 degrees."""
    response = flash.response.mean(dim=-1)
    normals = prior
    tangential = torch.eye(3).to(prior) - prior[:, :, None] * prior[:, None, :]
    for _ in range(_ITERATIONS - 1):
        cosine = flash.cosine(normals)
        diffuse = reflectance.diffuse(cosine)
        # diffuse(c) = gain c: with the gain of the last normal the model is linear in b = albedo n.
        gain = diffuse / cosine.clamp(min=1e-3)
        matte = response - reflectance.gloss(cosine) * flash.gloss
        weight = flash.weight * (cosine > GRAZING) * cosine
        albedo = (weight * diffuse * matte).sum(dim=0) / (weight * diffuse**2).sum(dim=0).clamp(min=1e-6)
        deviation = (matte - albedo * diffuse) / (relative * albedo.abs() + _FLOOR)
        weight = weight / (1.0 + (0.5 * deviation) ** 2)
        weighted = (weight * gain**2)[..., None] * flash.to_light
        left = torch.einsum("kpi,kpj->pij", weighted, flash.to_light) + prior_weight * tangential
        left = left + 1e-4 * torch.eye(3).to(left)
        right = ((weight * gain * matte)[..., None] * flash.to_light).sum(dim=0) + 1e-4 * albedo[
            :, None
        ] * prior
        b = torch.linalg.solve(left.double(), right.double()).to(prior)
        fitted = b / torch.linalg.vector_norm(b, dim=1, keepdim=True).clamp(min=1e-12)
        sane = ((fitted * prior).sum(dim=1) > 0.7) & (albedo > _FLOOR)
        normals = torch.where(sane[:, None], fitted, prior)
    return normals


def _fit_albedo(
    flash: _Flash, normals: torch.Tensor, reflectance: Reflectance, relative: float | None
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Albedo [P, C], information [P], relative residual [P] and standard error [P]; without `relative` not
    robust."""
    cosine = flash.cosine(normals)
    diffuse = reflectance.diffuse(cosine)
    matte = flash.response - (reflectance.gloss(cosine) * flash.gloss)[..., None]
    weight = flash.weight * (cosine > GRAZING) * cosine.clamp(min=0.0)
    robust = weight
    for iteration in range(_ITERATIONS if relative is not None else 1):
        information = (robust * diffuse**2).sum(dim=0)
        albedo = ((robust * diffuse)[..., None] * matte).sum(dim=0) / information.clamp(min=1e-6)[:, None]
        deviation = (matte - albedo * diffuse[..., None]).mean(dim=-1)
        if relative is not None and iteration + 1 < _ITERATIONS:
            spread = relative * albedo.mean(dim=-1).abs() + _FLOOR
            robust = weight / (1.0 + (0.5 * deviation / spread) ** 2)
    frames = (weight > 0).sum(dim=0)
    variance = (weight * deviation**2).sum(dim=0) / weight.sum(dim=0).clamp(min=1e-6)
    variance = variance * frames / (frames - 1).clamp(min=1)
    residual = variance.sqrt() / (albedo.mean(dim=-1).abs() + _FLOOR)
    if relative is not None:  # few frames say little of their own spread: the subject's counts as one more
        usual = relative * albedo.mean(dim=-1).abs() + _FLOOR
        variance = ((frames - 1).clamp(min=0) * variance + usual**2) / frames.clamp(min=1)
    return albedo, information, residual, (variance / information.clamp(min=1e-6)).sqrt().clamp(max=1.0)


def _split_room(
    room: torch.Tensor, albedo: torch.Tensor, known: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """C_room [3] and shading [P] 0..1 with room = albedo C_room s as nearly as a grey s can (eq. 4, first
    term).

    The colour is the median of room / albedo where the albedo is known; the scale makes the brightest
    hundredth 1.
    """
    ratio = room / albedo.clamp(min=_FLOOR)
    used = known & (albedo.mean(dim=1) > 10 * _FLOOR)
    if not bool(used.any()) or float(room.max()) <= 0:
        return room.new_zeros(3), room.new_zeros(len(room))
    colour = ratio[used].median(dim=0).values
    if float(colour.max()) <= 0:
        return room.new_zeros(3), room.new_zeros(len(room))
    weight = albedo * colour
    shading = (room * weight).sum(dim=1) / (weight * weight).sum(dim=1).clamp(min=1e-12)
    top = torch.quantile(_sampled(shading[used]), 0.99).clamp(min=1e-6)
    return colour * top, (shading / top).clamp(0.0, 1.0)


def _alike(flash: _Flash, reflectance: Reflectance) -> torch.Tensor:
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


def _normal_sigma(information: torch.Tensor, relative: float, prior_sigma: float) -> torch.Tensor:
    """Standard error of the normal, radians: prior and flash frames together."""
    # A cosine c changes by sin per radian: tangential information is that of the frames times about tan^2 =
    # 0.5.
    photometric = 0.5 * information / relative**2
    return (1.0 / (1.0 / prior_sigma**2 + photometric)).sqrt()


def _chunks(count: int) -> Iterator[slice]:
    for start in range(0, count, _CHUNK):
        yield slice(start, min(start + _CHUNK, count))


def _sampled(values: torch.Tensor) -> torch.Tensor:
    """At most about a million values: torch.quantile takes no more than 16 million, and needs no more than
    these."""
    return values[:: max(1, len(values) // 1_000_000)]


def _three(values: Iterable[float | torch.Tensor]) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z
