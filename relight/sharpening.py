"""Detail that the points lost, given back by comparing what they draw with the frames.

A point's value is a mean over many frames of bilinear samples, and is drawn as a spot of some pixels: twice
blurred, eyebrows and the edges of lips come out dull. What a drawn frame lacks of the real one is read back
at the points and added (Irani and Peleg 1991, "Improving resolution by image registration"). In a no-flash
frame it is the room's radiance that lacks it; what the flash frames lack beyond that is the albedo's.

The albedo takes only what varies between neighbouring points: what is wrong over more than that is no blur
but light, gloss or a normal that the model has not, which the robust fit of all frames judges better.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from scipy.spatial import cKDTree

from relight.lamp import beam, lamp_of_portrait
from relight.lighting import FlashLight, shade
from relight.maps import splat_maps
from relight.observations import sample_bilinear, visible_points
from relight.portrait import Portrait
from relight.reflectance import GRAZING
from relight.scene import Scene, View
from relight.stages import Progress, no_progress

_GRAZING = 0.1  # cosine to the camera below which a frame says little
_FULL = 0.99  # of a mask: at its edge a pixel mixes subject and background
_ROOM_PRIOR = 0.3  # weight for no change, in frames that face the point
_ALBEDO_PRIOR = 0.25  # in flash frames that the point faces
_NEIGHBOURS = 24  # points over which what is alike is no blur of the albedo
_USUAL = 0.1  # of a radiance: larger differences are something else than blur
_BLACK = 0.01  # radiance below which that is no measure


def sharpen(scene: Scene, portrait: Portrait, passes: int, progress: Progress = no_progress) -> Portrait:
    """A portrait whose points draw the frames more nearly.

    Args:
        scene: With the frames.
        portrait: Solved from it.
        passes: Over the frames. Each sees the no-flash frames in two halves, so the second half corrects
            what the first has left.
        progress: Told ("sharpen", fraction).

    Returns:
        The portrait with another albedo and room radiance; as it was where no frame sees a point.
    """
    progress("sharpen", 0.0)
    count = min(_NEIGHBOURS, len(portrait.points))
    places = portrait.points.cpu().numpy()
    _, near = cKDTree(places).query(places, k=list(range(1, count + 1)), workers=-1)
    neighbours = torch.from_numpy(near).to(portrait.points.device)
    unlit, lit = ([view for view in scene.views if view.flash == flash] for flash in (0, 1))
    steps = max(1, passes * (len(unlit) + len(lit)))
    done = 0
    for _ in range(passes):
        for half in (unlit[::2], unlit[1::2]):
            lacking = _lacking_room(scene, portrait, half)
            portrait = replace(portrait, room_radiance=(portrait.room_radiance + lacking).clamp(min=0.0))
            done += len(half)
            progress("sharpen", done / steps)
        lacking, known = _lacking_albedo(scene, portrait, lit)
        lacking = known[:, None] * (lacking - _mean_over(lacking, known, neighbours))
        portrait = replace(portrait, albedo=(portrait.albedo + lacking).clamp(min=0.0))
        done += len(lit)
        progress("sharpen", done / steps)
    return portrait


def _lacking_room(scene: Scene, portrait: Portrait, views: Sequence[View]) -> torch.Tensor:
    """Radiance [P, 3] that no-flash frames show beyond what the portrait draws."""
    sums, weights = torch.zeros_like(portrait.albedo), torch.zeros_like(portrait.shading)
    usual = _USUAL * portrait.room_radiance.mean(dim=1) + _BLACK
    for view in views:
        seen, difference, weight = _difference(scene, portrait, view, 1.0)
        weight = weight / (1.0 + (difference.abs().mean(dim=1) / usual[seen]) ** 2)
        sums[seen] += weight[:, None] * difference
        weights[seen] += weight
    return sums / (weights + _ROOM_PRIOR)[:, None]


def _lacking_albedo(
    scene: Scene, portrait: Portrait, views: Sequence[View]
) -> tuple[torch.Tensor, torch.Tensor]:
    """Albedo [P, 3] that flash frames show beyond what the portrait draws, 0 where none shows any; 1 [P]
    elsewhere."""
    sums, weights = torch.zeros_like(portrait.albedo), torch.zeros_like(portrait.shading)
    known_gains = portrait.info.get("flash_gains", ())
    gains = known_gains if len(known_gains) == len(views) else [1.0] * len(views)
    colour, lamp = torch.tensor(portrait.c_flash).to(portrait.albedo), lamp_of_portrait(portrait.info)
    for view, gain in zip(views, gains, strict=True):
        seen, difference, weight = _difference(scene, portrait, view, gain)
        flash = torch.as_tensor(view.camera.centre_world).to(colour)
        turn = torch.as_tensor(view.camera.cam_from_world[:3, :3]).to(colour)
        towards = flash + torch.tensor(portrait.flash_offset_cam_m).to(colour) @ turn - portrait.points[seen]
        square = (towards * towards).sum(dim=1)
        cosine = (towards * portrait.normals_world[seen]).sum(dim=1) / square.sqrt().clamp(min=1e-12)
        diffuse = portrait.reflectance.diffuse(cosine)
        strength = gain * colour / square[:, None].clamp(min=1e-12)
        if lamp.falloff > 0:
            axis = torch.as_tensor(lamp.axis_world(view.camera.cam_from_world)).to(colour)
            to_light = towards / square.sqrt()[:, None].clamp(min=1e-12)
            strength = strength * beam(to_light, axis, lamp.falloff)[:, None]
        lacking = difference / strength.clamp(min=1e-9)
        usual = _USUAL * portrait.albedo[seen].mean(dim=1) + _BLACK
        weight = weight * (cosine > GRAZING) * cosine / (1.0 + (lacking.abs().mean(dim=1) / usual) ** 2)
        sums[seen] += (weight * diffuse)[:, None] * lacking
        weights[seen] += weight * diffuse**2
    return sums / (weights + _ALBEDO_PRIOR)[:, None], (weights > 0).to(sums)


def _difference(
    scene: Scene, portrait: Portrait, view: View, gain: float
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """The points that a frame sees [N], what it shows of them beyond the portrait [N, 3], and its weight."""
    observation, maps = scene.observe(view), splat_maps(portrait, view.camera)
    drawn = maps.room_radiance
    if view.flash == 1:
        drawn = drawn + gain * shade(
            FlashLight(),
            maps,
            camera=view.camera,
            c_flash=portrait.c_flash,
            flash_offset_cam_m=portrait.flash_offset_cam_m,
            reflectance=portrait.reflectance,
            lamp=lamp_of_portrait(portrait.info),
        )
    usable = (observation.valid > 0) & (maps.mask > _FULL)
    if observation.mask is not None:
        usable &= observation.mask > _FULL
    difference = torch.where(usable[..., None], observation.radiance - drawn, 0.0)
    uv_px, cosine, _ = visible_points(portrait.points, portrait.normals_world, view.camera, portrait.spacing)
    seen = (cosine > _GRAZING).nonzero()[:, 0]
    layers = torch.cat([difference.permute(2, 0, 1), usable[None].to(difference)])
    samples = sample_bilinear(layers, uv_px[seen])
    return seen, samples[:, :3], cosine[seen] * (samples[:, 3] > 0.999)


def _mean_over(values: torch.Tensor, known: torch.Tensor, neighbours: torch.Tensor) -> torch.Tensor:
    """Means [P, C] of values over those of each point's neighbours [P, K] that are known [P]."""
    total, count = torch.zeros_like(values), torch.zeros_like(known)
    for k in range(neighbours.shape[1]):
        total += values[neighbours[:, k]]
        count += known[neighbours[:, k]]
    return total / count.clamp(min=1.0)[:, None]
