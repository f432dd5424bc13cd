"""Head, neck and shoulders of ellipsoids before a papered wall, filmed with a blinking flash.

Rays are cut with the surfaces in numpy, without the code that is tested, so the coverage is known.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.cameras import Camera
from capture.images import write_png
from capture.session import FrameRecord, Session

SIZE = 128
FOCAL = 142.0
WALL_Z = -1.1
DISTANCE = 0.55
# centre and half axes, metres; albedo
BODY = (
    (np.array([0.0, 0.02, 0.0]), np.array([0.075, 0.105, 0.09]), np.array([0.55, 0.38, 0.30])),
    (np.array([0.0, -0.1, -0.02]), np.array([0.05, 0.09, 0.05]), np.array([0.50, 0.36, 0.28])),
    (np.array([0.0, -0.22, -0.03]), np.array([0.17, 0.07, 0.08]), np.array([0.15, 0.25, 0.35])),
)
C_FLASH, ROOM = 0.12, 0.28


def camera_at(azimuth_deg, name="", size=SIZE, distance=DISTANCE):
    """Looks at the origin from a circle about it, at the head's height."""
    a = np.radians(azimuth_deg)
    centre = np.array([distance * np.sin(a), 0.02, distance * np.cos(a)])
    forward = (np.array([0.0, -0.03, 0.0]) - centre) / np.linalg.norm(np.array([0.0, -0.03, 0.0]) - centre)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ centre
    focal = FOCAL * size / SIZE
    K = np.array([[focal, 0.0, size / 2], [0.0, focal, size / 2], [0.0, 0.0, 1.0]])
    return Camera(name=name, width=size, height=size, K=K, cam_from_world=pose)


def _paper(x, y):
    """Albedo [..., 3] of the wall: blotches of several sizes."""
    pattern = (
        np.sin(31 * x + 3 * np.sin(17 * y)) + np.sin(43 * y + 2 * np.sin(23 * x)) + np.sin(11 * x - 7 * y)
    )
    return (0.35 + 0.1 * pattern)[..., None] * np.array([0.8, 0.95, 1.0])


def _ellipsoid(origins, directions, centre, axes):
    """Distances [N] along rays to an ellipsoid, inf where missed."""
    o, d = (origins - centre) / axes, directions / axes
    a, b, c = (d * d).sum(1), (o * d).sum(1), (o * o).sum(1) - 1
    root = b * b - a * c
    return np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, np.inf)


def render(camera, flash, shift=(0.0, 0.0, 0.0), pixels=None):
    """Radiance [H, W, 3] and coverage [H, W] by 2 x 2 samples a pixel; `pixels` straightens a lens."""
    v, u = np.mgrid[0 : 2 * camera.height, 0 : 2 * camera.width]
    uv = np.stack([(u + 0.5) / 2, (v + 0.5) / 2], -1).reshape(-1, 2)
    if pixels is not None:
        uv = pixels(uv)
    rays = np.concatenate([uv, np.ones((len(uv), 1))], 1) @ np.linalg.inv(camera.K).T
    directions = rays @ camera.cam_from_world[:3, :3]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origin = camera.centre_world
    origins = np.broadcast_to(origin, directions.shape)
    t = (WALL_Z - origin[2]) / np.minimum(directions[:, 2], -1e-6)
    points = origins + t[:, None] * directions
    albedo = _paper(points[:, 0], points[:, 1])
    normals = np.broadcast_to([0.0, 0.0, 1.0], points.shape).copy()
    inside = np.zeros(len(points), bool)
    for centre, axes, colour in BODY:
        centre = centre + np.asarray(shift)
        near = _ellipsoid(origins, directions, centre, axes)
        hit = near < t
        t = np.where(hit, near, t)
        points[hit] = origins[hit] + t[hit, None] * directions[hit]
        n = (points[hit] - centre) / axes**2
        normals[hit] = n / np.linalg.norm(n, axis=1, keepdims=True)
        spots = 1 + 0.06 * np.sin(points[hit] @ np.array([140.0, 170.0, 150.0]))[:, None]
        albedo[hit] = colour * spots
        inside |= hit
    shade = 0.6 + 0.4 * np.clip(normals @ np.array([0.5, 0.7, 0.5]), -0.5, 1)
    radiance = albedo * ROOM * shade[:, None]
    if flash:
        cosine = np.clip(-(normals * directions).sum(1), 0, None)
        radiance = radiance + albedo * (C_FLASH * cosine / t**2)[:, None]

    def pooled(values):
        blocks = values.reshape(camera.height, 2, camera.width, 2, -1)
        return blocks.mean(axis=(1, 3))

    return pooled(radiance), pooled(inside[:, None].astype(float))[..., 0]


