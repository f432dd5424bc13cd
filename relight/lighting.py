"""Lights, and the radiance of a Lambertian surface under them, all linear (Sevastopolsky 2020, eqs. 4-7).

Letters as in the paper: A albedo (0..1), n unit normal, C_room and C_flash the colours of the captured
lights, F the flash flag, s the room shading, M the spherical harmonics matrix; d and l are the distance and
unit direction from a point to a light, V in 0..1 is how much of a light a point sees.

    captured      A C_room s + F A C_flash / d^2 max(0, <n, l>)      the light of the camera's own frame
    room          A C_room s
    flash         A C_flash / d^2 max(0, <n, l>)                     always on
    directional   A color (ambient + (1 - ambient) V max(0, <n, l>))
    point         A C / d^2 V max(0, <n, l>)                         C = intensity / pi
    environment   A / pi E(n)                                        E the irradiance of a panorama
    sh            A / pi max(0, [n 1] M [n 1]^T)

A light that casts shadows also bounces: what arrives by way of other parts of the subject is added to the
term that A multiplies (`relight.interreflection`). So does the capture's flash: near the camera it is a
factor that comes with the portrait (`relight.flash_bounces`). With a reflectance point lights and
environments have its gloss and its retro-reflection too.

The flash casts no shadow: what it does not reach is hidden from the camera beside it (paper, eq. 4). Where
the normal is zero all terms with n are zero, and the room's and the ambient term remain; `surface` says what
else happens at the edges.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from relight.environment import DiffuseIrradiance, cluster_lights
from relight.lamp import Lamp, beam
from relight.panorama import panorama_to_sh, read_panorama
from relight.prefiltering import GlossyEnvironment, even_light
from relight.spherical_harmonics import (
    bands_of,
    irradiance_matrix,
    quadratic_irradiance,
    rotation_about_up,
    sh_irradiance,
)
from relight.surface import MIN_DISTANCE_M, Surface, SurfaceMaps, cosine, cosine_falloff, direction_to
from relight.surface import Visibility as Visibility

if TYPE_CHECKING:
    from capture.cameras import Camera
    from relight.reflectance import Reflectance

Vector = tuple[float, float, float]

_WIDEST_DEG = 120.0  # of a distant disc of light: what is wider is an environment


def shade(
    light: Light,
    maps: SurfaceMaps,
    *,
    camera: Camera | None = None,
    c_room: ArrayLike | Tensor | None = None,
    c_flash: ArrayLike | Tensor | None = None,
    flash_offset_cam_m: ArrayLike | Tensor | None = None,
    flash: int | None = None,
    visibility: Visibility | None = None,
    reflectance: Reflectance | None = None,
    lamp: Lamp | None = None,
) -> Tensor:
    """Radiance of the surface under a light, differentiable in the maps and colours.

    Args:
        light: any light of this module.
        maps: albedo [..., 3], normals_world [..., 3], shading [...], mask [...], points_world [..., 3]
            (metres).
        camera: whose flash shines; only lights with the flash need it.
        c_room: [3], the room light's colour; only lights with the room need it.
        c_flash: [3], the flash's colour, times metre^2; only lights with the flash need it.
        flash_offset_cam_m: [3], lens to flash in the camera's axes; by default zero, the paper's co-located
            flash.
        flash: flag F of a captured light; by default the camera's own, and 0 where that is unknown.
        visibility: for shadows; without it nothing is in shadow.
        reflectance: of the subject, for the flash, point lights and environments; by default it is
            Lambertian.
        lamp: how the flash shines; by default equally in all directions.

    Returns:
        [..., 3], linear, not premultiplied, 0 where the mask is 0; float32 or float64 as the maps.

    Raises:
        ValueError: the light needs the camera, c_room or c_flash and they are not given.
    """
    surface = Surface(maps, visibility)
    if not len(surface):
        return torch.zeros_like(maps.albedo)
    if flash is None and camera is not None:
        flash = camera.flash
    capture = CaptureLight(camera, c_room, c_flash, flash_offset_cam_m, bool(flash), reflectance, lamp)
    return surface.scatter(light.radiance(surface, capture))


@dataclass(frozen=True, eq=False)
class CaptureLight:
    """The light that a frame was captured in: room, and the flash beside the lens; fields as in `shade`."""

    camera: Camera | None
    c_room: ArrayLike | Tensor | None
    c_flash: ArrayLike | Tensor | None
    flash_offset_cam_m: ArrayLike | Tensor | None
    flash: bool
    reflectance: Reflectance | None = None
    lamp: Lamp | None = None

    def room_radiance(self, surface: Surface) -> Tensor:
        """A C_room s: [P, 3]; or what the maps know of it in colour."""
        if surface.room_radiance is not None:
            return surface.room_radiance
        if self.c_room is None:
            raise ValueError("a light with the room in it needs c_room")
        return surface.albedo * surface.vector(self.c_room) * surface.shading

    def flash_radiance(self, surface: Surface) -> Tensor:
        """A C_flash / d^2 max(0, <n, l>) cos(angle to its axis)^mu: [P, 3]; or what the maps know of it."""
        if surface.flash_radiance is not None:
            return surface.flash_radiance
        if self.c_flash is None or self.camera is None:
            raise ValueError("a light with the flash in it needs c_flash and the camera")
        position = surface.vector(self.camera.centre_world)
        if self.flash_offset_cam_m is not None:
            cam_from_world = surface.vector(self.camera.cam_from_world[:3, :3])
            position = position + surface.vector(self.flash_offset_cam_m) @ cam_from_world
        radiance = surface.vector(self.c_flash) * self.response(surface, position, surface.flash_albedo)
        radiance = radiance * surface.flash_gain
        if self.lamp is None or self.lamp.falloff == 0:
            return radiance
        to_light, _ = direction_to(surface.points, position)
        axis = surface.vector(self.lamp.axis_world(self.camera.cam_from_world))
        return radiance * beam(to_light, axis, self.lamp.falloff)[:, None]

    def response(self, surface: Surface, position: Tensor, albedo: Tensor | None = None) -> Tensor:
        """Radiance [P, 3] under a point light of unit colour at [3], without shadows.

        The albedo [P, 3] is the surface's where no other is given.
        """
        albedo = surface.albedo if albedo is None else albedo
        if self.reflectance is None or self.camera is None:
            return albedo * cosine_falloff(surface.points, surface.normals, position)[:, None]
        to_light, distance = direction_to(surface.points, position)
        to_view = self.to_view(surface)
        response = self.reflectance.response(albedo, surface.normals, to_light, to_view, surface.gloss)
        return response / distance.clamp(min=MIN_DISTANCE_M) ** 2

    def to_view(self, surface: Surface) -> Tensor:
        """Unit directions [P, 3] from the points to the camera; only where there is one."""
        assert self.camera is not None
        return direction_to(surface.points, surface.vector(self.camera.centre_world))[0]


class Light(ABC):
    """A light; `+` adds lights."""

    @abstractmethod
    def radiance(self, surface: Surface, capture: CaptureLight) -> Tensor:
        """Radiance [P, 3] of the surface's points, linear."""

    def __add__(self, other: Light) -> SumLight:
        return SumLight((self, other))


