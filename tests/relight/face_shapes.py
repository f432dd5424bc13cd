"""Heads and other shapes for the tests of the face prior."""

from functools import cache

import numpy as np
import torch
from analytic_scene import looking_at

from capture.sim.bust import build_bust
from capture.sim.cloud import sample_surface
from capture.sim.subject import Subject
from capture.transfer import to_linear
from relight.observations import visible_points


def arc_of_cameras(low_deg, high_deg, count=7, size=256):
    """Cameras on a part of a circle half a metre about the origin, by index."""
    azimuths = np.radians(np.linspace(low_deg, high_deg, count))
    return {
        k: looking_at(
            0.55 * np.array([np.sin(a), 0.03, np.cos(a)]), np.zeros(3), f"{k:04d}", size, flash=k % 2
        )
        for k, a in enumerate(azimuths)
    }


@cache
def bust(seed=3):
    """A coarse sitter of the simulated rig: bald, symmetric about x = 0 to a millimetre, looking along +z."""
    return build_bust(Subject.from_seed(seed), 5.0, 0, 200)


@cache
def sitter(seed=3, count=24_000):
    """Points, normals and linear albedo [P, 3] of its whole surface."""
    cloud = sample_surface(bust(seed), count, np.random.default_rng(seed))
    return (
        cloud.points.astype(np.float64),
        cloud.normals.astype(np.float64),
        to_linear(cloud.colors, "srgb").astype(np.float64),
    )


def seen_by(cloud, cameras, floor=-0.25):
    """What of a cloud some camera sees."""
    points, normals = (torch.from_numpy(values).float() for values in cloud[:2])
    seen = np.zeros(len(points), bool)
    for camera in cameras.values():
        _, cosine, _ = visible_points(points, normals, camera, np.sqrt(0.25 / len(points)))
        seen |= (cosine > 0.15).numpy()
    seen &= cloud[0][:, 1] > floor
    return tuple(values[seen] for values in cloud)


def spoiled(cloud, noise_m=0.001, outliers=0.05, seed=0):
    """A cloud with noise, and a share of points moved anywhere."""
    random = np.random.default_rng(seed)
    points, normals, albedo = (values.copy() for values in cloud)
    points += noise_m * random.normal(size=points.shape)
    strays = random.choice(len(points), int(outliers * len(points)), replace=False)
    points[strays] = random.uniform(points.min(axis=0), points.max(axis=0), (len(strays), 3))
    turned = random.normal(size=(len(strays), 3))
    normals[strays] = turned / np.linalg.norm(turned, axis=1, keepdims=True)
    return points, normals, albedo


def rotation(yaw_deg=0.0, roll_deg=0.0):
    """[3, 3]: roll about +z, then yaw about +y."""
    yaw, roll = np.radians([yaw_deg, roll_deg])
    about_y = np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
    about_z = np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]])
    return about_y @ about_z


def shape(kind, count=20_000):
    """Points, normals and albedo of something that is no face, the size of a head."""
    random = np.random.default_rng(1)
    way = random.normal(size=(count, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    grey = np.full((count, 3), 0.4)
    angle, height = random.uniform(0, 2 * np.pi, count), random.uniform(-0.13, 0.13, count)
    around = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=1)
    if kind == "ball":
        return 0.1 * way, way, grey
    if kind == "cylinder":
        return 0.09 * around + np.stack([0 * height, height, 0 * height], axis=1), around, grey
    if kind == "vase":
        radius, slope = 0.07 + 0.03 * np.sin(25 * height), 0.75 * np.cos(25 * height)
        normals = around - slope[:, None] * np.array([0.0, 1.0, 0.0])
        points = radius[:, None] * around + np.stack([0 * height, height, 0 * height], axis=1)
        return points, normals / np.linalg.norm(normals, axis=1, keepdims=True), grey
    if kind == "box":
        side, at = random.integers(0, 6, count), random.uniform(-1, 1, (count, 3))
        axis, sign = side % 3, np.where(side < 3, 1.0, -1.0)
        at[np.arange(count), axis] = sign
        normals = np.zeros((count, 3))
        normals[np.arange(count), axis] = sign
        return at * [0.09, 0.12, 0.09], normals, grey
    if kind == "wall":
        at = random.uniform(-0.2, 0.2, (count, 3)) * [1, 1, 0]
        return at, np.tile([0.0, 0.0, 1.0], (count, 1)), grey
    assert kind == "rock"
    waves, phases, sizes = (
        random.normal(size=(12, 3)) * 4,
        random.uniform(0, 6, 12),
        0.06 * random.normal(size=12),
    )
    radius = 1 + np.sin(way @ waves.T + phases) @ sizes
    gradient = (np.cos(way @ waves.T + phases) * sizes) @ waves
    normals = radius[:, None] * way - (gradient - (gradient * way).sum(axis=1, keepdims=True) * way)
    return 0.1 * radius[:, None] * way, normals / np.linalg.norm(normals, axis=1, keepdims=True), grey
