"""The plane about which a head is symmetric, found from a cloud with normals and albedo.

1. All planes of a lattice of azimuth, tilt and offset are scored at once (`relight.face.agreement`); a head's
   plane is upright to within some 25 degrees.
2. The best ones are refined: mirror images are matched with the nearest points and the plane moved to bring
   them onto those points' tangent planes, again and again (as in iterative closest point), robustly.
3. How well it is known comes from doing so without one block of the cloud after another (jackknife), which
   knows of a face's own asymmetry, and not from the residual, which takes neighbours for independent.

A ball, a vase or a ball's half are symmetric about many planes: then other planes agree as well as the best,
and `rivals` says how well.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from relight.face.agreement import BEYOND_CELLS, mirror_agreement
from relight.face.plane import Floats, Plane
from relight.face.samples import Samples

_AZIMUTH_STEP_DEG = 6.0
_TILTS_DEG = (-24.0, -16.0, -8.0, 0.0, 8.0, 16.0, 24.0)
_OFFSETS = 17  # over 1.6 radii
_REACH = 0.8  # radii from the middle of the cloud in which the plane is looked for
_SEARCH_SAMPLES = 320
_SCORE_SAMPLES = 3000
_REFINE_SAMPLES = 4000
_CANDIDATES = 6
_RIVAL_DEG = 15.0  # planes further apart than this, or by _RIVAL_OFFSET radii, are different planes
_RIVAL_OFFSET = 0.25
_COARSE = 0.08  # of the radius: distances that still agree, in the search
_FINE = 0.03
_ALBEDO_TOLERANCE = 0.5  # wider than in the search: only what is clearly another thing goes
_BLOCKS = 8
_STEPS = 12


@dataclass(frozen=True)
class Symmetry:
    """A plane of symmetry and how far to believe it.

    Attributes:
        plane: The plane.
        agreement: 0..1, how well mirror images that can be checked agree in place, normal and albedo.
        overlap: 0..1, share of the mirror images that can be checked.
        rival: 0..1, score of the best plane that is a clearly different one, over that of this plane: near 1,
            the cloud is symmetric about many planes.
        sigma_rad: Standard error of the plane's direction.
        sigma_offset: Standard error of the plane's place at the middle of the cloud, over the cloud's radius.
        radius: Half the cloud's breadth, world units.
    """

    plane: Plane
    agreement: float
    overlap: float
    rival: float
    sigma_rad: float
    sigma_offset: float
    radius: float


def find_symmetry(samples: Samples, up: Floats) -> Symmetry:
    """Searches the plane of symmetry of a cloud.

    Args:
        samples: See `relight.face.samples`.
        up: [3] unit: the plane holds it to within 25 degrees.
    """
    middle = np.median(samples.points, axis=0)
    normals, offsets = _lattice(middle, up, samples.radius)
    which = _spread(len(samples.points), _SEARCH_SAMPLES)
    coarse = mirror_agreement(samples, which, normals, offsets, _COARSE * samples.radius)
    candidates = _different(normals, offsets - normals @ middle, coarse.score, samples.radius)
    planes = [refine_plane(samples, Plane.of(normals[k], float(offsets[k]))) for k in candidates]
    which = _spread(len(samples.points), _SCORE_SAMPLES)
    fine = mirror_agreement(
        samples,
        which,
        np.stack([plane.n for plane in planes]),
        np.array([plane.offset for plane in planes]),
        _FINE * samples.radius,
    )
    best = int(np.argmax(fine.score))
    plane = planes[best]
    sigma_rad, sigma_offset = _jackknife(samples, plane, middle)
    return Symmetry(
        plane=plane,
        agreement=float(fine.agreement[best]),
        overlap=float(fine.overlap[best]),
        rival=_rival(samples, best, planes, fine.score, (normals, offsets, coarse.score), middle),
        sigma_rad=sigma_rad,
        sigma_offset=sigma_offset / samples.radius,
        radius=samples.radius,
    )


def _lattice(middle: Floats, up: Floats, radius: float) -> tuple[Floats, Floats]:
    """Normals [M, 3] and offsets [M] of the planes to try."""
    east = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    east /= np.linalg.norm(east)
    north = np.cross(up, east)
    azimuth, tilt = np.meshgrid(
        np.radians(np.arange(0.0, 180.0, _AZIMUTH_STEP_DEG)), np.radians(_TILTS_DEG), indexing="ij"
    )
    flat = np.cos(azimuth)[..., None] * east + np.sin(azimuth)[..., None] * north
    normals = (np.cos(tilt)[..., None] * flat + np.sin(tilt)[..., None] * up).reshape(-1, 3)
    shifts = np.linspace(-_REACH, _REACH, _OFFSETS) * radius
    offsets = (normals @ middle)[:, None] + shifts
    return np.repeat(normals, _OFFSETS, axis=0), offsets.ravel()


def _spread(count: int, most: int) -> NDArray[np.int64]:
    return np.arange(0, count, max(1, count // most))


def _is_different(cosine: Floats, shift: Floats, radius: float) -> NDArray[np.bool_]:
    far = np.abs(cosine) < np.cos(np.radians(_RIVAL_DEG))
    return np.asarray(far | (np.abs(shift) > _RIVAL_OFFSET * radius))


def _different(normals: Floats, shifts: Floats, score: Floats, radius: float) -> list[int]:
    """The best planes, of each group of similar ones the best."""
    chosen: list[int] = []
    open_ = np.ones(len(score), bool)
    while open_.any() and len(chosen) < _CANDIDATES:
        best = int(np.argmax(np.where(open_, score, -1.0)))
        chosen.append(best)
        cosine = normals @ normals[best]
        open_ &= _is_different(cosine, shifts - np.sign(cosine) * shifts[best], radius)
    return chosen


def _rival(
    samples: Samples,
    best: int,
    planes: list[Plane],
    scores: Floats,
    lattice: tuple[Floats, Floats, Floats],
    middle: Floats,
) -> float:
    """How nearly a clearly different plane agrees as well as the best one.

    The better of two: the other refined planes, at the fine tolerance, and all of the lattice, at the coarse
    one, both against the refined best.
    """
    plane, radius = planes[best], samples.radius
    own_shift = -float(plane.distance(middle))
    cosines = np.array([other.n @ plane.n for other in planes])
    shifts = np.array([-float(other.distance(middle)) for other in planes]) - np.sign(cosines) * own_shift
    different = _is_different(cosines, shifts, radius)
    refined = scores[different].max(initial=0.0) / max(float(scores[best]), 1e-9)
    normals, offsets, lattice_scores = lattice
    cosines = normals @ plane.n
    different = _is_different(cosines, offsets - normals @ middle - np.sign(cosines) * own_shift, radius)
    which = _spread(len(samples.points), _SEARCH_SAMPLES)
    own = mirror_agreement(samples, which, plane.n[None], np.array([plane.offset]), _COARSE * radius)
    searched = lattice_scores[different].max(initial=0.0) / max(float(own.score[0]), 1e-9)
    return float(min(1.0, max(refined, searched)))


def refine_plane(
    samples: Samples, plane: Plane, used: NDArray[np.bool_] | None = None, steps: int = _STEPS
) -> Plane:
    """The plane moved so that mirror images fall onto the tangent planes of the points that they meet.

    Args:
        samples: The cloud.
        plane: To begin with, right to some 10 degrees and a quarter of the radius.
        used: [N] bool, which samples take part; None = all.
        steps: At most.
    """
    used = np.ones(len(samples.points), bool) if used is None else used
    which = np.flatnonzero(used)
    which = which[_spread(len(which), _REFINE_SAMPLES)]
    points, normals = samples.points[which], samples.normals[which]
    for step in range(steps):
        tolerance = samples.radius * max(_FINE, _COARSE * 0.75**step)
        images, turned = plane.reflect(points), plane.reflect_directions(normals)
        ids = samples.ids_near(images)
        way, facing = images - samples.points[ids], samples.normals[ids]
        across = (way * facing).sum(axis=1)
        along = np.sqrt(np.maximum((way * way).sum(axis=1) - across**2, 0.0))
        cosine = (turned * facing).sum(axis=1)
        weight = (along < BEYOND_CELLS * samples.cell) * used[ids]
        weight = weight * np.clip(cosine, 0.0, 1.0) ** 4 / (1.0 + (across / tolerance) ** 2) ** 2
        weight = weight * samples.albedo_agreement(which, ids, _ALBEDO_TOLERANCE)
        moved = _step(plane, points, facing, across, weight)
        if moved is None:
            return plane
        change = plane.angle_to(moved) + abs(plane.offset - moved.offset) / samples.radius
        plane = moved
        if step > 5 and change < 1e-5:
            break
    return plane


def _step(plane: Plane, points: Floats, facing: Floats, across: Floats, weight: Floats) -> Plane | None:
    """One Gauss-Newton step in two angles and the offset; None where the images say nothing.

    The image is x' = x - 2 (n x - o) n, so a change (dn, do) moves it by -2 (dn x - do) n - 2 (n x - o) dn.
    """
    n = plane.n
    first = np.cross(n, np.eye(3)[int(np.argmin(np.abs(n)))])
    first /= np.linalg.norm(first)
    second = np.cross(n, first)
    middle = np.median(points, axis=0)
    centred = points - middle
    height = plane.distance(points)
    along_n = facing @ n
    columns = [-2.0 * ((centred @ axis) * along_n + height * (facing @ axis)) for axis in (first, second)]
    jacobian = np.stack([*columns, 2.0 * along_n], axis=1)
    left = jacobian.T @ (weight[:, None] * jacobian)
    right = -jacobian.T @ (weight * across)
    if not weight.sum() > 0:
        return None
    # A ball leaves the angles free; the ridge holds them where they are.
    ridge = 1e-6 * np.diag(np.maximum(np.diag(left), 1e-12))
    a, b, shift = np.linalg.solve(left + ridge, right)
    turn = np.hypot(a, b)
    limit = min(1.0, 0.1 / max(turn, 1e-12))  # radians a step: the model is linear
    normal = n + limit * (a * first + b * second)
    normal /= np.linalg.norm(normal)
    # The angles were taken about the middle of the points, so the offset there is what shifts.
    return Plane.of(normal, float(normal @ middle - plane.distance(middle) + limit * shift))


def _jackknife(samples: Samples, plane: Plane, middle: Floats) -> tuple[float, float]:
    """Standard errors of direction (rad) and place at the middle, by leaving out one block at a time.

    Blocks lie on both sides of the plane alike: slices by height and depth of points and their images.
    """
    up_like = np.cross(plane.n, np.eye(3)[int(np.argmin(np.abs(plane.n)))])
    up_like /= np.linalg.norm(up_like)
    depth_like = np.cross(plane.n, up_like)
    angle = np.arctan2((samples.points - middle) @ up_like, (samples.points - middle) @ depth_like)
    order = np.argsort(np.argsort(angle))
    block = order * _BLOCKS // len(order)
    tilts, shifts = [], []
    for left_out in range(_BLOCKS):
        moved = refine_plane(samples, plane, block != left_out, steps=5)
        sign = np.sign(moved.n @ plane.n)
        tilts.append(sign * moved.n - plane.n)
        shifts.append(float(sign * moved.distance(middle) - plane.distance(middle)))
    factor = (_BLOCKS - 1) / _BLOCKS
    spread = np.array(tilts) - np.mean(tilts, axis=0)
    sigma_rad = float(np.sqrt(factor * (spread**2).sum()))
    sigma_shift = float(np.sqrt(factor * ((np.array(shifts) - np.mean(shifts)) ** 2).sum()))
    return sigma_rad, sigma_shift