@dataclass(frozen=True)
class CapturedLight(Light):
    """The light of the camera's own frame: the room, and the flash where the flag F is 1."""

    def radiance(self, surface: Surface, capture: CaptureLight) -> Tensor:  # noqa: D102
        room = capture.room_radiance(surface)
        return room + capture.flash_radiance(surface) if capture.flash else room


@dataclass(frozen=True)
class RoomLight(Light):
    """The captured room without the flash."""

    def radiance(self, surface: Surface, capture: CaptureLight) -> Tensor:  # noqa: D102
        return capture.room_radiance(surface)


@dataclass(frozen=True)
class FlashLight(Light):
    """The flash alone, whatever the flag says."""

    def radiance(self, surface: Surface, capture: CaptureLight) -> Tensor:  # noqa: D102
        return capture.flash_radiance(surface)


@dataclass(frozen=True)
class DirectionalLight(Light):
    """A distant light with an ambient share (Sevastopolsky 2020, experiments).

    Attributes:
        to_light: [3], direction towards the light, world, of any length but zero.
        ambient: share 0..1 of the light that reaches every point.
        color: [3], radiance of a white surface that faces the light.
        shadows: whether a visibility casts shadows. Off, as in the paper's formula; the ambient share has
            none.
        angle_deg: across the light, as seen from the subject: the sun's is 0.53. Above 0 shadows are soft.
    """

    to_light: Vector
    ambient: float = 0.0
    color: Vector = (1.0, 1.0, 1.0)
    shadows: bool = False
    angle_deg: float = 0.0

    def __post_init__(self) -> None:
        length = math.hypot(*self.to_light)
        if not 0.0 < length < math.inf:
            raise ValueError(f"to_light is {self.to_light}; it must be a direction of finite length above 0")
        if not 0.0 <= self.ambient <= 1.0:
            raise ValueError(f"ambient is {self.ambient}; it must lie in 0..1")
        if not 0.0 <= self.angle_deg <= _WIDEST_DEG:
            raise ValueError(f"angle is {self.angle_deg}; it must lie in 0..{_WIDEST_DEG:g} degrees")

    def radiance(self, surface: Surface, capture: CaptureLight) -> Tensor:  # noqa: D102
        arriving: Tensor = self.ambient + (1.0 - self.ambient) * self._direct(surface)
        if self.shadows:
            arriving = arriving + (1.0 - self.ambient) * surface.indirect(self, self._direct)
        return surface.albedo * surface.vector(self.color) * arriving

    def _direct(self, surface: Surface) -> Tensor:
        """V max(0, <n, l>), [P, 3]."""
        to_light = surface.vector(np.divide(self.to_light, math.hypot(*self.to_light)))
        direct = cosine(surface.normals, to_light)
        if self.shadows:
            direct = direct * surface.sees_direction(to_light, math.radians(self.angle_deg))
        return direct[:, None].expand(-1, 3)


