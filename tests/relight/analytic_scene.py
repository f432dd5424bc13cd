"""A subject whose surface, colour and lights are formulas, and frames of it made without relight's code.

The surface is the zero of f(x) = |x / axes| - 1 - bump(x), an ellipsoid the size of a head with soft bumps.
Rays are cut with it by marching and bisection, normals are its gradient, albedo and room light are smooth
functions, and the flash is a near point beside the lens. Pixels are point samples at their centres (0.5), in
the units of the project: metres, radiance 1.0 = white clip, OpenCV axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch

from calib.calibration import Calibration, save_calibration
from capture.calibration_file import Quantity
from capture.cameras import Camera
from capture.images import write_png
from capture.ply import PointCloud, write_ply
from capture.radiometry import Radiometry
from capture.response import Response
from capture.session import FrameRecord, Session
from relight.lamp import Lamp
from relight.portrait import Portrait
from relight.reflectance import Reflectance
from relight.scene import NoiseModel, Observation, View

AXES_M = np.array([0.085, 0.115, 0.100])
FLASH_OFFSET_CAM_M = np.array([0.015, -0.01, 0.0])
C_FLASH = 0.11  # radiance of a white surface that faces the flash from one metre, all channels
_WAVES = np.array([[55.0, 20.0, -15.0], [-25.0, 50.0, 35.0], [10.0, -45.0, 60.0]])  # rad / m
PORTRAIT_TENSORS = {
    "points": 3,
    "normals_world": 3,
    "albedo": 3,
    "room_radiance": 3,
    "shading": 0,
    "gloss": 0,
    "flash_bounce": 0,
    "confidence": 0,
    "albedo_sigma": 0,
    "normal_sigma_rad": 0,
    "residual": 0,
}
_PHASES = np.array([0.3, 1.1, 2.0])


@dataclass(frozen=True)
class Head:
    """The subject.

    Attributes:
        bump: amplitude of each of the three waves, share of the radius.
        retro: of Burley's retro-reflection.
        alpha: GGX width of the gloss.
        f0: of the gloss.
        albedo_gain: factor on the albedo; 0 = a black subject.
        room_gain: factor on the room's light; 0 = a dark room.
    """

    bump: float = 0.015
    retro: float = 0.0
    alpha: float = 0.25
    f0: float = 0.0
    albedo_gain: float = 1.0
    room_gain: float = 1.0

    def implicit(self, x):
        """f [...] at points [..., 3]: below 0 inside."""
        waves = np.sin(x @ _WAVES.T + _PHASES).sum(axis=-1)
        return np.linalg.norm(x / AXES_M, axis=-1) - 1.0 - self.bump * waves

    def normals(self, x):
        """Unit outward normals [..., 3] at points of the surface."""
        scaled = x / AXES_M
        gradient = scaled / AXES_M / np.linalg.norm(scaled, axis=-1, keepdims=True)
        gradient = gradient - self.bump * np.cos(x @ _WAVES.T + _PHASES) @ _WAVES
        return gradient / np.linalg.norm(gradient, axis=-1, keepdims=True)

    def albedo(self, x):
        """[..., 3] between 0.2 and 0.7."""
        wave = np.sin(x @ np.array([[30.0, 40.0, 0.0], [-35.0, 25.0, 20.0], [15.0, 0.0, 45.0]]).T)
        return self.albedo_gain * (np.array([0.55, 0.42, 0.35]) + np.array([0.12, 0.12, 0.1]) * wave)

    def room(self, normals):
        """Radiance [..., 3] of a white surface under the room's light: from a window and a coloured wall."""
        window = 0.6 + 0.4 * normals @ np.array([0.48, 0.6, 0.64])
        wall = 0.5 - 0.5 * normals[..., :1] * 0.9
        return self.room_gain * (
            window[..., None] * np.array([0.26, 0.25, 0.23]) + wall * np.array([0.03, 0.05, 0.08])
        )

    def intersect(self, origins, directions, steps=20):
        """Distance [N] along unit rays [N, 3] to the surface; inf where they miss it."""
        outer = AXES_M * (1.0 + 3.2 * self.bump)
        a = ((directions / outer) ** 2).sum(axis=1)
        b = (directions * origins / outer**2).sum(axis=1)
        c = ((origins / outer) ** 2).sum(axis=1) - 1.0
        root = b * b - a * c
        near = root > 0
        found = np.full(len(origins), np.inf)
        if not near.any():
            return found
        o, d = origins[near], directions[near]
        half = np.sqrt(root[near]) / a[near]
        low, high = -b[near] / a[near] - half, -b[near] / a[near] + half
        # The first step inside, then bisection between it and the step before.
        first = np.full(len(o), np.inf)
        at = low.copy()
        for step in range(1, steps + 1):
            t = low + (high - low) * (step / steps) ** 2  # finer where the rays enter
            inside = (self.implicit(o + t[:, None] * d) < 0) & np.isinf(first)
            first = np.where(inside, t, first)
            at = np.where(np.isinf(first), t, at)
        hit = np.isfinite(first)
        a_, b_, o, d = at[hit], first[hit], o[hit], d[hit]
        for _ in range(22):  # to a part in 4 million of a step: a nanometre
            middle = 0.5 * (a_ + b_)
            inside = self.implicit(o + middle[:, None] * d) < 0
            a_, b_ = np.where(inside, a_, middle), np.where(inside, middle, b_)
        index = np.flatnonzero(near)[hit]
        found[index] = 0.5 * (a_ + b_)
        return found

    def surface(self, count):
        """Points [count, 3] all over the surface (a Fibonacci sphere, pushed out to it)."""
        i = np.arange(count) + 0.5
        z, phi = 1.0 - 2.0 * i / count, i * np.pi * (3.0 - np.sqrt(5.0))
        ring = np.sqrt(1.0 - z * z)
        directions = np.stack([ring * np.cos(phi), ring * np.sin(phi), z], axis=1) * AXES_M
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        distance = self.intersect(0.3 * directions, -directions)
        return (0.3 - distance)[:, None] * directions

    def flash_radiance(self, x, normals, albedo, flash, eye):
        """Radiance [..., 3] that the flash at [3] adds, seen from [3]: Burley's diffuse part and GGX."""
        to_light, to_eye = flash - x, eye - x
        square = (to_light**2).sum(axis=-1, keepdims=True)
        to_light = to_light / np.sqrt(square)
        to_eye = to_eye / np.linalg.norm(to_eye, axis=-1, keepdims=True)
        half = to_light + to_eye
        half = half / np.linalg.norm(half, axis=-1, keepdims=True)
        n_l = np.clip((normals * to_light).sum(-1, keepdims=True), 0, 1)
        n_v = np.clip((normals * to_eye).sum(-1, keepdims=True), 0, 1)
        n_h = np.clip((normals * half).sum(-1, keepdims=True), 0, 1)
        l_h = (to_light * half).sum(-1, keepdims=True)
        diffuse = albedo * n_l
        if self.retro:
            grazing = (self.retro + 0.5) * l_h**2 - 0.5
            diffuse = diffuse * (1 + grazing * (1 - n_l) ** 5) * (1 + grazing * (1 - n_v) ** 5)
        if self.f0:
            a2, k = self.alpha**2, self.alpha / 2
            distribution = a2 / (n_h**2 * (a2 - 1) + 1) ** 2
            masking = 1 / ((n_l * (1 - k) + k) * (n_v * (1 - k) + k))
            fresnel = self.f0 + (1 - self.f0) * (1 - l_h) ** 5
            diffuse = diffuse + distribution * masking * fresnel / 4 * n_l
        return C_FLASH * diffuse / square


