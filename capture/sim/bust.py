"""The sitter, ready to be rendered: all triangles with the material at each vertex, in metres."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from capture.sim.eyes import make_eyes
from capture.sim.hair import HairShape, Strands, brow_strands, comb_strands
from capture.sim.head import BOUNDS, HeadShape
from capture.sim.meshing import Mesh, project_to_surface, subdivide, surface_nets
from capture.sim.noise import value_noise
from capture.sim.skin import paint_skin, skin_relief
from capture.sim.subject import Subject

_M_PER_MM = 1e-3
_EYE_GLOSS = 0.045
_STRAND_GLOSS = 0.014


@dataclass(frozen=True, eq=False)
class Bust:
    """Geometry and material of one subject. Vertices: skin, shirt and hair volume, then eyes, then strands.

    Attributes:
        vertices: [V, 3] float32, metres, world.
        normals: [V, 3] float32 unit, world.
        albedo: [V, 3] float32 linear reflectance.
        gloss: [V] float32 mirror reflectance at normal incidence.
        wet: [V] bool, sharp reflections (eyes).
        tangents: [V, 3] float32 along the strand; zero off the strands.
        triangles: [T, 3] int32, counter-clockwise seen from outside; those of the strands are the last.
        strand_start: index of the first vertex of a strand.
        occluder: a coarser mesh of the same surface, for broad shadows.
        occluder_of: [V, 3] int32 the occluder's vertices nearest to each vertex.
    """

    vertices: np.ndarray
    normals: np.ndarray
    albedo: np.ndarray
    gloss: np.ndarray
    wet: np.ndarray
    tangents: np.ndarray
    triangles: np.ndarray
    strand_start: int
    occluder: Mesh
    occluder_of: np.ndarray

    @property
    def solid_triangles(self) -> np.ndarray:
        """[S, 3] int32 triangles of skin, cloth, hair volume and eyes."""
        return self.triangles[self.triangles[:, 0] < self.strand_start]

    @property
    def strand_triangles(self) -> np.ndarray:
        """[S, 3] int32 triangles of the strands."""
        return self.triangles[self.triangles[:, 0] >= self.strand_start]


def build_bust(subject: Subject, cell_mm: float = 2.4, subdivisions: int = 1, strands: int = 8500) -> Bust:
    """Sculpt, mesh, paint and comb a subject.

    Args:
        subject: who.
        cell_mm: grid of the first mesh; each subdivision halves it.
        subdivisions: 0 for tests, 1 for a phone's resolution at half a metre.
        strands: number of hair ribbons (none when bald).
    """
    head = HeadShape(subject)
    hair = HairShape(head)

    def distance(points: np.ndarray) -> np.ndarray:
        return np.minimum(head.distance(points), hair.distance(points))

    coarse = surface_nets(distance, *BOUNDS, cell_mm)
    coarse = project_to_surface(coarse, distance, 0.5 * cell_mm)
    fine = coarse
    for _ in range(subdivisions):
        fine = subdivide(fine, _deserves_detail(fine.vertices, head, hair))
    fine = project_to_surface(fine, distance, 0.5 * cell_mm)
    smooth_normals = fine.normals()
    combed = hair.distance(fine.vertices) < head.distance(fine.vertices)
    relief = np.where(combed, 0.0, skin_relief(fine.vertices, head))
    fine = Mesh((fine.vertices + relief[:, None] * smooth_normals).astype(np.float32), fine.triangles)
    normals = fine.normals()

    albedo, gloss = paint_skin(fine.vertices, head)
    streaks = 1.0 + 0.35 * value_noise(hair.across(fine.vertices), 1.4, subject.seed + 90)
    albedo[combed] = (np.array(subject.hair) * 0.6 * streaks[:, None])[combed]
    gloss[combed] = 0.012
    eyes = make_eyes(head)
    rng = np.random.default_rng(subject.seed + 1000)
    locks: list[Strands] = []
    if combed.any() and strands:
        locks.append(comb_strands(hair, fine.vertices[combed], smooth_normals[combed], strands, rng))
    if strands:
        locks.append(brow_strands(head, fine.vertices, smooth_normals, max(60, strands // 9), rng))
    return _assemble(coarse, fine, normals, albedo, gloss, eyes.mesh, eyes.albedo, locks)


def _deserves_detail(points: np.ndarray, head: HeadShape, hair: HairShape) -> np.ndarray:
    """Vertices [V] bool of the skin and the collar: cloth shows no pores, hair is covered by strands."""
    collar = np.abs(head.collar(points)) < 9.0
    return ((points[:, 1] > -150.0) | collar) & (hair.distance(points) > head.distance(points) - 0.5)


def _assemble(
    coarse: Mesh,
    fine: Mesh,
    normals: np.ndarray,
    albedo: np.ndarray,
    gloss: np.ndarray,
    eyes: Mesh,
    eye_albedo: np.ndarray,
    locks: list[Strands],
) -> Bust:
    eye_start = len(fine.vertices)
    strand_start = eye_start + len(eyes.vertices)
    counts = np.cumsum([strand_start] + [len(lock.vertices) for lock in locks])
    empty = np.zeros((0, 3), dtype=np.float32)
    vertices = np.concatenate([fine.vertices, eyes.vertices, *(lock.vertices for lock in locks)])
    strand_triangles = [lock.triangles + start for lock, start in zip(locks, counts[:-1], strict=True)]
    count = len(vertices)
    all_gloss = np.full(count, _STRAND_GLOSS, dtype=np.float32)
    all_gloss[:eye_start] = gloss
    all_gloss[eye_start:strand_start] = _EYE_GLOSS
    wet = np.zeros(count, dtype=bool)
    wet[eye_start:strand_start] = True
    tangents = np.zeros((count, 3), dtype=np.float32)
    tangents[strand_start:] = np.concatenate([empty, *(lock.tangents for lock in locks)])
    _, nearest = cKDTree(coarse.vertices).query(vertices, k=3)
    return Bust(
        vertices=(vertices * _M_PER_MM).astype(np.float32),
        normals=np.concatenate([normals, eyes.normals(), *(lock.normals for lock in locks)]).astype(
            np.float32
        ),
        albedo=np.concatenate([albedo, eye_albedo, *(lock.albedo for lock in locks)]).astype(np.float32),
        gloss=all_gloss,
        wet=wet,
        tangents=tangents,
        triangles=np.concatenate([fine.triangles, eyes.triangles + eye_start, *strand_triangles]).astype(
            np.int32
        ),
        strand_start=strand_start,
        occluder=Mesh((coarse.vertices * _M_PER_MM).astype(np.float32), coarse.triangles),
        occluder_of=nearest.astype(np.int32),
    )
