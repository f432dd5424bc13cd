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
   with `SolveConfig.bounces` what came by way of other parts of the subject is taken off before 3 and 4
   (`relight.flash_bounces`);
5. points that the flash did not reach are filled, on a face from its other side (`relight.mirror_infill`),
   else from their neighbours (`relight.infill`);
6. with `SolveConfig.sharpening`, detail that was lost is given back (`relight.sharpening`).

Robust: frames in which gloss, a shadow, a wrong visibility or a moved pose spoils a point lose weight by a
Cauchy function of their residual. Clipped pixels never had any.

A calibrated flash (`relight.lamp`) brings its beam, its strength and its colour; with a noise model frames
count for less where noise is not small against what the model itself leaves.

Units: radiance 1.0 = white clip. Only albedo * C is observable. With the flash's strength known the albedo is
absolute; else a scale has to be chosen: the brightest twentieth of the points that the flash saw has albedo
`ALBEDO_95` (mean of the channels), and the flash is taken for white.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import torch

from relight.cloud import CloudConfig, SurfaceCloud, prepare_cloud
from relight.errors import PlanError
from relight.flash_bounces import FlashBounces, flash_bounces
from relight.flash_part import BLACK, FlashPart, chunks
from relight.infill import infill
from relight.lamp import beam_as_json
from relight.measured import ALBEDO_95 as ALBEDO_95
from relight.measured import Measured, Separated, measure, measure_room_gloss, separate
from relight.mirror_infill import mirror_infill
from relight.observations import Observations, observe_points
from relight.point_fits import fit_albedo, fit_normals
from relight.portrait import Portrait
from relight.reflectance import Reflectance
from relight.room_gloss import RoomGloss
from relight.scene import Scene
from relight.shape_from_flash import FlashResponses, ShapeConfig, refine_shape
from relight.sharpening import sharpen
from relight.stages import Progress, no_progress
from relight.standard_errors import standard_errors

_MIRROR_WORTH = 0.03  # of the points that no flash reached, from which on a face is looked for
_ALBEDO_95_LIMITS = (0.1, 1.3)  # of a subject under a flash whose strength is right


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
        bounces: Whether the flash's light that came by way of other parts of the subject is told from the
            rest (`relight.flash_bounces`); otherwise the albedo has it.
        room_gloss: Whether the gloss of the room's light, which moves with the camera, is fitted
            (`relight.room_gloss`); otherwise the room is the mean over the views.
        sharpening: Passes over the frames that give detail back (`relight.sharpening`).
        known: Information (sum of weighted squared cosines over the flash frames) that makes an albedo
            known: 0.25 is one flash frame at 60 degrees.
    """

    cloud: CloudConfig = field(default_factory=CloudConfig)
    normal_sigma_rad: float = 0.06
    fit_gloss: bool = True
    fit_gains: bool = True
    mirror: bool = True
    shape: ShapeConfig | None = None
    bounces: bool = True
    room_gloss: bool = False
    sharpening: int = 0
    known: float = 0.25


def solve(scene: Scene, config: SolveConfig = SolveConfig(), progress: Progress = no_progress) -> Portrait:
    """Solves a scene.

    Args:
        scene: With at least one flash and one no-flash frame.
        config: See there.
        progress: Told ("cloud" | "observe" | "shape" | "solve" | "sharpen", fraction).

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
    found = _found(scene, surface, observe_points(scene, surface, progress), config, progress)
    portrait = _portrait(scene, found, config, progress)
    del found  # half a gigabyte, for 100 frames
    return sharpen(scene, portrait, config.sharpening, progress) if config.sharpening > 0 else portrait


@dataclass(frozen=True, eq=False)
class _Found:
    """What the frames tell before the points are fitted by themselves.

    Attributes:
        surface: With the normals of its shape, where that is fitted.
        separated: The room's part and the flash's.
        measured: The flash's part without what bounced, and what all points share.
        bounces: What bounced; None = not told from the rest.
        room: [P, 3] radiance under the room's light, without the gloss that moves.
        room_gloss: That gloss; None = none.
    """

    surface: SurfaceCloud
    separated: Separated
    measured: Measured
    bounces: FlashBounces | None
    room: torch.Tensor
    room_gloss: RoomGloss | None