def looking_at(eye, target, name="", size=128, focal_px=None, flash=None):
    """A camera at [3] that looks at [3], the world's +Y up in its picture."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    cam_from_world = np.eye(4)
    cam_from_world[:3, :3] = [right, np.cross(forward, right), forward]
    cam_from_world[:3, 3] = -cam_from_world[:3, :3] @ eye
    focal_px = 1.75 * size if focal_px is None else focal_px
    intrinsics = np.array([[focal_px, 0, size / 2], [0, focal_px, size / 2], [0, 0, 1.0]])
    return Camera(name, size, size, intrinsics, cam_from_world, flash=flash)


def arc(count=36, every=3, size=128, distance_m=0.5):
    """Cameras from -80 to +80 degrees about the head, every third one with the flash."""
    cameras = []
    for k, azimuth in enumerate(np.radians(np.linspace(-80, 80, count))):
        height = 0.12 * np.sin(2.1 * k)
        eye = distance_m * np.array([np.sin(azimuth), height, np.cos(azimuth)])
        target = 0.005 * np.array([np.sin(3.0 * k), np.cos(5.0 * k), 0.0])
        cameras.append(looking_at(eye, target, f"{k:04d}", size, flash=int(k % every == every // 2)))
    return cameras


@dataclass(frozen=True, eq=False)
class Frame:
    """What a camera sees, from the formulas; zero off the subject.

    Attributes:
        camera: The camera, with its flash flag.
        hit: [H, W] bool, whether the pixel's centre shows the subject.
        points, normals, albedo: [H, W, 3].
        radiance: [H, W, 3], linear, without noise.
    """

    camera: Camera
    hit: np.ndarray
    points: np.ndarray
    normals: np.ndarray
    albedo: np.ndarray
    radiance: np.ndarray

    @property
    def depth(self):
        """[H, W] z along the optical axis, 0 off the subject."""
        pose = self.camera.cam_from_world
        return np.where(self.hit, self.points @ pose[2, :3] + pose[2, 3], 0.0)


def photograph(head, camera, gain=1.0):
    """The frame of a camera; its flash, if on, is `gain` times as strong as usual."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width] + 0.5
    rays = np.stack([u, v, np.ones_like(u)], axis=-1).reshape(-1, 3) @ np.linalg.inv(camera.K).T
    rays = rays @ camera.cam_from_world[:3, :3]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    eye = camera.centre_world
    distance = head.intersect(np.broadcast_to(eye, rays.shape), rays)
    hit = np.isfinite(distance)
    points, normals = np.zeros((len(rays), 3)), np.zeros((len(rays), 3))
    points[hit] = eye + distance[hit, None] * rays[hit]
    normals[hit] = head.normals(points[hit])
    shape = (camera.height, camera.width)
    empty = np.zeros((*shape, 3))
    frame = Frame(
        camera, hit.reshape(shape), points.reshape(empty.shape), normals.reshape(empty.shape), empty, empty
    )
    return expose(head, frame, gain)