@dataclass(frozen=True)
class PointLight(Light):
    """A point light; add it to a `RoomLight` for a lamp in the captured room.

    Attributes:
        position: [3], metres, world.
        C: [3], intensity / pi: the radiance of a white surface that faces the light from one metre.
        shadows: whether a visibility casts shadows.
        radius: of the light, metres. Above 0 shadows are soft.
    """

    position: Vector
    C: Vector = (1.0, 1.0, 1.0)
    shadows: bool = True
    radius: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.radius < math.inf:
            raise ValueError(f"radius is {self.radius}; it must be finite and at least 0")

    def radiance(self, surface: Surface, capture: CaptureLight) -> Tensor:  # noqa: D102
        position = surface.vector(self.position)
        if not self.shadows:
            return surface.vector(self.C) * capture.response(surface, position)
        direct = capture.response(surface, position) * self._visible(surface, position)
        return surface.vector(self.C) * direct + surface.albedo * surface.indirect(self, self._direct)

    def _direct(self, surface: Surface) -> Tensor:
        """C / d^2 V max(0, <n, l>), [P, 3]."""
        position = surface.vector(self.position)
        falloff = cosine_falloff(surface.points, surface.normals, position)[:, None]
        return surface.vector(self.C) * falloff * self._visible(surface, position)

    def _visible(self, surface: Surface, position: Tensor) -> Tensor | float:
        visible = surface.sees_point(position, self.radius)
        return visible[:, None] if isinstance(visible, Tensor) else visible


@dataclass(frozen=True, eq=False)
class SphericalHarmonicsLight(Light):
    """A smooth environment from a few coefficients (Sevastopolsky 2020, eq. 7); it casts no shadows.

    Attributes:
        coefficients: [B^2, 3] of incident radiance, in the basis and order of `spherical_harmonics`. Up to
            nine (the paper's third order) go through the quadratic form, more through the basis. An
            environment of radiance 1, under which a white surface has radiance 1, has 2 sqrt(pi) = 3.545 in
            the first row and zeros below.
    """

    coefficients: Tensor

    def __post_init__(self) -> None:
        bands_of(self.coefficients)

    def radiance(self, surface: Surface, capture: CaptureLight) -> Tensor:  # noqa: D102
        coefficients = surface.vector(self.coefficients)
        if bands_of(coefficients) <= 3:
            coefficients = torch.nn.functional.pad(coefficients, (0, 0, 0, 9 - len(coefficients)))
            irradiance = quadratic_irradiance(irradiance_matrix(coefficients), surface.normals)
        else:
            irradiance = sh_irradiance(coefficients, surface.normals)
        return surface.albedo / math.pi * _lit_side(irradiance, surface.normals)


