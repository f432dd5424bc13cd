"""A ball with a fine pattern before a patterned wall, ray-cast into frames of a session."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from capture.cameras import Camera
from capture.frame_record import FrameRecord
from capture.images import write_png
from capture.session import Session

RADIUS = 0.1
DISTANCE = 0.5
WALL_Z = -0.6
SIZE = 128


def camera_at(azimuth_deg: float, name: str, size: int = SIZE) -> Camera:
    """A camera on a circle about the origin, looking at it."""
    angle = np.radians(azimuth_deg)
    centre = DISTANCE * np.array([np.sin(angle), 0.0, np.cos(angle)])
    z = -centre / DISTANCE
    x = np.cross([0.0, -1.0, 0.0], z)
    rotation = np.stack([x, np.cross(z, x), z])
    cam_from_world = np.eye(4)
    cam_from_world[:3, :3], cam_from_world[:3, 3] = rotation, -rotation @ centre
    focal_px = 1.3 * size
    K = np.array([[focal_px, 0, size / 2], [0, focal_px, size / 2], [0, 0, 1.0]])
    return Camera(name, size, size, K, cam_from_world)


def pattern(points: np.ndarray, seed: int, finest: float) -> np.ndarray:
    """[N] 0..1, a sum of waves in all directions, the shortest `finest` long."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(24, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    lengths = finest * 4.0 ** rng.uniform(0.0, 1.0, 24)
    phases = rng.uniform(0.0, 2.0 * np.pi, 24)
    waves = np.sin(points @ (2.0 * np.pi * directions / lengths[:, None]).T + phases)
    return 0.5 + 0.5 * np.tanh(waves.sum(axis=1) / 4.0)


def render(camera: Camera, flash: int, contrast: float = 0.6) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Radiance [H, W, 3], depth [H, W] and whether it is the ball [H, W]."""
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    at = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(camera.K).T
    rays = at @ camera.cam_from_world[:3, :3]
    centre = camera.centre_world
    a, b = (rays**2).sum(-1), rays @ centre
    under = b**2 - a * (centre @ centre - RADIUS**2)
    ball = under > 0
    to_ball = (-b - np.sqrt(np.where(ball, under, 0.0))) / a
    with np.errstate(divide="ignore"):
        to_wall = np.where(rays[..., 2] < 0, (WALL_Z - centre[2]) / rays[..., 2], 3.0)
    depth = np.where(ball, to_ball, np.clip(to_wall, 0.0, 3.0))
    points = centre + rays * depth[..., None]
    flat = points.reshape(-1, 3)
    albedo = np.where(ball.ravel(), pattern(flat, 1, 0.016), pattern(flat, 2, 0.05)).reshape(depth.shape)
    radiance = 0.2 * (1.0 - contrast + contrast * albedo)
    if flash:
        distance = np.linalg.norm(points - centre, axis=-1)
        normals = np.where(ball[..., None], points / RADIUS, np.array([0.0, 0.0, 1.0]))
        cosine = np.clip((normals * (centre - points)).sum(-1) / distance, 0.0, 1.0)
        radiance = radiance * (1.0 + 0.5 * cosine / distance**2)
    return np.repeat(radiance[..., None], 3, axis=2).clip(0, 1).astype(np.float32), depth, ball


def make_session(
    folder: Path,
    azimuths: list[float],
    *,
    flash_every: int = 5,
    masks: bool = False,
    contrast: float = 0.6,
    exposures: list[float] | None = None,
) -> tuple[Session, dict[int, Camera]]:
    """A session of 16-bit linear frames and its cameras."""
    session = Session.create(folder, source={"kind": "test"}, width=SIZE, height=SIZE, transfer="linear")
    cameras = {}
    with session:
        for index, azimuth in enumerate(azimuths):
            camera = camera_at(azimuth, f"{index:04d}")
            flash = int(flash_every > 0 and index % flash_every == 0)
            radiance, _, ball = render(camera, flash, contrast)
            if exposures is not None:
                radiance = radiance * np.float32(exposures[index])
            code = np.round(radiance.clip(0, 1) * 65535).astype(np.uint16)
            file = session.write_frame(index, code)
            session.append_frame(FrameRecord(index=index, file=file, width=SIZE, height=SIZE, flash=flash))
            cameras[index] = camera
            if masks:
                session.masks_dir.mkdir(parents=True, exist_ok=True)
                write_png(session.mask_path(index), (ball * 255).astype(np.uint8))
    return session, cameras
