"""What a light falls on: the points of some maps that are worth shading, with what they see of a light.

Outside the domain: a zero normal marks a point without a known surface, and its cosine with any light is
zero. Within `MIN_DISTANCE_M` of a point light 1/d^2 stops growing and the cosine falls to zero, so values and
gradients are finite even at d = 0. NaN stays in its own point.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING, Protocol

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

if TYPE_CHECKING:
    from relight.lighting import Light

# Nearer than this, a light counts as this far: no real lamp is a point, and 1/d^2 would have no bound.
MIN_DISTANCE_M = 1e-3


class SurfaceMaps(Protocol):
    """What can be shaded: maps of a view, [...] = [H, W], or arrays of points, [...] = [P].

    Maps may also have a `room_radiance` [..., 3], linear: what the room's light makes of the surface, in
    colour. It then takes the place of albedo * C_room * shading. Likewise a `flash_radiance` [..., 3], what
    the camera's own flash adds, or a `flash_gain` [..., 3], a factor on it; and a `flash_bounce` [...], what
    comes of that flash by way of other parts of the subject, over what comes from it straight, to a surface
    of albedo 1. And a `gloss` [...], a factor on the gloss of a reflectance.
    """

    @property
    def albedo(self) -> Tensor:
        """[..., 3], linear, 0..1."""

    @property
    def normals_world(self) -> Tensor:
        """[..., 3], unit, or 0 where no surface is known."""

    @property
    def shading(self) -> Tensor:
        """[...], room shading, relative to C_room."""

    @property
    def mask(self) -> Tensor:
        """[...], 0..1; only where it is above 0 is anything shaded."""

    @property
    def points_world(self) -> Tensor:
        """[..., 3], metres."""


class Visibility(Protocol):
    """How much of a light each pixel of the maps sees, 0..1, from the geometry."""

    def point(self, position_world: Tensor, radius: float = 0.0) -> Tensor:
        """[...] for a ball of light about a position [3], metres."""

    def directional(self, to_light: Tensor, angle_rad: float = 0.0) -> Tensor:
        """[...] for a distant disc of light about a unit direction [3], of an angle across."""

    def environment(self, directions: Tensor, irradiances: Tensor) -> Tensor | None:
        """[..., C], of all that K distant lights would give without shadows.

        Unit directions [K, 3] and irradiances at normal incidence [K, C]; None where that is not offered.
        """

    def indirect(self, light: Light, arriving: Callable[[Surface], Tensor]) -> Tensor | None:
        """[..., C], what comes of a light by way of other parts of the subject, as white radiance.

        `arriving` is what comes from the light itself, to any surface; None where that is not offered.
        """


class Surface:
    """The P points of some maps where the mask is above 0, gathered when first asked for."""

    def __init__(self, maps: SurfaceMaps, visibility: Visibility | None = None) -> None:
        self._maps = maps
        self._visibility = visibility
        self._selected = (maps.mask.reshape(-1) > 0).nonzero()[:, 0]

    def __len__(self) -> int:
        return len(self._selected)

    @cached_property
    def albedo(self) -> Tensor:
        """[P, 3], linear, 0..1."""
        return self._gather(self._maps.albedo)

    @cached_property
    def normals(self) -> Tensor:
        """[P, 3], unit or 0, world."""
        return self._gather(self._maps.normals_world)

    @cached_property
    def shading(self) -> Tensor:
        """[P, 1], room shading, relative to C_room."""
        return self._gather(self._maps.shading[..., None])

    @cached_property
    def room_radiance(self) -> Tensor | None:
        """[P, 3], linear, under the room's light; None where the maps know only a grey shading."""
        radiance = getattr(self._maps, "room_radiance", None)
        return None if radiance is None else self._gather(radiance)

    @cached_property
    def flash_gain(self) -> Tensor | float:
        """[P, 3], factor on the radiance of the camera's own flash; 1 where the maps know of none."""
        gain = getattr(self._maps, "flash_gain", None)
        return 1.0 if gain is None else self._gather(gain)

    @cached_property
    def flash_albedo(self) -> Tensor:
        """[P, 3], the albedo, brighter by what the camera's own flash throws on the point by way of
        others."""
        bounce = getattr(self._maps, "flash_bounce", None)
        if bounce is None:
            return self.albedo
        return self.albedo * (1.0 + self._gather(bounce[..., None]) * self.albedo)

    @cached_property
    def flash_radiance(self) -> Tensor | None:
        """[P, 3], linear, that the camera's own flash adds; None where it follows from the other maps."""
        radiance = getattr(self._maps, "flash_radiance", None)
        return None if radiance is None else self._gather(radiance)

    @cached_property
    def gloss(self) -> Tensor | None:
        """[P, 1], factor on the reflectance's gloss; None where the maps know of none."""
        gloss = getattr(self._maps, "gloss", None)
        return None if gloss is None else self._gather(gloss[..., None])

    @cached_property
    def points(self) -> Tensor:
        """[P, 3], metres, world."""
        return self._gather(self._maps.points_world)

    def vector(self, value: ArrayLike | Tensor) -> Tensor:
        """A value as a tensor of the surface's type, on its device."""
        return (value if isinstance(value, Tensor) else torch.tensor(np.asarray(value))).to(self._maps.albedo)

    def sees_point(self, position_world: Tensor, radius: float = 0.0) -> Tensor | float:
        """[P], how much of a point light, or of a ball of light, is seen; 1 without a visibility."""
        if self._visibility is None:
            return 1.0
        return self._gather_visible(self._visibility.point(position_world, radius)[None])[0]

    def sees_direction(self, to_light: Tensor, angle_rad: float = 0.0) -> Tensor | float:
        """[P], how much of a distant light, or of a disc of an angle across, is seen; 1 without a
        visibility."""
        if self._visibility is None:
            return 1.0
        return self._gather_visible(self._visibility.directional(to_light, angle_rad)[None])[0]

    def environment_share(self, directions: Tensor, irradiances: Tensor) -> Tensor | float:
        """[P, C], share of the irradiance of distant lights that arrives; 1 where that is not offered."""
        if self._visibility is None:
            return 1.0
        share = self._visibility.environment(directions, irradiances)
        return 1.0 if share is None else self._gather(share.to(self._maps.albedo))

    def indirect(self, light: Light, arriving: Callable[[Surface], Tensor]) -> Tensor | float:
        """[P, C], what comes of a light by way of other parts of the subject; 0 where that is not offered."""
        indirect = None if self._visibility is None else self._visibility.indirect(light, arriving)
        return 0.0 if indirect is None else self._gather(indirect.to(self._maps.albedo))

    def scatter(self, values: Tensor) -> Tensor:
        """Values [P, C] of the points back in the maps' shape, [..., C], 0 elsewhere."""
        mask = self._maps.mask
        everywhere = values.new_zeros(mask.numel(), values.shape[-1])
        return everywhere.index_copy(0, self._selected, values).reshape(*mask.shape, -1)

    def _gather(self, values: Tensor) -> Tensor:
        return values.reshape(-1, values.shape[-1]).index_select(0, self._selected)

    def _gather_visible(self, visible: Tensor) -> Tensor:
        return visible.reshape(len(visible), -1).index_select(1, self._selected).to(self._maps.albedo)


def cosine(normals: Tensor, to_light: Tensor) -> Tensor:
    """Lambert's max(0, <n, l>): [...] of normals [..., 3] and a unit direction [3] towards the light."""
    return (normals @ to_light).clamp(min=0.0)


def cosine_falloff(points: Tensor, normals: Tensor, position: Tensor) -> Tensor:
    """max(0, <n, l>) / d^2 under a point light, per square metre (Sevastopolsky 2020, eq. 5).

    Args:
        points: [..., 3], metres.
        normals: [..., 3], unit or 0, in the axes of `points`.
        position: [3], of the light, metres.

    Returns:
        [...], finite everywhere.
    """
    towards = position - points
    distance_squared = (towards * towards).sum(dim=-1).clamp(min=MIN_DISTANCE_M**2)
    return (normals * towards).sum(dim=-1).clamp(min=0.0) / distance_squared**1.5


def direction_to(points: Tensor, position: Tensor) -> tuple[Tensor, Tensor]:
    """Unit directions [..., 3] from points [..., 3] to a position [3], and distances [..., 1]; 0 at the
    point."""
    towards = position - points
    distance = torch.linalg.vector_norm(towards, dim=-1, keepdim=True)
    return towards / distance.clamp(min=1e-12), distance