def expose(head, frame, gain=1.0):
    """A frame once more, of a subject or room of other colours and gloss but of the same shape."""
    camera, hit = frame.camera, frame.hit
    albedo, radiance = np.zeros_like(frame.points), np.zeros_like(frame.points)
    points, normals = frame.points[hit], frame.normals[hit]
    albedo[hit] = head.albedo(points)
    radiance[hit] = albedo[hit] * head.room(normals)
    if camera.flash:
        eye = camera.centre_world
        flash = eye + camera.cam_from_world[:3, :3].T @ FLASH_OFFSET_CAM_M
        radiance[hit] += gain * head.flash_radiance(points, normals, albedo[hit], flash, eye)
    return replace(frame, albedo=albedo, radiance=radiance)


def cloud_of(head, count, noise_m=0.0, seed=0):
    """Points [count, 3] float32 of the head's surface and their true normals, moved along them by noise."""
    points = head.surface(count)
    normals = head.normals(points)
    moved = points + noise_m * np.random.default_rng(seed).normal(size=(count, 1)) * normals
    return moved.astype(np.float32), normals.astype(np.float32)


def with_noise(radiance, relative, seed, floor=0.002):
    """Radiance with Gaussian noise of a share of itself and a floor."""
    random = np.random.default_rng(seed)
    return radiance + random.normal(size=radiance.shape) * (relative * radiance + floor)


