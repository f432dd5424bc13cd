"""Shadows that the subject casts on itself under a new light: the paper's second limitation removed.

A depth map of the portrait's points from the light, and the question whether a pixel lies behind it
(Williams 1978, "Casting curved shadows on curved surfaces"). Cells are as wide as a few points, cells
without a point take the nearest of their neighbours, and the tolerance grows with the slant of the surface,
so that no light leaks between points and no surface shades itself; the answer is interpolated between four
cells (Reeves et al. 1987).

For a panorama, which is many distant lights, the question is answered once for every point of the portrait
and looked up in every view. So it is for a light with a size, which is taken for as many small lights spread
evenly over its disc (Cook et al. 1984, "Distributed ray tracing", with fixed places instead of random ones):
its penumbra is that of the disc for any occluder, which filtering one depth map (Fernando 2005,
"Percentage-closer soft shadows") has only where a single plane casts it.

What the light leaves dark other parts of the subject light up: `relight.interreflection`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import torch

from relight.interreflection import Interreflection, Reflecting, spiral
from relight.maps import Maps
from relight.portrait import Portrait
from relight.surface import Surface

if TYPE_CHECKING:
    from relight.lighting import Light

_CELL = 1.5  # of a depth map, in spacings of the points
_CELL_MANY = 3.0  # where there are many lights, each counts little
_BIAS = 2.4  # in spacings
_SLANT = 2.0  # cells
_STEEPEST = (
    20.0  # tangent: surfaces that the light grazes at more than 87 degrees are dark by their cosine anyway
)
_LARGEST_SIDE = 4096  # cells
_SMALL_LIGHTS = 48  # over the disc of a light with a size: steps of a penumbra under two hundredths

_Coordinates = tuple[torch.Tensor, torch.Tensor, torch.Tensor]
Arriving = Callable[[Surface], torch.Tensor]
"""What a light makes of a white diffuse surface: radiance [S, C]."""


class ShadowCaster:
    """Depth maps of one portrait, made when a light is first asked for and kept for all views."""

    def __init__(self, portrait: Portrait) -> None:
        """A caster for a portrait."""
        self.portrait = portrait
        self._maps: dict[tuple[str, tuple[float, ...]], _DepthMap] = {}
        self._shares: dict[bytes | tuple[str | float, ...], torch.Tensor] = {}
        self._indirect: dict[Light, torch.Tensor] = {}

    def of_view(self, maps: Maps) -> ViewVisibility:
        """The visibility of lights from the pixels of a view."""
        return ViewVisibility(self, maps)

    def point(self, position: torch.Tensor) -> _DepthMap:
        """Depth map from a point light at [3]."""
        return self._cached("point", position, lambda: _from_point(self.portrait, position).map)

    def directional(self, to_light: torch.Tensor) -> _DepthMap:
        """Depth map from a distant light in a direction [3]."""
        return self._cached("distant", to_light, lambda: _from_afar(self.portrait, to_light, _CELL).map)

    def sphere(self, position: torch.Tensor, radius: float) -> torch.Tensor:
        """Share [P] of a ball of light at [3], of a radius in world units, that each of the points sees.

        From the subject a ball is a disc that faces it.
        """
        u, v, _ = _frame(self.portrait.points.mean(dim=0) - position.to(self.portrait.points))
        return self._share_of(
            ("sphere", *position.tolist(), radius),
            (
                _from_point(self.portrait, position.to(u) + radius * (x * u + y * v))
                for x, y in spiral(_SMALL_LIGHTS).tolist()
            ),
        )

    def cone(self, to_light: torch.Tensor, angle_rad: float) -> torch.Tensor:
        """Share [P] of a distant disc of light about a direction [3], of an angle across, that each point
        sees."""
        u, v, w = _frame(to_light.to(self.portrait.points))
        reach = math.tan(angle_rad / 2.0)
        return self._share_of(
            ("cone", *to_light.tolist(), angle_rad),
            (
                _from_afar(
                    self.portrait,
                    torch.nn.functional.normalize(w + reach * (x * u + y * v), dim=0),
                    _CELL,
                )
                for x, y in spiral(_SMALL_LIGHTS).tolist()
            ),
        )

    def environment(self, directions: torch.Tensor, irradiances: torch.Tensor) -> torch.Tensor:
        """Share [P, C] of the irradiance of many distant lights that reaches each of the points.

        Args:
            directions: [K, 3], unit, where the light comes from.
            irradiances: [K, C], at normal incidence.
        """
        key = directions.detach().cpu().numpy().tobytes() + irradiances.detach().cpu().numpy().tobytes()
        if key not in self._shares:
            portrait = self.portrait
            unshadowed = portrait.points.new_zeros(len(portrait.points), irradiances.shape[1])
            arriving = torch.zeros_like(unshadowed)
            for to_light, irradiance in zip(
                directions.to(unshadowed), irradiances.to(unshadowed), strict=True
            ):
                cosine = (portrait.normals_world @ to_light).clamp(min=0.0)
                lit = cosine * _from_afar(portrait, to_light, _CELL_MANY).visible_points()
                unshadowed += cosine[:, None] * irradiance
                arriving += lit[:, None] * irradiance
            dark = unshadowed <= 0
            self._shares[key] = torch.where(dark, 1.0, arriving / torch.where(dark, 1.0, unshadowed))
        return self._shares[key]

    @cached_property
    def interreflection(self) -> Interreflection:
        """What the subject's parts see of each other; found when first asked for, in a second or two."""
        return Interreflection(self.portrait, self.portrait.bounce_scale)

    def indirect(self, light: Light, arriving: Arriving) -> torch.Tensor:
        """What of a light comes to the surfels from other parts of the subject, [S, C], as the radiance of a
        white surface."""
        if light not in self._indirect:
            surfels = self.interreflection
            direct = arriving(Surface(surfels, _SurfelVisibility(self, surfels)))
            self._indirect[light] = surfels.indirect(direct)
        return self._indirect[light]

    def _share_of(self, key: tuple[str | float, ...], views: Iterable[_LightView]) -> torch.Tensor:
        """Share [P] of some lights that each of the points sees."""
        if key not in self._shares:
            self._shares[key] = torch.stack([view.visible_points() for view in views]).mean(dim=0)
        return self._shares[key]

    def _cached(self, kind: str, vector: torch.Tensor, make: Callable[[], _DepthMap]) -> _DepthMap:
        key = (kind, tuple(float(value) for value in vector))
        if key not in self._maps:
            self._maps[key] = make()
        return self._maps[key]