def cloud(count=12_000, noise=0.0005, seed=0):
    """Points [P, 3] on the body, those inside of another ellipsoid left out."""
    rng = np.random.default_rng(seed)
    parts = []
    for k, (centre, axes, _) in enumerate(BODY):
        d = rng.normal(size=(count, 3))
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        # Evenly over the ellipsoid: kept by how much its area is stretched there.
        stretch = np.linalg.norm(d / axes, axis=1)
        p = centre + axes * d
        p = p[rng.random(count) < stretch / stretch.max()]
        for j, (other, its_axes, _) in enumerate(BODY):
            if j != k:
                p = p[(((p - other) / its_axes) ** 2).sum(1) > 1]
        parts.append(p)
    points = np.concatenate(parts)
    return (points + rng.normal(0, noise, points.shape)).astype(np.float32)


@dataclass
class Film:
    """A session and what is true of it."""

    session: Session
    cameras: dict
    truth: dict = field(default_factory=dict)

    def mask(self, folder, index):
        return cv2.imread(str(Path(folder) / f"{index:06d}.png"), cv2.IMREAD_UNCHANGED) / 255.0

    def overlaps(self, folder):
        """Intersection over union by frame."""
        result = {}
        for index, truth in self.truth.items():
            first, second = self.mask(folder, index) > 0.5, truth > 0.5
            result[index] = np.count_nonzero(first & second) / np.count_nonzero(first | second)
        return result


def make_film(path, flashes, span_deg=30.0, shifts=None, size=SIZE, rotation_deg=0, splits=None):
    """Writes a session of as many frames as there are flash flags, along an arc."""
    from capture.transfer import to_display

    azimuths = np.linspace(-span_deg / 2, span_deg / 2, len(flashes))
    session = Session.create(
        path, source={"kind": "images"}, width=size, height=size, rotation_deg=rotation_deg
    )
    film = Film(session, {})
    with session:
        for index, (flash, azimuth) in enumerate(zip(flashes, azimuths, strict=True)):
            camera = camera_at(azimuth, f"{index:06d}", size)
            shift = (0.0, 0.0, 0.0) if shifts is None else shifts[index]
            radiance, coverage = render(camera, bool(flash), shift)
            picture = np.round(255 * to_display(np.clip(radiance, 0, 1))).astype(np.uint8)
            if rotation_deg:  # the sensor lies on its side: its picture, turned clockwise, is the upright one
                picture, coverage = (np.rot90(each, rotation_deg // 90) for each in (picture, coverage))
                camera = turned(camera, rotation_deg)
            file = f"frames/{index:06d}.png"
            write_png(path / file, np.ascontiguousarray(picture))
            split = None if splits is None else splits[index]
            record = FrameRecord(index=index, file=file, width=size, height=size, flash=flash, split=split)
            session.append_frame(record)
            film.cameras[index] = replace(camera, flash=flash)
            film.truth[index] = coverage
    return film


def turned(camera, rotation_deg):
    """The camera of a square picture turned counter-clockwise."""
    pose = camera.cam_from_world.copy()
    quarter = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    for _ in range(rotation_deg // 90):
        pose[:3] = quarter @ pose[:3]
    return replace(camera, cam_from_world=pose)


@pytest.fixture(scope="session")
def film(tmp_path_factory):
    """Nine frames, three of them lit."""
    return make_film(tmp_path_factory.mktemp("film") / "s", [0, 1, 0, 0, 0, 1, 0, 0, 1])


@pytest.fixture(scope="session")
def scene():
    """The functions above, for tests that need other films."""
    from types import SimpleNamespace

    return SimpleNamespace(
        make_film=make_film, cloud=cloud, camera_at=camera_at, render=render, BODY=BODY, WALL_Z=WALL_Z
    )