@dataclass(frozen=True, eq=False)
class EnvironmentLight(Light):
    """A panorama all around, as distant light.

    Attributes:
        panorama: [H, W, 3], lat-long, linear (see `panorama`); `from_file` reads one.
        rotate_deg: turns the panorama about the world's up, right-handed: +90 brings what was at +Z to +X.
        gain: factor on its radiance.
        method: "exact" integrates the cosine over the panorama; "sh" goes through nine coefficients, without
            shadows.
        shadows: whether a visibility casts shadows.
        shadow_lights: how many distant lights stand for the panorama in its shadows; on a head under two real
            panoramas, 64 are within 0.15 dB of 256.
    """

    panorama: NDArray[np.floating] = field(repr=False)
    rotate_deg: float = 0.0
    gain: float = 1.0
    method: str = "exact"
    shadows: bool = True
    shadow_lights: int = 64

    def __post_init__(self) -> None:
        if self.method not in ("exact", "sh"):
            raise ValueError(f"method is {self.method!r}; it must be exact or sh")
        if self.panorama.ndim != 3 or self.panorama.shape[2] != 3 or self.panorama.size == 0:
            raise ValueError(f"a panorama has the shape [H, W, 3], not {list(self.panorama.shape)}")

    @classmethod
    def from_file(cls, path: Path, **options: Any) -> EnvironmentLight:
        """The light of a .hdr or .exr panorama; options are the other attributes."""
        return cls(read_panorama(path), **options)

    def radiance(self, surface: Surface, capture: CaptureLight) -> Tensor:  # noqa: D102
        if self.method == "sh":
            normals = surface.normals @ self._world_from_panorama(surface)
            irradiance = _lit_side(quadratic_irradiance(surface.vector(self._matrix), normals), normals)
            return surface.albedo * (self.gain / math.pi) * irradiance
        share = self._share(surface) if self.shadows else 1.0
        direct = self._unshadowed(surface) * share
        gloss: Tensor | float = 0.0
        if capture.reflectance is not None and capture.camera is not None:
            diffuse, gloss = self._reflected(surface, capture.reflectance, capture.to_view(surface))
            direct = direct * diffuse
            # Where the sky is hidden from the normal's side it is, on the whole, from the mirror's too.
            gloss = gloss * share
        if not self.shadows:
            return surface.albedo * direct + gloss
        return surface.albedo * (direct + surface.indirect(self, self._direct)) + gloss

    def _direct(self, surface: Surface) -> Tensor:
        """Radiance of a white surface [P, 3], with shadows."""
        return self._unshadowed(surface) * self._share(surface)

    def _unshadowed(self, surface: Surface) -> Tensor:
        """E(n) / pi, [P, 3]."""
        normals = surface.normals @ self._world_from_panorama(surface)
        return (self.gain / math.pi) * self._irradiance(normals)

    def _share(self, surface: Surface) -> Tensor | float:
        """What of the irradiance arrives, [P, 3].

        A share of few lights times the exact integral: without any shadow it is exactly one, so few cost no
        accuracy there (Heitz 2018, "Combining analytic direct illumination and stochastic shadows").
        """
        directions, irradiances = (surface.vector(part) for part in self._lights)
        return surface.environment_share(directions @ self._world_from_panorama(surface).T, irradiances)

    def _reflected(
        self, surface: Surface, reflectance: Reflectance, to_view: Tensor
    ) -> tuple[Tensor, Tensor | float]:
        """Factor [P, 1] on the diffuse part, and radiance [P, 3] of the gloss, of the whole panorama."""
        view = (surface.normals * to_view).sum(dim=-1, keepdim=True)
        diffuse, gloss = even_light(reflectance, view[:, 0])
        if reflectance.f0 <= 0:
            return diffuse[:, None], 0.0
        if reflectance.alpha not in self._blurred:
            self._blurred[reflectance.alpha] = GlossyEnvironment.of_panorama(self.panorama, reflectance.alpha)
        mirrored = 2.0 * view * surface.normals - to_view
        mean = self._blurred[reflectance.alpha](mirrored @ self._world_from_panorama(surface))
        gloss = gloss * (surface.normals != 0).any(dim=-1)
        factor = 1.0 if surface.gloss is None else surface.gloss
        return diffuse[:, None], self.gain * mean * gloss[:, None] * factor

    def _world_from_panorama(self, surface: Surface) -> Tensor:
        """[3, 3]; directions as rows go into the panorama's axes by `@` this."""
        return surface.vector(rotation_about_up(self.rotate_deg))

    @cached_property
    def _irradiance(self) -> DiffuseIrradiance:
        return DiffuseIrradiance.of_panorama(self.panorama)

    @cached_property
    def _blurred(self) -> dict[float, GlossyEnvironment]:
        return {}

    @cached_property
    def _matrix(self) -> Tensor:
        return irradiance_matrix(panorama_to_sh(self.panorama, bands=3))

    @cached_property
    def _lights(self) -> tuple[Tensor, Tensor]:
        return cluster_lights(self.panorama, self.shadow_lights)


@dataclass(frozen=True)
class SumLight(Light):
    """Several lights at once."""

    parts: tuple[Light, ...]

    def radiance(self, surface: Surface, capture: CaptureLight) -> Tensor:  # noqa: D102
        return torch.stack([part.radiance(surface, capture) for part in self.parts]).sum(dim=0)


def _lit_side(irradiance: Tensor, normals: Tensor) -> Tensor:
    """Irradiance [P, 3] from few bands, 0 where they ring below it and where the normal is zero."""
    return irradiance.clamp(min=0.0) * (normals != 0).any(dim=-1, keepdim=True)