class ViewVisibility:
    """How much of a light each pixel of a view sees (the protocol `relight.surface.Visibility`)."""

    def __init__(self, caster: ShadowCaster, maps: Maps) -> None:
        """For `ShadowCaster.of_view`."""
        self._caster = caster
        self._maps = maps

    def point(self, position_world: torch.Tensor, radius: float = 0.0) -> torch.Tensor:
        """[H, W] 0..1 for a ball of light at [3], of a radius in world units; 0 = a point."""
        if radius > 0:
            return self._looked_up(self._caster.sphere(position_world, radius))
        return self._of_pixels(self._caster.point(position_world))

    def directional(self, to_light: torch.Tensor, angle_rad: float = 0.0) -> torch.Tensor:
        """[H, W] 0..1 for a distant disc of light, unit direction [3] and angle across; 0 = a point."""
        if angle_rad > 0:
            return self._looked_up(self._caster.cone(to_light, angle_rad))
        return self._of_pixels(self._caster.directional(to_light))

    def environment(self, directions: torch.Tensor, irradiances: torch.Tensor) -> torch.Tensor:
        """[H, W, C] share of the irradiance [K, C] of distant lights [K, 3]; 1 off the subject."""
        return self._looked_up(self._caster.environment(directions, irradiances))

    def indirect(self, light: Light, arriving: Arriving) -> torch.Tensor:
        """[H, W, C] of a light by way of other parts of the subject; 0 off the subject."""
        return self._of_surfels(self._caster.indirect(light, arriving))

    def _of_surfels(self, values: torch.Tensor) -> torch.Tensor:
        on = self._maps.point_ids >= 0
        result = values.new_zeros(*on.shape, values.shape[1])
        result[on] = self._caster.interreflection.of_points(values, self._maps.point_ids[on])
        return result

    def _looked_up(self, share: torch.Tensor) -> torch.Tensor:
        """Shares [P, ...] of the points in the pixels [H, W, ...]; 1 off the subject."""
        ids = self._maps.point_ids
        on = ids >= 0
        result = share.new_ones(*ids.shape, *share.shape[1:])
        result[on] = share[ids[on]]
        return result

    def _of_pixels(self, depth_map: _DepthMap) -> torch.Tensor:
        on = self._maps.mask > 0
        visible = torch.ones_like(self._maps.mask)
        visible[on] = depth_map.visible(self._maps.points_world[on], self._maps.normals_world[on])
        return visible


