"""A subject of formulas: an ellipsoid the size of a head, pictures of it, points of it, and a portrait.

Rays are cut with it in closed form, its normals are the gradient, its albedo and room light are smooth
functions, and the flash is a near point beside the lens. So a stage can be asked about the truth, in float64,
without any file.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from capture.cameras import Camera
from relight.portrait import Portrait
from relight.reflectance import Reflectance

Floats = NDArray[np.float64]

AXES_M = np.array([0.085, 0.115, 0.100])
FLASH_OFFSET_CAM_M = np.array([0.015, -0.01, 0.0])
_GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))


@dataclass(frozen=True)
class Subject:
    """What is filmed, and the light.

    Attributes:
        albedo: Factor on the albedo; 0 = black.
        jacket: Factor on the albedo below the chin.
        room: Radiance of a white surface under the brightest of the room's light.
        flash: Radiance of a white surface that faces the flash from one metre, before it.
        beam: mu of the flash's cos(angle to the optical axis)^mu.
    """

    albedo: float = 1.0
    jacket: float = 1.0
    room: float = 0.25
    flash: float = 0.11
    beam: float = 0.0

    def albedo_at(self, points: Floats) -> Floats:
        """[..., 3] at points [..., 3] of the surface, between 0.2 and 0.7 times the factors."""
        wave = np.sin(points @ np.array([[30.0, 40.0, 0.0], [-35.0, 25.0, 20.0], [15.0, 0.0, 45.0]]).T)
        colour = np.array([0.55, 0.42, 0.35]) + np.array([0.12, 0.12, 0.1]) * wave
        return self.albedo * np.where(points[..., 1:2] < -0.03, self.jacket, 1.0) * colour

    def radiance(self, points: Floats, camera: Camera) -> Floats:
        """[..., 3] at points [..., 3] of the surface, as a camera with its flag sees them."""
        normals = normals_at(points)
        window = 0.6 + 0.4 * normals @ np.array([0.48, 0.6, 0.64])
        irradiance = self.room * window[..., None] * np.array([1.0, 0.96, 0.9])
        if camera.flash:
            towards = flash_position(camera) - points
            square = (towards**2).sum(axis=-1, keepdims=True)
            cosine = (normals * towards).sum(axis=-1, keepdims=True) / np.sqrt(square)
            ahead = -(towards @ camera.cam_from_world[2, :3])[..., None] / np.sqrt(square)
            beam = ahead.clip(min=0.0) ** self.beam
            irradiance = irradiance + self.flash * beam / square * cosine.clip(min=0.0)
        return self.albedo_at(points) * irradiance


SUBJECT = Subject()
"""As it is filmed where nothing is said."""


def normals_at(points: Floats) -> Floats:
    """Unit outward normals [..., 3] at points [..., 3] of the ellipsoid."""
    gradient = points / AXES_M**2
    return gradient / np.linalg.norm(gradient, axis=-1, keepdims=True)


def surface_points(count: int) -> Floats:
    """Points [count, 3] spread over the ellipsoid (a Fibonacci sphere, stretched)."""
    return sphere_points(count) * AXES_M


def sphere_points(count: int) -> Floats:
    """Even unit directions [count, 3]."""
    i = np.arange(count) + 0.5
    z, phi = 1.0 - 2.0 * i / count, i * _GOLDEN_ANGLE
    ring = np.sqrt(1.0 - z * z)
    return np.stack([ring * np.cos(phi), ring * np.sin(phi), z], axis=1)


def looking_at_origin(eye: Sequence[float] | Floats, size: int, flash: int | None = None) -> Camera:
    """A camera at [3] metres that looks at the origin, the world's +Y up in its picture."""
    centre = np.asarray(eye, dtype=np.float64)
    forward = -centre / np.linalg.norm(centre)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    cam_from_world = np.eye(4)
    cam_from_world[:3, :3] = [right, np.cross(forward, right), forward]
    cam_from_world[:3, 3] = -cam_from_world[:3, :3] @ centre
    focal_px = 1.75 * size
    intrinsics = np.array([[focal_px, 0, size / 2], [0, focal_px, size / 2], [0, 0, 1.0]])
    return Camera("stress", size, size, intrinsics, cam_from_world, flash=flash)


def arc(count: int, size: int = 48) -> list[Camera]:
    """Cameras half a metre away from -70 to +70 degrees about the subject, every other one with the flash."""
    cameras = []
    for k, azimuth in enumerate(np.radians(np.linspace(-70.0, 70.0, count))):
        eye = 0.5 * np.array([np.sin(azimuth), 0.24 * np.sin(2.1 * k), np.cos(azimuth)])
        cameras.append(replace(looking_at_origin(eye, size, flash=k % 2), name=f"{k:04d}"))
    return cameras


def flash_position(camera: Camera) -> Floats:
    """[3] of the camera's flash, world, metres."""
    position: Floats = camera.centre_world + camera.cam_from_world[:3, :3].T @ FLASH_OFFSET_CAM_M
    return position


def photograph(subject: Subject, camera: Camera) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Radiance [H, W, 3] and where the subject is [H, W], sampled at the pixels' centres."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width] + 0.5
    rays = (
        np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(camera.K).T @ camera.cam_from_world[:3, :3]
    )
    origin, along = camera.centre_world / AXES_M, rays / AXES_M
    a, b, c = (along**2).sum(axis=-1), (along * origin).sum(axis=-1), (origin**2).sum() - 1.0
    root = b * b - a * c
    hit = root > 0.0
    points = camera.centre_world + ((-b - np.sqrt(root.clip(min=0.0))) / a)[..., None] * rays
    radiance = np.where(hit[..., None], subject.radiance(points, camera), 0.0)
    return radiance.astype(np.float32), hit


def portrait(count: int = 3000, dtype: torch.dtype = torch.float32, points: Floats | None = None) -> Portrait:
    """The subject's portrait as the formulas have it, of an even sphere's points or of the given ones."""
    given = 0.1 * sphere_points(count) if points is None else points
    length = np.linalg.norm(given, axis=1, keepdims=True)
    normals = given / np.where(length > 0, length, 1.0)
    albedo = SUBJECT.albedo_at(given)

    def tensor(values: Floats) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(values)).to(dtype)

    ones = torch.ones(len(given), dtype=dtype)
    return Portrait(
        points=tensor(given),
        normals_world=tensor(normals),
        albedo=tensor(albedo),
        room_radiance=tensor(SUBJECT.room * albedo),
        shading=0.5 * ones,
        gloss=ones.clone(),
        flash_bounce=torch.zeros_like(ones),
        confidence=ones.clone(),
        albedo_sigma=0.01 * ones,
        normal_sigma_rad=0.01 * ones,
        residual=0.01 * ones,
        spacing=0.1 * float(np.sqrt(4.0 * np.pi / max(count, 16))),
        c_room=(SUBJECT.room,) * 3,
        c_flash=(SUBJECT.flash,) * 3,
        flash_offset_cam_m=tuple(FLASH_OFFSET_CAM_M.tolist()),
        reflectance=Reflectance(0.25, 0.25, 0.04),
        bounce_scale=1.0,
        info={},
    )