def _found(
    scene: Scene, surface: SurfaceCloud, observations: Observations, config: SolveConfig, progress: Progress
) -> _Found:
    """Steps 1 and 2, and what changes the surface or the flash's part of the frames."""
    progress("solve", 0.0)
    separated = separate(scene, surface, observations)
    measured = measure(separated, surface, observations, config)
    flash, bounces, bounced = measured.flash, None, None
    if config.bounces:
        bounces, bounced = _bounces(surface, measured, observations, separated.level, config)
        flash, bounced = measured.without(bounced), measured.as_observed(bounced)
    if config.shape is not None:
        surface = _shaped(surface, flash, measured, config.shape, progress)
        progress("solve", 0.0)
    if config.bounces or config.shape is not None:
        measured = measure(separated, surface, observations, config, bounced)
    room, room_gloss = separated.room, None
    if config.room_gloss:
        room, room_gloss = measure_room_gloss(scene, surface, observations, separated, measured)
    return _Found(surface, separated, measured, bounces, room, room_gloss)


def _portrait(scene: Scene, found: _Found, config: SolveConfig, progress: Progress) -> Portrait:
    """Steps 3 to 5: every point by itself, and what the flash did not reach."""
    surface, separated, measured = found.surface, found.separated, found.measured
    flash, relative, reflectance = measured.flash, measured.relative, measured.reflectance
    points = torch.from_numpy(surface.points).to(scene.device)
    prior = torch.from_numpy(surface.normals_world).to(scene.device)
    normals, sigma = prior.clone(), points.new_empty(len(points))
    albedo, information, residual = torch.empty_like(prior), torch.empty_like(sigma), torch.empty_like(sigma)
    prior_weight = (relative / config.normal_sigma_rad) ** 2
    for part in chunks(len(points)):
        chunk = flash.of(part)
        if config.shape is None:  # else they fit the frames already
            normals[part] = fit_normals(chunk, prior[part], reflectance, prior_weight, relative)
        albedo[part], information[part], residual[part], sigma[part] = fit_albedo(
            chunk, normals[part], reflectance, relative
        )
        progress("solve", part.stop / len(points))
    known = _known(information, config)
    filled, worth, from_mirror = albedo, information, 0.0
    if config.mirror and float(known.float().mean()) < 1.0 - _MIRROR_WORTH:
        mirrored = mirror_infill(scene, points, normals, albedo, information, config.known)
        filled, worth = mirrored.values, mirrored.information
        from_mirror = float(mirrored.filled.float().mean())
    albedo = infill(points, filled, worth, known=config.known, nearest=surface.spacing)
    room = infill(points, found.room, separated.room_information, known=0.3, nearest=surface.spacing)
    gauge, warnings = _gauge(albedo[known].mean(dim=1), measured.scale, separated.level)
    albedo = (albedo * gauge).clamp(min=0.0)
    bounce = torch.zeros_like(information)
    if found.bounces is not None:
        excess = found.bounces.excess(flash.weight, reflectance.diffuse(flash.cosine(normals)))
        bounce = (excess * albedo).sum(dim=1) / (albedo * albedo).sum(dim=1).clamp(min=BLACK**2)
        bounce = infill(points, bounce[:, None], information, known=config.known, nearest=surface.spacing)
        bounce = bounce[:, 0].clamp(min=0.0)
    c_room, shading = _split_room(room, albedo, information > config.known)
    normal_sigma, sigma = standard_errors(
        points,
        normals,
        albedo / gauge,
        sigma,
        information,
        flash,
        reflectance,
        relative,
        config.normal_sigma_rad,
    )
    share = information / config.known
    portrait = Portrait(
        points=points,
        normals_world=normals,
        albedo=albedo,
        room_radiance=room.clamp(min=0.0),
        shading=shading,
        gloss=flash.gloss,
        flash_bounce=bounce,
        confidence=share / (1.0 + share),
        albedo_sigma=(sigma * gauge).clamp(max=1.0),
        normal_sigma_rad=normal_sigma,
        residual=residual,
        spacing=surface.spacing,
        c_room=_three(c_room),
        c_flash=_three([measured.scale / gauge * share for share in separated.tint]),
        flash_offset_cam_m=_three(torch.as_tensor(scene.flash_offset_cam_m)),
        reflectance=Reflectance(reflectance.retro, reflectance.alpha, reflectance.f0 * gauge),
        bounce_scale=1.0 if found.bounces is None else found.bounces.scale,
        info={
            "solver": "photometric",
            "frames": len(scene.views),
            "flash_frames": len(flash.weight),
            "flash_gains": [round(float(gain), 4) for gain in measured.gains],
            "relative_noise": round(relative, 4),
            "cloud_noise": surface.noise,
            "known_share": round(float(known.float().mean()), 4),
            "mirrored_share": round(from_mirror, 4),
            "flash_beam": beam_as_json(scene.lamp),
            "absolute_albedo": separated.level is not None and not warnings,
            "warnings": warnings,
        },
        room_gloss=found.room_gloss,
    )
    return portrait if bool(separated.on_subject.all()) else portrait.subset(separated.on_subject)


