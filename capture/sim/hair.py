"""Hair: a combed volume that hides the scalp, and thousands of ribbons that soften its outline.

Points are in head millimetres. A ribbon is two triangles a segment, wide across the strand and rolled at
random, so that the silhouette thins out instead of ending; eyebrows are the same ribbons, short.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from capture.sim.head import HeadShape
from capture.sim.noise import value_noise
from capture.sim.sdf import bump, ellipsoid, smooth_step, smooth_subtract, smooth_union

# The hairline: heights of the border (mm) over depth z, from nape over the ear and temple to the forehead.
_LINE_Z = np.array([-110.0, -70.0, -40.0, -22.0, 4.0, 15.0, 26.0, 40.0, 55.0, 66.0, 90.0], dtype=np.float32)
_LINE_Y = np.array([-80.0, -76.0, -50.0, -32.0, -26.0, -18.0, 26.0, 54.0, 63.0, 67.0, 72.0], dtype=np.float32)

# style: thickness at the sides and at the top (mm), strand length (mm)
_STYLES = {"short": (5.0, 12.0, 20.0), "swept": (7.0, 21.0, 55.0), "bob": (9.0, 13.0, 95.0)}
_PART_X = 24.0

# (points, unit normals) to unit tangents, all [P, 3]
Flow = Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class HairShape:
    """The volume and the combing of one subject's hair; points [P, 3] in head millimetres."""

    head: HeadShape

    @property
    def style(self) -> str:
        """One of `subject.HAIR_STYLES`."""
        return self.head.subject.hair_style

    def inside_line(self, q: np.ndarray) -> np.ndarray:
        """Distance [P] above the hairline (folded points), negative on the face."""
        wave = 1.2 * np.sin(q[:, 0] / 6.0) + 0.8 * np.sin(q[:, 2] / 4.3)
        line = (q[:, 1] - np.interp(q[:, 2], _LINE_Z, _LINE_Y).astype(np.float32) + wave) * np.float32(0.8)
        around_ear = bump(q[:, 2], -8.0, 13.0) * smooth_step(q[:, 1], 34.0, 16.0)
        return line - 40.0 * around_ear

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Signed distance [P] to the volume of combed hair; far positive when bald."""
        if self.style == "bald":
            return np.full(len(points), 1e3, dtype=np.float32)
        result = np.full(len(points), 1e3, dtype=np.float32)
        near = points[:, 1] > -125.0
        p = points[near]
        q = self.head.fold(p)
        side, top, _ = _STYLES[self.style]
        scalp = smooth_union(
            ellipsoid(q, (0, 34, -14), (73, 79, 92)), ellipsoid(q, (0, 40, 22), (60, 54, 62)), 24
        )
        scalp = smooth_union(scalp, ellipsoid(q, (0, -22, 22), (59, 79, 64)), 22)
        line = self.inside_line(q)
        thickness = side + (top - side) * smooth_step(q[:, 1], 35.0, 95.0)
        if self.style == "swept":
            parting = (
                bump(p[:, 0], _PART_X, 5.0)
                * smooth_step(p[:, 2], -45.0, -10.0)
                * smooth_step(q[:, 1], 60, 80)
            )
            thickness = thickness * (1.0 - 0.35 * parting) + 5.0 * smooth_step(p[:, 2], 30, 62) * (
                q[:, 1] > 50
            )
        body = scalp - thickness * smooth_step(line, -1.0, 16.0) + 2.0 * smooth_step(line, 4.0, -4.0)
        body = body + 40.0 * smooth_step(line, -4.0, -20.0)
        if self.style == "bob":
            curtain = ellipsoid(q, (0, 0, -22), (93, 118, 96))
            opening = ellipsoid(q, (0, -58, 92), (74, 112, 76))
            curtain = smooth_subtract(curtain, opening, 14.0)
            curtain = smooth_subtract(curtain, q[:, 1] + 98.0 + 4.0 * np.sin(p[:, 0] / 9.0), 6.0)
            body = smooth_union(body, curtain, 10.0)
        result[near] = body - self._clumps(p)
        return result

    def _clumps(self, p: np.ndarray) -> np.ndarray:
        """Relief [P] of locks, drawn out along the combing."""
        across = self.across(p)
        return 1.3 * value_noise(across, 7.0, self.head.subject.seed + 71) + 0.7 * value_noise(
            across, 2.6, self.head.subject.seed + 72
        )

    def across(self, p: np.ndarray) -> np.ndarray:
        """Coordinates [P, 3] that change little along the combing: noise of them makes locks and streaks."""
        if self.style == "short":
            return p * np.float32(0.55)
        if self.style == "bob":
            return p * np.array([0.9, 0.07, 0.9], np.float32)
        return p * np.array([0.16, 0.16, 1.0], np.float32)

    def flow(self, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Unit combing direction [P, 3], tangent to the surface with the given normals [P, 3]."""
        x, y, _ = points.T
        down = np.array([0.0, -1.0, -0.1], dtype=np.float32)
        if self.style == "short":
            crown = np.array([10.0, 104.0, -52.0], dtype=np.float32)
            away = points - crown
            wish = away / np.maximum(np.linalg.norm(away, axis=-1, keepdims=True), 1e-6) + 0.5 * down
            wish[:, 2] += 0.5 * smooth_step(y, 40, 90)
        elif self.style == "bob":
            side = np.tanh(x / 5.0)
            top = smooth_step(y, 70, 112)
            wish = np.stack([side * (0.15 + top), -1.0 + 0.6 * top, 0.12 - 0.35 * top], axis=-1)
        else:
            side = np.tanh((x - _PART_X) / 6.0)
            top = smooth_step(y, 45, 85)
            wish = np.stack([side * top, -1.0 + 0.9 * top, -0.9 + 0.25 * top], axis=-1)
        wobble = np.stack(
            [value_noise(points, 13.0, self.head.subject.seed + 80 + i) for i in range(3)], axis=-1
        )
        wish = wish + 0.30 * wobble
        wish -= (wish * normals).sum(axis=-1, keepdims=True) * normals
        return (wish / np.maximum(np.linalg.norm(wish, axis=-1, keepdims=True), 1e-6)).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Strands:
    """Ribbons in head millimetres.

    Attributes:
        vertices: [V, 3] float32.
        normals: [V, 3] float32 unit, for shading.
        tangents: [V, 3] float32 unit, along the strand.
        albedo: [V, 3] float32 linear reflectance.
        triangles: [T, 3] int32, seen from the scalp's outside.
    """

    vertices: np.ndarray
    normals: np.ndarray
    tangents: np.ndarray
    albedo: np.ndarray
    triangles: np.ndarray


