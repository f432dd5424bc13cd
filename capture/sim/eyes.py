"""Eyeballs: spheres with a bulging cornea, a fibrous iris, a pupil and faintly veined white."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from capture.sim.head import EYE_CENTRE, EYE_RADIUS, HeadShape
from capture.sim.meshing import Mesh
from capture.sim.noise import fractal_noise
from capture.sim.sdf import smooth_step
from capture.sim.subject import Subject

_RINGS, _SPOKES = 64, 96
_IRIS_RAD = 0.50  # half angle that the iris subtends at the eye's centre (5.8 mm on a 12 mm eye)
_PUPIL_RAD = 0.19
_CORNEA_MM = 0.7
_SCLERA = (0.56, 0.51, 0.47)


@dataclass(frozen=True, eq=False)
class Eyes:
    """Both eyeballs' front halves, in head millimetres.

    Attributes:
        mesh: the surface.
        albedo: [V, 3] linear reflectance.
    """

    mesh: Mesh
    albedo: np.ndarray


def make_eyes(head: HeadShape) -> Eyes:
    """Both eyes, looking ahead and a little inwards at whoever holds the phone."""
    subject = head.subject
    meshes: list[Mesh] = []
    albedos = []
    for side in (1.0, -1.0):
        angle = np.linspace(0.0, 0.62 * np.pi, _RINGS)[:, None]
        around = np.linspace(0.0, 2 * np.pi, _SPOKES, endpoint=False)[None, :]
        radius = EYE_RADIUS - 0.25 + _CORNEA_MM * smooth_step(angle, _IRIS_RAD * 1.15, 0.0)
        unit = np.stack(
            [np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle) + 0 * around],
            axis=-1,
        )
        inwards = np.radians(3.2) * -side
        turn = np.array(
            [[np.cos(inwards), 0, np.sin(inwards)], [0, 1, 0], [-np.sin(inwards), 0, np.cos(inwards)]]
        )
        centre = np.array(EYE_CENTRE) * [side, 1, 1]
        vertices = head.unfold((radius[..., None] * unit).reshape(-1, 3) @ turn.T + centre)
        meshes.append(Mesh(vertices.astype(np.float32), _grid_triangles() + len(meshes) * _RINGS * _SPOKES))
        albedos.append(_paint(angle + 0 * around, around + 0 * angle, subject, subject.seed + int(side)))
    mesh = Mesh(
        np.concatenate([m.vertices for m in meshes]),
        np.concatenate([m.triangles for m in meshes]).astype(np.int32),
    )
    return Eyes(mesh, np.concatenate(albedos))


def _grid_triangles() -> np.ndarray:
    index = np.arange(_RINGS * _SPOKES).reshape(_RINGS, _SPOKES)
    right = np.roll(index, -1, axis=1)
    a, b, c, d = index[:-1], right[:-1], right[1:], index[1:]
    return np.concatenate(
        [np.stack([a, d, c], axis=-1).reshape(-1, 3), np.stack([a, c, b], axis=-1).reshape(-1, 3)]
    )


def _paint(angle: np.ndarray, around: np.ndarray, subject: Subject, seed: int) -> np.ndarray:
    """Reflectance [V, 3] over polar angle from the gaze and azimuth around it, each [R, S] radians."""
    fibre_at = np.stack([np.cos(around) * 9, np.sin(around) * 9, angle * 7], axis=-1).reshape(-1, 3)
    fibres = fractal_noise(fibre_at, 1.0, seed + 31, 3)
    angle = angle.ravel()
    iris = np.array(subject.iris) * (1.0 + 0.55 * fibres)[:, None]
    inner = smooth_step(angle, 0.36, 0.22)[:, None]
    iris = iris * (1 - 0.5 * inner) + 0.5 * inner * np.array([0.12, 0.07, 0.025])
    limbus = np.exp(-0.5 * ((angle - _IRIS_RAD) / 0.045) ** 2)[:, None]
    vein_at = np.stack([np.cos(around) * 6, np.sin(around) * 6, 0 * around], axis=-1).reshape(-1, 3)
    veins = np.clip(fractal_noise(vein_at, 1.0, seed + 57, 3), 0, 1) * smooth_step(angle, 0.6, 1.2)
    sclera = np.array(_SCLERA) * (1.0 - veins[:, None] * np.array([0.1, 0.5, 0.5]))
    sclera = sclera * (1.0 - 0.25 * smooth_step(angle, 0.85, 1.35)[:, None] * np.array([0.4, 1.0, 1.0]))
    outside = smooth_step(angle, _IRIS_RAD - 0.03, _IRIS_RAD + 0.03)[:, None]
    colour = iris * (1 - outside) + sclera * outside
    colour *= 1.0 - 0.6 * limbus * (1 - 0.4 * outside)
    pupil = smooth_step(angle, _PUPIL_RAD + 0.03, _PUPIL_RAD - 0.03)[:, None]
    return (colour * (1 - pupil) + 0.004 * pupil).astype(np.float32)