def _known(information: torch.Tensor, config: SolveConfig) -> torch.Tensor:
    """[P] bool, points whose albedo the flash frames tell.

    Raises:
        PlanError: There are none.
    """
    known = information > config.known
    if not bool(known.any()):
        raise PlanError(
            "The flash frames do not light any point enough to solve for it; is the flash flag of the frames "
            "right, and is the subject what the flash lights?"
        )
    return known


def _bounces(
    surface: SurfaceCloud,
    measured: Measured,
    observations: Observations,
    level: float | None,
    config: SolveConfig,
) -> tuple[FlashBounces, torch.Tensor]:
    """What the flash throws on points by way of others, for white ones and [K, P, 3] for what they are."""
    points = torch.from_numpy(surface.points).to(measured.flash.gloss.device)
    normals = torch.from_numpy(surface.normals_world).to(points.device)
    albedo, information, _, _ = fit_albedo(measured.flash, normals, measured.reflectance, measured.relative)
    known = _known(information, config)
    gauge, _ = _gauge(albedo[known].mean(dim=1), measured.scale, level)
    bounces = flash_bounces(points, normals, surface.spacing, albedo, gauge, known, measured, observations)
    diffuse = measured.reflectance.diffuse(measured.flash.cosine(normals))
    bare = albedo.clamp(min=0.0) / (1.0 + bounces.excess(measured.flash.weight, diffuse))
    return bounces, bounces.light * bare


def _shaped(
    surface: SurfaceCloud, flash: FlashPart, measured: Measured, config: ShapeConfig, progress: Progress
) -> SurfaceCloud:
    """The surface with the normals that explain the shading under the flash."""
    progress("shape", 0.0)
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


def _split_room(
    room: torch.Tensor, albedo: torch.Tensor, known: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """C_room [3] and shading [P] 0..1 with room = albedo C_room s as nearly as a grey s can (eq. 4, first
    term).

    The colour is the median of room / albedo where the albedo is known; the scale makes the brightest
    hundredth 1.
    """
    ratio = room / albedo.clamp(min=BLACK)
    used = known & (albedo.mean(dim=1) > 10 * BLACK)
    if not bool(used.any()) or float(room.max()) <= 0:
        return room.new_zeros(3), room.new_zeros(len(room))
    colour = ratio[used].median(dim=0).values
    if float(colour.max()) <= 0:
        return room.new_zeros(3), room.new_zeros(len(room))
    weight = albedo * colour
    shading = (room * weight).sum(dim=1) / (weight * weight).sum(dim=1).clamp(min=1e-12)
    top = torch.quantile(_sampled(shading[used]), 0.99).clamp(min=1e-6)
    return colour * top, (shading / top).clamp(0.0, 1.0)


def _sampled(values: torch.Tensor) -> torch.Tensor:
    """At most about a million values: torch.quantile takes no more than 16 million, and needs no more than
    these."""
    return values[:: max(1, len(values) // 1_000_000)]


def _three(values: Iterable[float | torch.Tensor]) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z
