"""Paint and grain of skin and cloth: reflectance, gloss and the fine relief of pores and weave.

Points are in head millimetres. Reflectances stay in the range of measured skin (about 0.02..0.7, red > green
> blue).
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from capture.sim.hair import brow_density
from capture.sim.head import HeadShape
from capture.sim.noise import fractal_noise, value_noise
from capture.sim.sdf import bump, smooth_step

# Blood shows in the reflectance as a loss of green and blue, melanin as a loss that is strongest in blue.
_BLOOD = np.array([0.10, 0.55, 0.45])
_MELANIN = np.array([0.45, 0.75, 0.95])
_DENSITY = {"cheeks": 0.55, "nose": 0.60, "ears": 0.65, "chin": 0.25, "lids": 0.30, "neck": 0.12}


def skin_relief(points: np.ndarray, shape: HeadShape) -> np.ndarray:
    """Height [P] of the fine relief in mm: pores, wrinkles of the lips, weave of the cloth."""
    seed = shape.subject.seed
    shirt = shape.shirt_mask(points)
    lips = shape.lip_mask(points)
    pores = value_noise(points, 2.1, seed + 11) * 0.06 + value_noise(points, 4.7, seed + 12) * 0.07
    creases = value_noise(points * np.array([1.0, 0.22, 0.22], np.float32), 1.9, seed + 13) * 0.14
    weave = value_noise(points, 2.6, seed + 14) * 0.14
    skin = pores * (1.0 - lips) + creases * lips
    return (skin * (1.0 - shirt) + weave * shirt).astype(np.float32)


def paint_skin(points: np.ndarray, shape: HeadShape) -> tuple[np.ndarray, np.ndarray]:
    """Reflectance [P, 3] and gloss [P] (mirror reflectance at normal incidence) of skin and shirt."""
    s = shape.subject
    q = shape.fold(points)
    x, y, z = q.T
    melanin = 0.10 * fractal_noise(points, 28.0, s.seed + 41, 4) + 0.05 * value_noise(
        points, 2.4, s.seed + 42
    )
    blood = 0.10 * fractal_noise(points, 14.0, s.seed + 43, 4) + _flush(x, y, z)
    blood += 0.12 * np.clip(value_noise(points, 5.0, s.seed + 44), 0, 1) * bump(x, 38, 16) * bump(y, -35, 16)
    melanin += _freckle_density(points, shape)
    socket = bump(x, 31, 13) * bump(y, -9, 6) * (z > 55) + 0.25 * bump(x, 20, 6) * bump(y, 2, 7) * (z > 55)
    melanin += 0.05 * socket + 0.04 * smooth_step(y, 30, 80)
    beard = smooth_step(y, -38, -60) * smooth_step(y, -135, -112) * smooth_step(z, 5, 30)
    moustache = bump(y, -61, 6.5) * smooth_step(x, 30, 18) * (z > 70)
    beard = np.maximum(beard * smooth_step(z + 0.8 * np.abs(y + 80), 30, 60), moustache) * s.stubble
    beard *= 0.8 + 0.5 * value_noise(points, 1.7, s.seed + 45)
    lips = shape.lip_mask(points)
    blood = blood * (1 - lips) + lips * (1.1 + 0.2 * value_noise(points * [1, 0.3, 0.3], 2.2, s.seed + 46))
    log_loss = np.clip(blood, -0.2, 1.4)[:, None] * _BLOOD + np.clip(melanin, -0.3, 1.6)[:, None] * _MELANIN
    albedo = np.array(s.skin) * np.exp(-log_loss)
    albedo *= 1.0 - 0.42 * np.clip(beard, 0, 1)[:, None] * np.array([1.0, 0.9, 0.75])
    albedo *= 1.0 - 0.82 * shape.lid_line(points)[:, None]
    albedo *= 1.0 - 0.25 * lips[:, None] * bump(y, -76, 1.0)[:, None]
    brow = brow_density(q)[:, None]
    albedo = albedo * (1.0 - 0.55 * brow) + 0.55 * brow * np.array(s.hair) * 1.5
    gloss = 0.040 + 0.018 * _oily(x, y, z) + 0.035 * lips
    gloss *= s.gloss * (1.0 + 0.15 * value_noise(points, 2.0, s.seed + 47))

    shirt = shape.shirt_mask(points)
    thread = value_noise(points * [1.0, 0.35, 1.0], 1.6, s.seed + 48)
    cloth = np.array(s.shirt) * (1 + 0.10 * thread + 0.06 * value_noise(points, 30, s.seed + 49))[:, None]
    albedo = albedo * (1 - shirt)[:, None] + cloth * shirt[:, None]
    gloss = gloss * (1 - shirt) + 0.006 * shirt
    return np.clip(albedo, 0.003, 0.9).astype(np.float32), gloss.astype(np.float32)


def _flush(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Blood density [P] of the places where faces are redder."""
    front = z > 40
    cheeks = bump(x, 42, 15) * bump(y, -34, 15) * front
    nose = bump(x, 0, 12) * bump(y, -41, 9) * (z > 82)
    ears = smooth_step(x, 58, 70) * bump(y, -10, 26) * bump(z, -8, 22)
    chin = bump(x, 0, 15) * bump(y, -104, 9) * front
    lids = bump(x, 32, 13) * bump(y, 1, 9) * front
    neck = smooth_step(y, -125, -160)
    d = _DENSITY
    return (
        d["cheeks"] * cheeks
        + d["nose"] * nose
        + d["ears"] * ears
        + d["chin"] * chin
        + d["lids"] * lids
        + d["neck"] * neck
    )


def _oily(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """1 on the T zone (forehead, nose, chin), 0 elsewhere; [P]."""
    forehead = bump(x, 0, 30) * bump(y, 50, 18)
    return np.clip(forehead + bump(x, 0, 9) * bump(y, -20, 26) + bump(x, 0, 14) * bump(y, -104, 9), 0, 1) * (
        z > 40
    )


def _freckle_density(points: np.ndarray, shape: HeadShape) -> np.ndarray:
    """Melanin density [P] of freckles on cheeks, nose and forehead, and of a few moles anywhere."""
    s = shape.subject
    rng = np.random.default_rng(s.seed + 61)
    weight = bump(np.abs(points[:, 0]), 26, 20) * bump(points[:, 1], -24, 20) * (points[:, 2] > 45)
    weight = weight + 0.15 * bump(points[:, 1], 45, 18) * (points[:, 2] > 45)
    moles = 9
    total = weight.sum()
    if total <= 0:
        return np.zeros(len(points), dtype=np.float32)
    spots = rng.choice(len(points), size=s.freckles, p=weight / total)
    bare = np.nonzero((points[:, 1] > -150) & (points[:, 2] > -30) & (points[:, 1] < 60))[0]
    spots = np.concatenate([spots, rng.choice(bare, size=moles)])
    size = np.concatenate([rng.uniform(0.5, 1.1, s.freckles), rng.uniform(0.8, 1.5, moles)])
    strength = np.concatenate([rng.uniform(0.15, 0.5, s.freckles), rng.uniform(0.7, 1.3, moles)])
    distance, nearest = cKDTree(points[spots]).query(points, distance_upper_bound=5.0)
    found = np.isfinite(distance)
    density = np.zeros(len(points), dtype=np.float32)
    at = nearest[found]
    density[found] = strength[at] * np.exp(-0.5 * (distance[found] / size[at]) ** 2)
    return density
