"""Deterministic procedural noise on points in space: the grain of skin, hair, wood and walls."""

from __future__ import annotations

import numpy as np

_LATTICE = 64  # values along each axis of the lattice, which repeats


def value_noise(points: np.ndarray, scale: float, seed: int) -> np.ndarray:
    """Smooth noise with features of about `scale`: random lattice values, interpolated with a smooth step.

    Args:
        points: [P, 3], any unit; the noise repeats every 64 scales.
        scale: lattice spacing in the unit of `points`.
        seed: any integer of 0 or more; another seed is another noise.

    Returns:
        [P] float32, in [-1, 1], mean near 0.
    """
    lattice = np.random.default_rng([seed, 9173]).random(_LATTICE**3, dtype=np.float32)
    scaled = np.asarray(points, dtype=np.float32).T / np.float32(scale)
    cell = np.floor(scaled)
    weight = scaled - cell
    weight = weight * weight * (3.0 - 2.0 * weight)
    low = cell.astype(np.int32) & (_LATTICE - 1)
    high = (low + 1) & (_LATTICE - 1)
    planes = [axis * np.int32(step) for axis, step in zip(low, (_LATTICE**2, _LATTICE, 1), strict=True)]
    nexts = [axis * np.int32(step) for axis, step in zip(high, (_LATTICE**2, _LATTICE, 1), strict=True)]

    def along_z(start: np.ndarray) -> np.ndarray:
        first = lattice[start + planes[2]]
        return first + weight[2] * (lattice[start + nexts[2]] - first)

    def along_y(start: np.ndarray) -> np.ndarray:
        first = along_z(start + planes[1])
        return first + weight[1] * (along_z(start + nexts[1]) - first)

    first = along_y(planes[0])
    return 2.0 * (first + weight[0] * (along_y(nexts[0]) - first)) - 1.0


def fractal_noise(points: np.ndarray, scale: float, seed: int, octaves: int = 4) -> np.ndarray:
    """Sum of `octaves` value noises, each of half the scale and half the amplitude of the one before.

    Returns:
        [P] float32, in about [-1, 1].
    """
    total = np.zeros(len(points), dtype=np.float32)
    amplitude, norm = 1.0, 0.0
    for octave in range(octaves):
        total += amplitude * value_noise(points, scale / 2**octave, seed + 101 * octave)
        norm += amplitude
        amplitude *= 0.5
    return total / np.float32(norm)