@dataclass(eq=False)
class MemoryScene:
    """What `relight.scene.Scene` offers to the solve, from arrays instead of a session."""

    frames: Sequence[Frame]
    radiances: Sequence[np.ndarray]
    points: torch.Tensor
    normals_world: torch.Tensor | None = None
    with_masks: bool = True
    flash_offset_cam_m: np.ndarray = field(default_factory=lambda: FLASH_OFFSET_CAM_M.copy())
    lamp: Lamp = field(default_factory=Lamp)
    noise: NoiseModel | None = None
    device: torch.device = field(default_factory=lambda: torch.device("cpu"))
    clip: float = 0.95
    rotation_deg: int = 0

    @property
    def views(self):
        """Frames numbered in order."""
        return tuple(View(k, f.camera, f.camera.flash) for k, f in enumerate(self.frames))

    def observe(self, view):
        """Pixels as they are; clipped ones are not valid."""
        radiance = torch.from_numpy(np.asarray(self.radiances[view.index], np.float32))
        valid = (radiance.amax(dim=-1) < self.clip).float()
        mask = torch.from_numpy(self.frames[view.index].hit.astype(np.float32)) if self.with_masks else None
        variance = None
        if self.noise is not None:
            exposure = np.asarray(self.radiances[view.index], np.float32)
            variance = torch.from_numpy(self.noise.variance(exposure, Radiometry(Response("linear"))))
        return Observation(radiance, valid, mask, variance)


def write_session(path: Path, frames: Sequence[Frame], cloud: PointCloud, *, transfer="srgb") -> Session:
    """The frames as 8-bit sRGB PNGs in a session with poses, cloud, masks and the flash's place."""
    size = frames[0].camera.width
    with Session.create(
        path, source={"kind": "analytic"}, width=size, height=size, transfer=transfer
    ) as session:
        for k, frame in enumerate(frames):
            linear = np.clip(frame.radiance, 0, 1)
            srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
            file = session.write_frame(k, np.rint(255 * srgb).astype(np.uint8))
            session.append_frame(
                FrameRecord(index=k, file=file, width=size, height=size, flash=frame.camera.flash)
            )
        session.save_scene_cameras({k: frame.camera for k, frame in enumerate(frames)})
        session.masks_dir.mkdir(parents=True)
        for k, frame in enumerate(frames):
            write_png(session.mask_path(k), frame.hit.astype(np.uint8) * 255)
        write_ply(session.points_path, cloud)
        offset = Quantity.of(FLASH_OFFSET_CAM_M, "m", "analytic scene")
        save_calibration(Calibration(flash_offset_cam_m=offset), session.calibration_path)
    return session


def portrait_of(points, normals, spacing, **given) -> Portrait:
    """A portrait of points [P, 3] and normals [P, 3], all else 1 (colours 0.1, no bounces) where it is not
    given."""
    tensors = {"points": points, "normals_world": normals} | {
        name: given.pop(name) for name in list(given) if name in PORTRAIT_TENSORS
    }
    count = len(points)
    for name, width in PORTRAIT_TENSORS.items():
        usual = 0.0 if name == "flash_bounce" else 1.0
        value = torch.as_tensor(np.asarray(tensors.get(name, usual)), dtype=torch.float32)
        tensors[name] = value.expand(count, width).clone() if width else value.expand(count).clone()
    numbers = {
        "c_room": (0.1, 0.1, 0.1),
        "c_flash": (0.1, 0.1, 0.1),
        "flash_offset_cam_m": (0.0, 0.0, 0.0),
        "reflectance": Reflectance(),
        "bounce_scale": 1.0,
        "info": {},
    }
    return Portrait(**tensors, spacing=spacing, **(numbers | given))


def sphere_portrait(count=20_000, radius=0.1, **given) -> Portrait:
    """An even sphere about the origin."""
    i = np.arange(count) + 0.5
    z, phi = 1 - 2 * i / count, i * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - z * z)
    normals = np.stack([ring * np.cos(phi), ring * np.sin(phi), z], axis=1)
    return portrait_of(radius * normals, normals, radius * float(np.sqrt(4 * np.pi / count)), **given)
