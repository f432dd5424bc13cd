"""What stands in the room: walls, floor and ceiling, shelves, cupboards, pictures, a window and a lamp."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from capture.sim.room_textures import (
    Texture,
    bookshelf_texture,
    carpet_texture,
    plain_texture,
    poster_texture,
    wallpaper_texture,
    window_texture,
    wood_texture,
)

Vector = tuple[float, float, float]

# The room's inner faces, metres; the head is at the origin and looks towards FRONT.
LEFT, RIGHT, FLOOR, CEILING, BACK, FRONT = -1.6, 1.6, -1.25, 1.25, -1.6, 2.0

_PLASTER = (0.70, 0.68, 0.64)
_CLAY = (0.35, 0.12, 0.07)
_BARE_WALL = (0.62, 0.61, 0.58)
_DAYLIGHT = (1.9, 2.0, 2.2)
_LAMP = (2.1, 1.75, 1.3)  # radiance; the room's light is scaled as a whole later


@dataclass(frozen=True, eq=False)
class Panel:
    """A textured rectangle; its front is the side from which u x v points at the viewer.

    Attributes:
        corner: [3] metres; where the texture's first row and column are.
        u: [3] edge along the texture's columns, metres.
        v: [3] edge along its rows, metres.
        texture: [h, w, 3] linear reflectance, or radiance when glowing.
        glowing: it emits its texture instead of reflecting light.
    """

    corner: np.ndarray
    u: np.ndarray
    v: np.ndarray
    texture: np.ndarray
    glowing: bool = False

    @property
    def normal(self) -> np.ndarray:
        """[3] unit, towards the viewer."""
        n = np.cross(self.v, self.u)
        return n / np.linalg.norm(n)

    def grid(self, rows: int, columns: int) -> np.ndarray:
        """[rows, columns, 3] points, from corner to corner."""
        a = np.linspace(0.0, 1.0, columns)[None, :, None]
        b = np.linspace(0.0, 1.0, rows)[:, None, None]
        return self.corner + a * self.u + b * self.v


def _rectangle(corner: Vector, u: Vector, v: Vector, paint: Texture, texel_m: float = 0.004) -> Panel:
    edge_u, edge_v = np.array(u, float), np.array(v, float)
    columns = max(8, round(float(np.linalg.norm(edge_u)) / texel_m))
    rows = max(8, round(float(np.linalg.norm(edge_v)) / texel_m))
    return Panel(np.array(corner, float), edge_u, edge_v, paint(rows, columns))


def _glowing(panel: Panel) -> Panel:
    return replace(panel, glowing=True)


def _box(low: Vector, high: Vector, front: Texture, side: Texture) -> list[Panel]:
    """Visible faces of a cupboard: front (+z), both sides and the top."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    return [
        _rectangle((x0, y1, z1), (x1 - x0, 0, 0), (0, y0 - y1, 0), front, 0.003),
        _rectangle((x1, y1, z1), (0, 0, z0 - z1), (0, y0 - y1, 0), side),
        _rectangle((x0, y1, z0), (0, 0, z1 - z0), (0, y0 - y1, 0), side),
        _rectangle((x0, y1, z0), (x1 - x0, 0, 0), (0, 0, z1 - z0), side),
    ]


def bare_room() -> list[Panel]:
    """The panels of a room without furniture, pictures or texture; its lights are behind the camera."""
    wide, high, deep = RIGHT - LEFT, CEILING - FLOOR, FRONT - BACK
    wall = plain_texture(_BARE_WALL)
    walls = [
        _rectangle((LEFT, CEILING, BACK), (wide, 0, 0), (0, -high, 0), wall, 0.02),
        _rectangle((RIGHT, CEILING, BACK), (0, 0, deep), (0, -high, 0), wall, 0.02),
        _rectangle((LEFT, CEILING, FRONT), (0, 0, -deep), (0, -high, 0), wall, 0.02),
        _rectangle((RIGHT, CEILING, FRONT), (-wide, 0, 0), (0, -high, 0), wall, 0.02),
        _rectangle((LEFT, FLOOR, BACK), (wide, 0, 0), (0, 0, deep), wall, 0.02),
        _rectangle((LEFT, CEILING, FRONT), (wide, 0, 0), (0, 0, -deep), plain_texture(_PLASTER), 0.02),
    ]
    window = _rectangle((1.0, 1.0, FRONT - 0.01), (-2.0, 0, 0), (0, -1.25, 0), plain_texture(_DAYLIGHT), 0.02)
    lamp = _rectangle((-0.5, CEILING - 0.01, 1.2), (0.7, 0, 0), (0, 0, -0.4), plain_texture(_LAMP), 0.02)
    return [*walls, _glowing(window), _glowing(lamp)]


