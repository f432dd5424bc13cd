"""Light from far away: latitude-longitude maps, what a surface receives of them, and what it mirrors.

A map is [H, W, 3] linear radiance; row i and column j look towards
(sin theta sin phi, cos theta, -sin theta cos phi) with theta = pi (i + .5) / H and phi = 2 pi (j + .5) / W.
Tables over directions are octahedral squares (Cigolle et al. 2014), looked up without trigonometry.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

_TABLE = 48  # directions along the edge of a table; irradiance and lobes are smooth
_SHARP_TABLE = 64
_SKIN_LOBE = 3  # binary logarithm of the exponent of skin's mirrored lobe: cos^8
_WET_LOBE = 8  # and of the eyes': cos^256, about 5 degrees wide


def latlong_directions(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Unit directions [H, W, 3] and solid angles [H, W] (steradian) of a map's pixels."""
    theta = np.pi * (np.arange(height) + 0.5) / height
    phi = 2 * np.pi * (np.arange(width) + 0.5) / width
    sin = np.sin(theta)[:, None]
    directions = np.stack(
        [sin * np.sin(phi), np.repeat(np.cos(theta)[:, None], width, axis=1), -sin * np.cos(phi)], axis=-1
    )
    solid = np.repeat(sin * (np.pi / height) * (2 * np.pi / width), width, axis=1)
    return directions, solid


def fibonacci_directions(count: int) -> np.ndarray:
    """[count, 3] unit directions, nearly even over the sphere."""
    k = np.arange(count) + 0.5
    y = 1.0 - 2.0 * k / count
    turn = np.pi * (3.0 - np.sqrt(5.0)) * k
    radius = np.sqrt(1.0 - y * y)
    return np.stack([radius * np.cos(turn), y, radius * np.sin(turn)], axis=-1)


def _octahedral_directions(size: int) -> np.ndarray:
    grid = (np.arange(size) / (size - 1)) * 2 - 1
    x, y = np.meshgrid(grid, grid)
    z = 1.0 - np.abs(x) - np.abs(y)
    folded_x, folded_y = (1 - np.abs(y)) * np.copysign(1, x), (1 - np.abs(x)) * np.copysign(1, y)
    unit = np.stack([np.where(z < 0, folded_x, x), np.where(z < 0, folded_y, y), z], axis=-1)
    return unit / np.linalg.norm(unit, axis=-1, keepdims=True)


def look_up(table: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Values [P, 3] of an octahedral table [S, S, 3] in unit directions [P, 3], bilinear."""
    x, y, z = directions.T
    scale = 1.0 / np.maximum(np.abs(x) + np.abs(y) + np.abs(z), 1e-9)
    u, v = x * scale, y * scale
    back = z < 0
    folded_u = np.where(back, (1 - np.abs(v)) * np.copysign(np.float32(1), u), u)
    folded_v = np.where(back, (1 - np.abs(u)) * np.copysign(np.float32(1), v), v)
    half = np.float32((len(table) - 1) / 2)
    count = len(directions)
    width = 1024  # OpenCV's remap takes no side longer than 32767
    padded = -count % width
    columns, rows = (np.pad((c + 1) * half, (0, padded)).reshape(-1, width) for c in (folded_u, folded_v))
    values = cv2.remap(table, columns.astype(np.float32), rows.astype(np.float32), cv2.INTER_LINEAR)
    return values.reshape(-1, 3)[:count]


@dataclass(frozen=True, eq=False)
class Environment:
    """A distant light and its tables.

    Attributes:
        radiance: [H, W, 3] linear map.
        diffuse: [S, S, 3] octahedral: radiance of a white Lambertian surface over its normal (irradiance /
            pi).
        mirrored: [S, S, 3] octahedral: mean radiance in skin's lobe around the mirror direction.
        mirrored_wet: [S, S, 3] the same for eyes.
    """

    radiance: np.ndarray
    diffuse: np.ndarray
    mirrored: np.ndarray
    mirrored_wet: np.ndarray

    @classmethod
    def from_map(cls, radiance: np.ndarray) -> Environment:
        """Tables of a map [H, W, 3]."""
        directions, solid = latlong_directions(*radiance.shape[:2])
        flat, weight = directions.reshape(-1, 3).astype(np.float32), solid.reshape(-1, 1).astype(np.float32)
        light = radiance.reshape(-1, 3).astype(np.float32)

        def convolve(size: int, squarings: int | None) -> np.ndarray:
            wanted = _octahedral_directions(size).reshape(-1, 3).astype(np.float32)
            rows = []
            for part in np.array_split(wanted, max(1, len(wanted) // 512)):
                cosine = np.maximum(part @ flat.T, 0.0)
                if squarings is None:
                    rows.append(cosine @ (light * weight) / np.float32(np.pi))
                else:
                    lobe = cosine
                    for _ in range(squarings):
                        lobe = lobe * lobe
                    rows.append(lobe @ (light * weight) / np.maximum(lobe @ weight, 1e-12))
            return np.concatenate(rows).reshape(size, size, 3).astype(np.float32)

        return cls(
            radiance.astype(np.float32),
            convolve(_TABLE, None),
            convolve(_TABLE, _SKIN_LOBE),
            convolve(_SHARP_TABLE, _WET_LOBE),
        )

    def cells(self, directions: np.ndarray) -> np.ndarray:
        """Power [K, 3] (radiance times solid angle) of the map's parts nearest to each of K directions."""
        pixels, solid = latlong_directions(*self.radiance.shape[:2])
        nearest = np.argmax(pixels.reshape(-1, 3) @ directions.T, axis=-1)
        power = (self.radiance * solid[..., None]).reshape(-1, 3)
        return np.stack(
            [np.bincount(nearest, weights=power[:, c], minlength=len(directions)) for c in range(3)], axis=-1
        )


@dataclass(frozen=True, eq=False)
class TurnedEnvironment:
    """An environment as one sees it who has turned in it.

    Attributes:
        environment: the light.
        turn: [3, 3] from the turned axes to the environment's.
    """

    environment: Environment
    turn: np.ndarray

    def cells(self, directions: np.ndarray) -> np.ndarray:
        """As `Environment.cells`, of directions in the turned axes."""
        return self.environment.cells(directions @ self.turn.T)


@dataclass(frozen=True)
class SoftBox:
    """A glow in an environment: towards a direction, so many radians wide, of a radiance."""

    towards: tuple[float, float, float]
    width_rad: float
    radiance: tuple[float, float, float]


def studio_map(
    sky: tuple[float, float, float],
    ground: tuple[float, float, float],
    boxes: tuple[SoftBox, ...],
    height: int = 64,
) -> np.ndarray:
    """A procedural environment [height, 2 height, 3]: two half-spaces and some soft boxes."""
    directions, _ = latlong_directions(height, 2 * height)
    up = np.clip(directions[..., 1:2] * 1.5 + 0.5, 0.0, 1.0)
    result = np.array(ground) * (1 - up) + np.array(sky) * up
    for box in boxes:
        towards = np.array(box.towards) / np.linalg.norm(box.towards)
        angle = np.arccos(np.clip(directions @ towards, -1.0, 1.0))
        glow = 1.0 / (1.0 + (angle / box.width_rad) ** 6)
        result = result + glow[..., None] * np.array(box.radiance)
    return result.astype(np.float32)