def comb_strands(
    hair: HairShape, surface: np.ndarray, normals: np.ndarray, count: int, rng: np.random.Generator
) -> Strands:
    """Strands over the hair's surface.

    Args:
        hair: the combing.
        surface: [S, 3] points on the hair's volume, evenly spread.
        normals: [S, 3] their unit normals.
        count: number of strands.
        rng: where the randomness comes from.
    """
    _, _, length = _STYLES[hair.style]
    lengths = length * rng.uniform(0.5, 1.15, count)
    lift = rng.gamma(1.6, 0.45, count) + 3.5 * (rng.random(count) < 0.04)
    colour = np.array(hair.head.subject.hair) * np.exp(rng.normal(0.0, 0.32, (count, 1)))
    grey = rng.random((count, 1)) < 0.004
    colour = np.where(grey, 0.25, colour)
    roots = rng.integers(len(surface), size=count)
    return _grow(
        surface, normals, surface[roots], lengths, lift, colour, hair.flow, segments=7, width=0.8, rng=rng
    )


def brow_density(q: np.ndarray) -> np.ndarray:
    """How densely brow hairs grow, 0..1, at folded points [P, 3]."""
    x, y, z = q.T
    arch = 17.5 + 5.0 * bump(x, 36, 13) - 2.0 * smooth_step(x, 40, 52)
    thickness = np.maximum(1.9 * smooth_step(x, 58, 34), 0.5)
    along = smooth_step(x, 8, 14) * smooth_step(x, 54, 46) * (z > 45)
    return np.exp(-0.5 * ((y - arch) / thickness) ** 2) * along