def furnish(seed: int) -> list[Panel]:
    """The panels of a room around the head at the origin, seen from inside."""
    seeds = iter(np.random.default_rng(seed + 5000).integers(99, size=20).tolist())
    paper, wood, dark = (
        wallpaper_texture(next(seeds)),
        wood_texture(next(seeds), 0.9),
        wood_texture(next(seeds), 0.45),
    )
    wide, high, deep = RIGHT - LEFT, CEILING - FLOOR, FRONT - BACK
    walls = [
        _rectangle((LEFT, CEILING, BACK), (wide, 0, 0), (0, -high, 0), paper),
        _rectangle((RIGHT, CEILING, BACK), (0, 0, deep), (0, -high, 0), paper),
        _rectangle((LEFT, CEILING, FRONT), (0, 0, -deep), (0, -high, 0), paper),
        _rectangle((RIGHT, CEILING, FRONT), (-wide, 0, 0), (0, -high, 0), paper, 0.012),
        _rectangle((LEFT, FLOOR, BACK), (wide, 0, 0), (0, 0, deep), carpet_texture(next(seeds)), 0.008),
        _rectangle((LEFT, CEILING, FRONT), (wide, 0, 0), (0, 0, -deep), plain_texture(_PLASTER), 0.012),
    ]
    window = _rectangle((RIGHT - 0.01, 1.0, 0.25), (0, 0, 1.1), (0, -1.25, 0), window_texture(next(seeds)))
    lamp = _rectangle((-0.5, CEILING - 0.01, 1.2), (0.7, 0, 0), (0, 0, -0.4), plain_texture(_LAMP), 0.02)
    shelf = _box(
        (LEFT + 0.1, FLOOR, BACK), (LEFT + 1.05, 0.72, BACK + 0.28), bookshelf_texture(next(seeds)), dark
    )
    cupboard = _box((0.35, FLOOR, BACK), (1.35, -0.42, BACK + 0.4), wood, wood)
    pot = _box((0.55, -0.42, BACK + 0.05), (0.72, -0.16, BACK + 0.22), plain_texture(_CLAY), dark)
    panelling = [
        _rectangle((LEFT + 0.02, -0.52, 1.5), (0, 0, -1.5), (0, -0.75, 0), wood),
        _rectangle((RIGHT - 0.02, -0.55, -1.45), (0, 0, 1.5), (0, -0.7, 0), dark),
    ]
    pictures = [
        _rectangle(corner, u, v, poster_texture(next(seeds)), 0.003)
        for corner, u, v in (
            ((0.25, 0.75, BACK + 0.01), (0.6, 0, 0), (0, -0.8, 0)),
            ((1.0, 0.55, BACK + 0.01), (0.42, 0, 0), (0, -0.55, 0)),
            ((RIGHT - 0.01, 0.7, -1.3), (0, 0, 0.75), (0, -0.55, 0)),
            ((LEFT + 0.01, 0.62, 1.35), (0, 0, -0.7), (0, -0.9, 0)),
            ((LEFT + 0.01, 0.75, 0.3), (0, 0, -0.5), (0, -0.65, 0)),
            ((LEFT + 0.012, 0.0, 0.15), (0, 0, -0.34), (0, -0.42, 0)),
        )
    ]
    return [*walls, _glowing(window), _glowing(lamp), *shelf, *cupboard, *pot, *panelling, *pictures]
