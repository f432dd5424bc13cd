"""The flash frames' part of what is observed: what the flash adds to points, and from where it comes.

In a no-flash frame a point shows its room radiance; a flash frame adds the response q of
`relight.photometric`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch

from relight.lamp import beam
from relight.observations import Observations

BLACK = 0.004
"""Radiance of one 8-bit code in the shadows, and albedo that is as good as black."""

ITERATIONS = 4
"""Reweightings of a robust fit."""

_CHUNK = 1 << 16  # points at a time: [K, chunk, 3] arrays stay in tens of megabytes
_ROOM_RELATIVE = 0.06  # spread of a point's room radiance over the views that counts as noise, e.g. gloss
_BESIDE_RAD = 0.07  # 4 degrees: a good deal less than the width of a highlight of skin
_ROOM_MOVING = 0.5  # of the mean: a moving highlight stays within, what passes before the camera does not
_ROOM_PRIOR = 0.3  # weight of the mean over all views, in frames that face the point
_MODEL_ERROR = 0.06  # of what the flash adds: gloss, poses and normals leave about so much


@dataclass(frozen=True, eq=False)
class FlashPart:
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

    def of_frames(self, frames: slice) -> FlashPart:
        """Some of the frames."""
        return FlashPart(self.response[frames], self.weight[frames], self.to_light[frames], self.gloss)

    def of(self, part: slice | torch.Tensor) -> FlashPart:
        """Some of the points."""
        return FlashPart(
            self.response[:, part], self.weight[:, part], self.to_light[:, part], self.gloss[part]
        )

    def cosine(self, normals: torch.Tensor) -> torch.Tensor:
        """[K, P] between normals and light directions."""
        return (normals * self.to_light).sum(dim=-1)


def room_radiance(observations: Observations) -> tuple[torch.Tensor, torch.Tensor]:
    """Robust mean over the no-flash frames [P, 3], and the sum of weights [P]; 0 where no frame sees the
    point."""
    dark = ~observations.flash
    rooms, informations = [], []
    for part in chunks(observations.cosine.shape[1]):
        samples, weight = observations.radiance[dark, part], observations.cosine[dark, part]
        luminance, robust = samples.sum(dim=-1) / 3.0, weight
        for _ in range(ITERATIONS - 1):
            mean = (robust * luminance).sum(dim=0) / robust.sum(dim=0).clamp(min=1e-6)
            deviation = (luminance - mean) / (2.0 * (_ROOM_RELATIVE * mean + BLACK))
            robust = weight / (1.0 + deviation * deviation)
        total = robust.sum(dim=0).clamp(min=1e-6)
        room = torch.einsum("kp,kpc->pc", robust, samples) / total[:, None]
        rooms.append(room)
        informations.append(weight.sum(dim=0))
    return torch.cat(rooms), torch.cat(informations)


def flash_part(
    observations: Observations,
    points: torch.Tensor,
    room: torch.Tensor,
    room_information: torch.Tensor,
    tint: torch.Tensor,
) -> FlashPart:
    """Flash-added radiance times d^2, as of a white flash without beam and scale, and where it comes from.

    What the room alone would have shown in a flash frame is taken from the no-flash frames beside it: the
    room's gloss on the subject moves with the camera, and the mean over all views would not know.
    """
    lit, dark = observations.flash, ~observations.flash
    weight = (observations.cosine[lit] > 0).float() * (room_information > 0.5)
    response, to_light = (points.new_empty(len(weight), len(points), 3) for _ in range(2))
    nearness = _nearness(observations.view_direction_world[lit], observations.view_direction_world[dark])
    positions, axes = observations.flash_position_world[lit], observations.flash_axis_world[lit]
    for part in chunks(len(points)):
        share = observations.cosine[dark, part]
        luminance, mean = observations.radiance[dark, part].mean(dim=-1), room[part].mean(dim=-1)
        deviation = (luminance - mean) / (_ROOM_MOVING * mean + BLACK)
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
    return FlashPart(response, weight, to_light, points.new_ones(len(points)))


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


def chunks(count: int) -> Iterator[slice]:
    """Slices of so many points that what is computed of them stays small."""
    for start in range(0, count, _CHUNK):
        yield slice(start, min(start + _CHUNK, count))
