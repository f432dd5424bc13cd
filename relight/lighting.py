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
from relight.panorama import panorama_to_sh, read_panorama
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
        reflectance: of the subject, for the flash and point lights; by default it is Lambertian.

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
    capture = CaptureLight(camera, c_room, c_flash, flash_offset_cam_m, bool(flash), reflectance)
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

    def room_radiance(self, surface: Surface) -> Tensor:
        """A C_room s: [P, 3]; or what the maps know of it in colour."""
        if surface.room_radiance is not None:
            return surface.room_radiance
        if self.c_room is None:
            raise ValueError("a light with the room in it needs c_room")
        return surface.albedo * surface.vector(self.c_room) * surface.shading

    def flash_radiance(self, surface: Surface) -> Tensor:
        """A C_flash / d^2 max(0, <n, l>): [P, 3]; or what the maps know of it."""
        if surface.flash_radiance is not None:
            return surface.flash_radiance
        if self.c_flash is None or self.camera is None:
            raise ValueError("a light with the flash in it needs c_flash and the camera")
        position = surface.vector(self.camera.centre_world)
        if self.flash_offset_cam_m is not None:
            cam_from_world = surface.vector(self.camera.cam_from_world[:3, :3])
            position = position + surface.vector(self.flash_offset_cam_m) @ cam_from_world
        return surface.vector(self.c_flash) * self.response(surface, position)

    def response(self, surface: Surface, position: Tensor) -> Tensor:
        """Radiance [P, 3] under a point light of unit colour at [3], without shadows."""
        falloff = cosine_falloff(surface.points, surface.normals, position)[:, None]
        if self.reflectance is None or self.camera is None:
            return surface.albedo * falloff
        to_light, distance = direction_to(surface.points, position)
        to_view, _ = direction_to(surface.points, surface.vector(self.camera.centre_world))
        response = self.reflectance.response(
            surface.albedo, surface.normals, to_light, to_view, surface.gloss
        )
        return response / distance.clamp(min=MIN_DISTANCE_M) ** 2


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
    """

    to_light: Vector
    ambient: float = 0.0
    color: Vector = (1.0, 1.0, 1.0)
    shadows: bool = False

    def __post_init__(self) -> None:
        length = math.hypot(*self.to_light)
        if not 0.0 < length < math.inf:
            raise ValueError(f"to_light is {self.to_light}; it must be a direction of finite length above 0")
        if not 0.0 <= self.ambient <= 1.0:
            raise ValueError(f"ambient is {self.ambient}; it must lie in 0..1")

    def radiance(self, surface: Surface, capture: CaptureLight) -> Tensor:  # noqa: D102
        to_light = surface.vector(np.divide(self.to_light, math.hypot(*self.to_light)))
        direct = cosine(surface.normals, to_light)
        if self.shadows:
            direct = direct * surface.sees_direction(to_light)
        share = self.ambient + (1.0 - self.ambient) * direct
        return surface.albedo * surface.vector(self.color) * share[:, None]


@dataclass(frozen=True)
class PointLight(Light):
    """A point light; add it to a `RoomLight` for a lamp in the captured room.

    Attributes:
        position: [3], metres, world.
        C: [3], intensity / pi: the radiance of a white surface that faces the light from one metre.
        shadows: whether a visibility casts shadows.
    """

    position: Vector
    C: Vector = (1.0, 1.0, 1.0)
    shadows: bool = True

    def radiance(self, surface: Surface, capture: CaptureLight) -> Tensor:  # noqa: D102
        position = surface.vector(self.position)
        radiance = surface.vector(self.C) * capture.response(surface, position)
        if self.shadows:
            visible = surface.sees_point(position)
            radiance = radiance * (visible[:, None] if isinstance(visible, Tensor) else visible)
        return radiance


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
        world_from_panorama = surface.vector(rotation_about_up(self.rotate_deg))
        normals = surface.normals @ world_from_panorama  # as rows: panorama_from_world @ n
        if self.method == "sh":
            irradiance = _lit_side(quadratic_irradiance(surface.vector(self._matrix), normals), normals)
        else:
            irradiance = self._irradiance(normals)
            if self.shadows:
                # A share of few lights times the exact integral: without any shadow it is exactly one, so few
                # cost no accuracy there (Heitz 2018, "Combining analytic direct illumination and stochastic
                # shadows").
                directions, irradiances = (surface.vector(part) for part in self._lights)
                directions = directions @ world_from_panorama.T
                irradiance = irradiance * surface.environment_share(directions, irradiances)
        return surface.albedo * (self.gain / math.pi) * irradiance

    @cached_property
    def _irradiance(self) -> DiffuseIrradiance:
        return DiffuseIrradiance.of_panorama(self.panorama)

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