class _SurfelVisibility:
    """How much of a light each surfel sees; light that comes by way of others is not asked for there."""

    def __init__(self, caster: ShadowCaster, surfels: Interreflection) -> None:
        self._caster, self._surfels = caster, surfels

    def point(self, position_world: torch.Tensor, radius: float = 0.0) -> torch.Tensor:
        if radius > 0:
            return self._caster.sphere(position_world, radius)[self._surfels.ids]
        return self._seen(self._caster.point(position_world))

    def directional(self, to_light: torch.Tensor, angle_rad: float = 0.0) -> torch.Tensor:
        if angle_rad > 0:
            return self._caster.cone(to_light, angle_rad)[self._surfels.ids]
        return self._seen(self._caster.directional(to_light))

    def environment(self, directions: torch.Tensor, irradiances: torch.Tensor) -> torch.Tensor:
        return self._caster.environment(directions, irradiances)[self._surfels.ids]

    def indirect(self, light: Light, arriving: Arriving) -> None:
        return None

    def _seen(self, depth_map: _DepthMap) -> torch.Tensor:
        return depth_map.visible(self._surfels.points_world, self._surfels.normals_world)


@dataclass(frozen=True, eq=False)
class _DepthMap:
    """Nearest depth from a light on a grid.

    Attributes:
        axes: [3, 3], rows u, v, w; w points from the light (or along its rays) into the scene.
        position: [3] of a point light; None for a distant one.
        low: [2], grid coordinates of the map's corner.
        cell: Width of a cell: world units for a distant light, radians for a point.
        depth: [rows, columns], distance from the light or along its rays; inf where there is nothing.
        cell_size: Of a cell at the subject, world units.
        bias: World units.
    """

    axes: torch.Tensor
    position: torch.Tensor | None
    low: torch.Tensor
    cell: float
    depth: torch.Tensor
    cell_size: float
    bias: float

    def visible(self, points: torch.Tensor, normals: torch.Tensor, soft: bool = True) -> torch.Tensor:
        """[P] 0..1 for points [P, 3] with unit normals [P, 3]; `soft` interpolates between four cells."""
        return self.visible_at(_coordinates(points, self.axes, self.position), normals, soft)

    def visible_at(self, coordinates: _Coordinates, normals: torch.Tensor, soft: bool) -> torch.Tensor:
        """The same, for points whose coordinates from the light are known."""
        grid, depth, towards = coordinates
        cosine = (normals * towards).sum(dim=1)
        slope = (1.0 - cosine**2).clamp(min=0.0).sqrt() / cosine.clamp(min=1.0 / _STEEPEST)
        limit = depth - self.bias - _SLANT * self.cell_size * slope.clamp(max=_STEEPEST)
        at = (grid - self.low) / self.cell
        rows, columns = self.depth.shape
        flat = self.depth.flatten()

        def lit(column: torch.Tensor, row: torch.Tensor) -> torch.Tensor:
            place = row.clamp(0, rows - 1) * columns + column.clamp(0, columns - 1)
            return (limit <= flat[place]).to(depth)

        if not soft:
            whole = at.floor().long()
            return lit(whole[:, 0], whole[:, 1])
        corner = (at - 0.5).floor()
        x, y = (at - 0.5 - corner).unbind(1)
        column, row = corner.long().unbind(1)
        upper = (1 - x) * lit(column, row) + x * lit(column + 1, row)
        lower = (1 - x) * lit(column, row + 1) + x * lit(column + 1, row + 1)
        return (1 - y) * upper + y * lower