def brow_strands(
    head: HeadShape, surface: np.ndarray, normals: np.ndarray, count: int, rng: np.random.Generator
) -> Strands:
    """Eyebrow hairs on the skin's surface [S, 3] with unit normals [S, 3]."""
    q = head.fold(surface)
    weight = brow_density(q)
    roots = rng.choice(len(surface), size=count, p=weight / weight.sum())

    def flow(points: np.ndarray, at_normals: np.ndarray) -> np.ndarray:
        side = np.where(points[:, 0] > 0, 1.0, -1.0)
        ax = np.abs(points[:, 0])
        rise = 1.1 * smooth_step(ax, 26, 10) - 0.5 * smooth_step(ax, 30, 46) + 0.15
        wish = np.stack([side, rise, 0 * side], axis=-1) + 0.25 * np.sin(points[:, [1, 2, 0]] * 2.3)
        wish -= (wish * at_normals).sum(axis=-1, keepdims=True) * at_normals
        return wish / np.maximum(np.linalg.norm(wish, axis=-1, keepdims=True), 1e-6)

    near = (np.abs(q[:, 0] - 30) < 40) & (np.abs(q[:, 1] - 18) < 25) & (q[:, 2] > 30)
    colour = np.array(head.subject.hair) * 0.8 * np.exp(rng.normal(0.0, 0.25, (count, 1)))
    lengths = rng.uniform(5.0, 9.0, count)
    lift = rng.uniform(0.15, 0.7, count)
    return _grow(
        surface[near],
        normals[near],
        surface[roots],
        lengths,
        lift,
        colour,
        flow,
        segments=4,
        width=0.36,
        rng=rng,
    )


def _grow(
    surface: np.ndarray,
    normals: np.ndarray,
    roots: np.ndarray,
    lengths: np.ndarray,
    lift: np.ndarray,
    colour: np.ndarray,
    flow: Flow,
    *,
    segments: int,
    width: float,
    rng: np.random.Generator,
) -> Strands:
    """Walk along `flow` over the surface, rising to `lift` mm above it, and put a ribbon on each path."""
    tree = cKDTree(surface)
    count = len(roots)
    at = roots.astype(np.float32)
    step = (lengths / segments).astype(np.float32)[:, None]
    points, ups = [], []
    for k in range(segments + 1):
        _, nearest = tree.query(at)
        up = normals[nearest]
        height = lift * (k / segments) ** 0.7 - 0.3
        away = ((at - surface[nearest]) * up).sum(axis=-1)
        reach = np.clip(height - away, -2.5, 1.2)[:, None]
        at = (at + reach * up).astype(np.float32)
        points.append(at)
        ups.append(up)
        at = at + step * flow(at, up).astype(np.float32)
    path, up = np.stack(points, axis=1), np.stack(ups, axis=1)
    along = np.gradient(path, axis=1)
    along /= np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-6)
    roll = rng.normal(0.0, 0.7, (count, 1, 1))
    across = np.cross(along, up)
    across /= np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-6)
    facing = np.cross(across, along)
    across, facing = (
        np.cos(roll) * across + np.sin(roll) * facing,
        np.cos(roll) * facing - np.sin(roll) * across,
    )
    taper = np.sqrt(1.0 - np.linspace(0.0, 0.97, segments + 1))[None, :, None]
    half = 0.5 * width * taper * rng.uniform(0.6, 1.3, (count, 1, 1))
    # The facing bends towards each edge: the flat ribbon shades like a round lock.
    edges = np.stack([path - half * across, path + half * across], axis=2)
    shading = np.stack([facing - 0.5 * across, facing + 0.5 * across], axis=2)
    shading /= np.linalg.norm(shading, axis=-1, keepdims=True)
    fade = np.linspace(0.75, 1.2, segments + 1)[None, :, None, None]
    albedo = np.broadcast_to(colour[:, None, None, :] * fade, edges.shape)
    index = np.arange(count * (segments + 1) * 2).reshape(count, segments + 1, 2)
    a, b, c, d = index[:, :-1, 0], index[:, :-1, 1], index[:, 1:, 1], index[:, 1:, 0]
    triangles = np.concatenate(
        [np.stack([a, b, c], axis=-1).reshape(-1, 3), np.stack([a, c, d], axis=-1).reshape(-1, 3)]
    )
    return Strands(
        edges.reshape(-1, 3).astype(np.float32),
        shading.reshape(-1, 3).astype(np.float32),
        np.broadcast_to(along[:, :, None, :], edges.shape).reshape(-1, 3).astype(np.float32),
        np.clip(albedo, 0.003, 0.7).reshape(-1, 3).astype(np.float32),
        triangles.astype(np.int32),
    )
