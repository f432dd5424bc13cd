"""Maps of a view or a patch of one as a stack of layers, and what the network sees and changes of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from capture.cameras import Camera
from relight.maps import Maps, unproject

STACKED = 14
"""Channels of a view's maps that are kept."""

FEATURES = 18
"""Channels that the network sees of the maps."""

CHANGES = 7
"""Channels that it gives: room radiance 3, flash 3, mask 1."""

_MOST = 0.7  # of a change, in logarithms
_MASK_GAIN = 4.0  # of a logit: what is learned of the mask is learned at the rate of all else
_LOWEST, _HIGHEST = 1e-3, 0.999  # of a mask whose logit is finite


@dataclass(frozen=True, eq=False)
class Layers:
    """What a view sees of a portrait (fulfils `relight.surface.SurfaceMaps`); names as in `Maps`.

    Attributes:
        albedo: [H, W, 3].
        normals_world: [H, W, 3].
        room_radiance: [H, W, 3].
        confidence: [H, W].
        gloss: [H, W].
        flash_bounce: [H, W].
        mask: [H, W].
        points_world: [H, W, 3].
        flash_gain: [H, W, 3], factor on what the camera's own flash adds.
    """

    albedo: torch.Tensor
    normals_world: torch.Tensor
    room_radiance: torch.Tensor
    confidence: torch.Tensor
    gloss: torch.Tensor
    flash_bounce: torch.Tensor
    mask: torch.Tensor
    points_world: torch.Tensor
    flash_gain: torch.Tensor

    @property
    def shading(self) -> torch.Tensor:
        """Nothing asks for it: room_radiance takes its place."""
        return self.mask


def layers_of(maps: Maps) -> Layers:
    """Layers of a view's maps."""
    return Layers(
        maps.albedo,
        maps.normals_world,
        maps.room_radiance,
        maps.confidence,
        maps.gloss,
        maps.flash_bounce,
        maps.mask,
        maps.points_world,
        torch.ones_like(maps.albedo),
    )


def stacked(maps: Maps) -> torch.Tensor:
    """[STACKED, H, W] of a view: albedo, normal, room radiance, confidence, gloss, bounce, mask,
    depth."""
    singles = torch.stack([maps.confidence, maps.gloss, maps.flash_bounce, maps.mask, maps.depth], dim=-1)
    layers = [maps.albedo, maps.normals_world, maps.room_radiance, singles]
    return torch.cat(layers, dim=-1).permute(2, 0, 1).contiguous()


def unstacked(stack: torch.Tensor, camera: Camera) -> Layers:
    """Layers of a stack [STACKED, H, W] that a camera of its size sees."""
    image = stack.float().permute(1, 2, 0)
    albedo, normals, room, singles = image.split([3, 3, 3, 5], dim=-1)
    confidence, gloss, bounce, mask, depth = singles.unbind(-1)
    normals = torch.nn.functional.normalize(normals, dim=-1)
    points = unproject(depth, camera)
    return Layers(albedo, normals, room, confidence, gloss, bounce, mask, points, torch.ones_like(albedo))


def features(layers: Layers, camera: Camera, turn: torch.Tensor) -> torch.Tensor:
    """[FEATURES, H, W] that the network sees.

    Normals are given to the camera, in which a change of them is told, and to the world, in which the room
    stands still, as is the direction in which a mirror would look: gloss of the room follows it.

    Args:
        layers: Of the view.
        camera: Of the view.
        turn: [3, 3], from the portrait's world to the one in which the network was trained.
    """
    rotation = torch.as_tensor(camera.cam_from_world[:3, :3]).to(layers.albedo)
    towards = torch.as_tensor(camera.centre_world).to(layers.albedo) - layers.points_world
    towards = torch.nn.functional.normalize(towards, dim=-1)
    normals = layers.normals_world
    mirrored = 2.0 * (normals * towards).sum(dim=-1, keepdim=True) * normals - towards
    singles = torch.stack([layers.confidence, layers.gloss.clamp(max=4.0), layers.mask], dim=-1)
    on = (layers.mask > 0)[..., None]
    seen = torch.cat(
        [
            layers.albedo.clamp(min=0.0).sqrt(),
            layers.room_radiance.clamp(min=0.0).sqrt(),
            normals @ rotation.T,
            normals @ turn.T,
            mirrored @ turn.T,
            singles,
        ],
        dim=-1,
    )
    return torch.where(on, seen, 0.0).permute(2, 0, 1)


def changed(layers: Layers, changes: torch.Tensor) -> Layers:
    """Layers after what the network gives [CHANGES, H, W]; as they are where it gives 0.

    One frame cannot tell what its light model lacks from an albedo or a normal that is off, and would bend
    both. So these stay as all frames together have them, and what the model of the flash lacks goes into a
    gain of the flash alone.
    """
    on = layers.mask > 0
    by_room, by_flash = (_MOST * torch.tanh(changes[:6])).permute(1, 2, 0).split(3, dim=-1)
    logit = torch.logit(layers.mask.clamp(_LOWEST, _HIGHEST)) + _MASK_GAIN * changes[6]
    return replace(
        layers,
        room_radiance=layers.room_radiance * by_room.exp(),
        mask=torch.where(on, torch.sigmoid(logit), 0.0),
        flash_gain=by_flash.exp(),
    )


def strided(ids: torch.Tensor, scales: int) -> list[torch.Tensor]:
    """Ids [H / 2^t, W / 2^t] at some scales, of visible points [H, W].

    Of each square it is the point at its middle: all of them are visible, so it need not be the nearest.
    """
    return [ids] + [ids[1 << (t - 1) :: 1 << t, 1 << (t - 1) :: 1 << t] for t in range(1, scales)]