@dataclass(frozen=True, eq=False)
class _LightView:
    """A portrait from a light: the depth map, and where its points are in it."""

    map: _DepthMap
    coordinates: _Coordinates
    normals: torch.Tensor

    def visible_points(self) -> torch.Tensor:
        """[P] 0 or 1, whether each point of the portrait sees the light."""
        return self.map.visible_at(self.coordinates, self.normals, soft=False)


def seen_from(
    surface: Reflecting, position: torch.Tensor, points: torch.Tensor, normals: torch.Tensor
) -> torch.Tensor:
    """[N] 0 or 1, whether some points [N, 3] with unit normals [N, 3] are seen from [3] past a surface."""
    return _from_point(surface, position).map.visible(points, normals, soft=False)


def _from_point(portrait: Reflecting, position: torch.Tensor) -> _LightView:
    position = position.to(portrait.points)
    centre = portrait.points.mean(dim=0)
    axis = centre - position
    distance = float(torch.linalg.vector_norm(portrait.points - position, dim=1).median())
    if float(torch.linalg.vector_norm(axis)) < 1e-9:
        axis = axis.new_tensor([0.0, 0.0, 1.0])
    cell = _CELL * portrait.spacing / max(distance, portrait.spacing)
    return _build(portrait, _frame(axis), position, cell, _CELL * portrait.spacing)


def _from_afar(portrait: Reflecting, to_light: torch.Tensor, cell: float) -> _LightView:
    size = cell * portrait.spacing
    return _build(portrait, _frame(-to_light.to(portrait.points)), None, size, size)


def _build(
    portrait: Reflecting, axes: torch.Tensor, position: torch.Tensor | None, cell: float, cell_size: float
) -> _LightView:
    coordinates = _coordinates(portrait.points, axes, position)
    grid, depth, _ = coordinates
    low, high = grid.min(dim=0).values, grid.max(dim=0).values
    cell = max(cell, float((high - low).max()) / _LARGEST_SIDE)
    low = low - 1.5 * cell
    columns, rows = (((high - low) / cell).long() + 2).tolist()
    place = ((grid - low) / cell).long()
    nearest = depth.new_full((rows * columns,), torch.inf)
    nearest.scatter_reduce_(0, place[:, 1] * columns + place[:, 0], depth, "amin")
    nearest = nearest.view(1, 1, rows, columns)
    around = -torch.nn.functional.max_pool2d(-nearest, 3, 1, 1)
    nearest = torch.where(torch.isinf(nearest), around, nearest)[0, 0]
    depth_map = _DepthMap(axes, position, low, cell, nearest, cell_size, _BIAS * portrait.spacing)
    return _LightView(depth_map, coordinates, portrait.normals_world)


def _coordinates(points: torch.Tensor, axes: torch.Tensor, position: torch.Tensor | None) -> _Coordinates:
    """Grid coordinates [P, 2], depth [P] and unit directions to the light [P, 3] or [1, 3].

    The grid of a distant light is the plane across its rays; that of a point light is azimuthal equidistant
    about the axis, in radians, which has no edge at any angle short of straight behind the light.
    """
    if position is None:
        local = points @ axes.T
        return local[:, :2], local[:, 2], -axes[2:3]
    local = (points - position) @ axes.T
    across = torch.linalg.vector_norm(local[:, :2], dim=1)
    distance = torch.linalg.vector_norm(local, dim=1)
    angle = torch.atan2(across, local[:, 2])
    grid = local[:, :2] * (angle / across.clamp(min=1e-12))[:, None]
    return grid, distance, (position - points) / distance.clamp(min=1e-12)[:, None]


def _frame(axis: torch.Tensor) -> torch.Tensor:
    """[3, 3] right-handed orthonormal rows, the last along the axis."""
    w = axis / torch.linalg.vector_norm(axis).clamp(min=1e-12)
    helper = (
        w.new_tensor([1.0, 0.0, 0.0]) if abs(float(w[0])) < math.sqrt(0.5) else w.new_tensor([0.0, 1.0, 0.0])
    )
    u = torch.linalg.cross(helper, w)
    u = u / torch.linalg.vector_norm(u)
    return torch.stack([u, torch.linalg.cross(w, u), w])
