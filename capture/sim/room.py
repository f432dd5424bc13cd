"""The room behind the sitter: papered walls, furniture and pictures, a window and a lamp, with their light baked in.

A room is a list of rectangles. Their textures lie in one atlas; the light that they receive from window and lamp is
computed once on a coarse grid and multiplied in. What the sitter receives of the room is the panorama seen from the
middle of the head.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from capture.cameras import Camera
from capture.sim.environment import latlong_directions
from capture.sim.rasterize import Raster, project
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

_PATCH_M = 0.25  # side of the triangles' squares
_ATLAS_WIDTH = 2048
_AMBIENT = 0.9  # light that has bounced often, relative to the direct light's mean over the panels


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


def _rectangle(corner: tuple, u: tuple, v: tuple, texture: Texture, texel_m: float, **kind: bool) -> Panel:
    edge_u, edge_v = np.array(u, float), np.array(v, float)
    columns = max(8, round(np.linalg.norm(edge_u) / texel_m))
    rows = max(8, round(np.linalg.norm(edge_v) / texel_m))
    return Panel(np.array(corner, float), edge_u, edge_v, texture(rows, columns), **kind)


def _box(low: tuple, high: tuple, front: Texture, side: Texture) -> list[Panel]:
    """Visible faces of a cupboard: front (+z), both sides and the top."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    return [
        _rectangle((x0, y1, z1), (x1 - x0, 0, 0), (0, y0 - y1, 0), front, 0.003),
        _rectangle((x1, y1, z1), (0, 0, z0 - z1), (0, y0 - y1, 0), side, 0.004),
        _rectangle((x0, y1, z0), (0, 0, z1 - z0), (0, y0 - y1, 0), side, 0.004),
        _rectangle((x0, y1, z0), (x1 - x0, 0, 0), (0, 0, z1 - z0), side, 0.004),
    ]


def furnish(seed: int) -> list[Panel]:
    """The panels of a room of 3.2 x 2.5 x 3.6 m around the head at the origin."""
    rng = np.random.default_rng(seed + 5000)

    def below(value: int) -> int:
        return int(rng.integers(value))

    paper, wood, dark = (
        wallpaper_texture(below(99)),
        wood_texture(below(99), 0.9),
        wood_texture(below(99), 0.45),
    )
    left, right, floor, ceiling, back, front = -1.6, 1.6, -1.25, 1.25, -1.6, 2.0
    wide, deep, high = right - left, front - back, ceiling - floor
    panels = [
        _rectangle((left, ceiling, back), (wide, 0, 0), (0, -high, 0), paper, 0.004),
        _rectangle((right, ceiling, back), (0, 0, deep), (0, -high, 0), paper, 0.004),
        _rectangle((left, ceiling, front), (0, 0, -deep), (0, -high, 0), paper, 0.004),
        _rectangle((right, ceiling, front), (-wide, 0, 0), (0, -high, 0), paper, 0.012),
        _rectangle((left, floor, back), (wide, 0, 0), (0, 0, deep), carpet_texture(below(99)), 0.008),
        _rectangle(
            (left, ceiling, front), (wide, 0, 0), (0, 0, -deep), plain_texture((0.7, 0.68, 0.64)), 0.012
        ),
        _rectangle(
            (right - 0.01, 1.0, 0.25),
            (0, 0, 1.1),
            (0, -1.25, 0),
            window_texture(below(99)),
            0.004,
            glowing=True,
        ),
        _rectangle(
            (-0.5, ceiling - 0.01, 1.2),
            (0.7, 0, 0),
            (0, 0, -0.4),
            plain_texture((2.1, 1.75, 1.3)),
            0.02,
            glowing=True,
        ),
    ]
    books = bookshelf_texture(below(99))
    panels += _box((left + 0.1, floor, back), (left + 1.05, 0.72, back + 0.28), books, dark)
    panels += _box((0.35, floor, back), (1.35, -0.42, back + 0.4), wood, wood)
    panels += _box(
        (0.55, -0.42, back + 0.05), (0.72, -0.16, back + 0.22), plain_texture((0.35, 0.12, 0.07)), dark
    )
    panels += [
        _rectangle((0.25, 0.75, back + 0.01), (0.6, 0, 0), (0, -0.8, 0), poster_texture(below(99)), 0.003)
    ]
    panels += [
        _rectangle((1.0, 0.55, back + 0.01), (0.42, 0, 0), (0, -0.55, 0), poster_texture(below(99)), 0.003)
    ]
    panels += [
        _rectangle((right - 0.01, 0.7, -1.3), (0, 0, 0.75), (0, -0.55, 0), poster_texture(below(99)), 0.003)
    ]
    panels += [
        _rectangle((left + 0.01, 0.62, 1.35), (0, 0, -0.7), (0, -0.9, 0), poster_texture(below(99)), 0.003)
    ]
    panels += [
        _rectangle((left + 0.01, 0.75, 0.3), (0, 0, -0.5), (0, -0.65, 0), poster_texture(below(99)), 0.003)
    ]
    panels += [
        _rectangle((left + 0.012, 0.0, 0.15), (0, 0, -0.34), (0, -0.42, 0), poster_texture(below(99)), 0.003)
    ]
    panels += [_rectangle((left + 0.02, -0.52, 1.5), (0, 0, -1.5), (0, -0.75, 0), wood, 0.004)]
    panels += [_rectangle((right - 0.02, -0.55, -1.45), (0, 0, 1.5), (0, -0.7, 0), dark, 0.004)]
    return panels


def _received(panel: Panel, lights: list[Panel], rows: int, columns: int) -> np.ndarray:
    """Direct irradiance / pi [rows, columns, 3] of a panel from the glowing ones, without shadows between furniture."""
    points = panel.grid(rows, columns)
    total = np.zeros((rows, columns, 3))
    for light in lights:
        samples, size = 5, light.texture.shape
        texture = cv2.resize(light.texture, (samples, samples), interpolation=cv2.INTER_AREA)
        area = np.linalg.norm(np.cross(light.u, light.v)) / samples**2
        offsets = (np.arange(samples) + 0.5) / samples
        for i in range(samples):
            for j in range(samples):
                at = light.corner + offsets[j] * light.u + offsets[i] * light.v
                ray = at - points
                square = np.maximum((ray**2).sum(-1), 0.02)
                cosines = np.maximum(ray @ panel.normal, 0) * np.maximum(-(ray @ light.normal), 0) / square
                total += (cosines * area / (np.pi * square))[..., None] * texture[i, j]
        assert size[2] == 3
    return total


@dataclass(frozen=True, eq=False)
class Room:
    """Triangles and atlas of the furnished room.

    Attributes:
        vertices: [V, 3] float32, metres.
        normals: [V, 3] float32 unit.
        texels: [V, 2] float32 position in the atlas (texel centres at whole numbers).
        triangles: [T, 3] int32.
        radiance: [A, B, 3] float32 atlas of what the panels send out under the room's own light.
        albedo: [A, B, 3] float32 atlas of their reflectance; 0 where glowing.
    """

    vertices: np.ndarray
    normals: np.ndarray
    texels: np.ndarray
    triangles: np.ndarray
    radiance: np.ndarray
    albedo: np.ndarray

    @classmethod
    def build(cls, seed: int, level: float) -> Room:
        """A furnished room, its light scaled so that a white surface facing the front receives `level` (pi-scaled)."""
        panels = furnish(seed)
        lights = [panel for panel in panels if panel.glowing]
        radiances, albedos = [], []
        mean = np.mean([_received(panel, lights, 4, 4).mean() for panel in panels if not panel.glowing])
        for panel in panels:
            if panel.glowing:
                radiances.append(panel.texture)
                albedos.append(np.zeros_like(panel.texture))
                continue
            light = _received(panel, lights, 24, 24) + _AMBIENT * mean * np.array([1.05, 1.0, 0.92])
            light = cv2.resize(
                light.astype(np.float32), panel.texture.shape[1::-1], interpolation=cv2.INTER_LINEAR
            )
            radiances.append(panel.texture * light)
            albedos.append(panel.texture)
        room = cls._assemble(panels, radiances, albedos)
        directions, solid = latlong_directions(32, 64)
        facing = np.maximum(directions[..., 2], 0.0) * solid
        seen = (room.panorama(32) * facing[..., None]).sum((0, 1)).mean() / np.pi
        return cls(
            room.vertices,
            room.normals,
            room.texels,
            room.triangles,
            (room.radiance * np.float32(level / seen)),
            room.albedo,
        )

    @classmethod
    def _assemble(cls, panels: list[Panel], radiances: list[np.ndarray], albedos: list[np.ndarray]) -> Room:
        places, shape = _pack([texture.shape[:2] for texture in radiances])
        radiance, albedo = np.zeros((*shape, 3), np.float32), np.zeros((*shape, 3), np.float32)
        vertices, normals, texels, triangles, count = [], [], [], [], 0
        for panel, light, paint, (row, column) in zip(panels, radiances, albedos, places, strict=True):
            height, width = light.shape[:2]
            radiance[row : row + height, column : column + width] = light
            albedo[row : row + height, column : column + width] = paint
            columns = max(2, int(np.ceil(np.linalg.norm(panel.u) / _PATCH_M)) + 1)
            rows = max(2, int(np.ceil(np.linalg.norm(panel.v) / _PATCH_M)) + 1)
            vertices.append(panel.grid(rows, columns).reshape(-1, 3))
            normals.append(np.repeat(panel.normal[None], rows * columns, axis=0))
            at_column, at_row = np.meshgrid(
                column + np.linspace(0, width - 1, columns), row + np.linspace(0, height - 1, rows)
            )
            texels.append(np.stack([at_column, at_row], axis=-1).reshape(-1, 2))
            index = np.arange(rows * columns).reshape(rows, columns) + count
            a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
            triangles += [np.stack(corner, axis=-1).reshape(-1, 3) for corner in ((a, c, b), (a, d, c))]
            count += rows * columns
        return cls(
            np.concatenate(vertices).astype(np.float32),
            np.concatenate(normals).astype(np.float32),
            np.concatenate(texels).astype(np.float32),
            np.concatenate(triangles).astype(np.int32),
            radiance,
            albedo,
        )

    def draw(
        self, camera: Camera, flash_position: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """What a camera sees of the room.

        Args:
            camera: where from.
            flash_position: [3] world; None = do not compute the flash's part.

        Returns:
            Radiance [H, W, 3] of the room's light, and that of a flash of unit C (albedo / d^2 * cosine).
        """
        _, depth = project(camera, self.vertices)
        visible = self.triangles[(depth[self.triangles] > 0.05).all(axis=-1)]
        strength = np.zeros(len(self.vertices), dtype=np.float32)
        if flash_position is not None:
            ray = (flash_position - self.vertices).astype(np.float32)
            square = (ray * ray).sum(axis=-1)
            strength = np.maximum((ray * self.normals).sum(axis=-1), 0.0) / square**1.5
        raster = Raster.empty(camera)
        raster.draw(self.vertices, visible, np.column_stack([self.texels, strength]))
        column, row = raster.values[..., 0], raster.values[..., 1]
        room = cv2.remap(self.radiance, column, row, cv2.INTER_LINEAR)
        if flash_position is None:
            return room, None
        return room, cv2.remap(self.albedo, column, row, cv2.INTER_LINEAR) * raster.values[..., 2:]

    def panorama(self, height: int) -> np.ndarray:
        """[height, 2 height, 3] latitude-longitude map of the radiance arriving at the origin."""
        directions, _ = latlong_directions(height, 2 * height)
        size = 2 * height
        K = np.array([[size / 2, 0, size / 2], [0, size / 2, size / 2], [0, 0, 1.0]])
        result = np.zeros((height, 2 * height, 3), dtype=np.float32)
        longest = np.argmax(np.abs(directions), axis=-1)
        for axis in range(3):
            for sign in (1.0, -1.0):
                forward, right = np.eye(3)[axis] * sign, np.eye(3)[(axis + 1) % 3]
                cam_from_world = np.eye(4)
                cam_from_world[:3, :3] = np.stack([right, np.cross(forward, right), forward])
                face, _ = self.draw(Camera("face", size, size, K, cam_from_world))
                chosen = (longest == axis) & (directions[..., axis] * sign > 0)
                local = directions[chosen] @ cam_from_world[:3, :3].T
                pixel = np.clip((local[:, :2] / local[:, 2:] + 1.0) * (size / 2), 0, size - 1).astype(int)
                result[chosen] = face[pixel[:, 1], pixel[:, 0]]
        return result


def _pack(shapes: list[tuple[int, int]]) -> tuple[list[tuple[int, int]], tuple[int, int]]:
    """Places (row, column) of rectangles in an atlas, laid in shelves from the tallest, and the atlas's shape."""
    places = [(0, 0)] * len(shapes)
    row = column = shelf = 0
    for i in sorted(range(len(shapes)), key=lambda k: -shapes[k][0]):
        height, width = shapes[i]
        if column + width > _ATLAS_WIDTH:
            row, column, shelf = row + shelf + 1, 0, 0
        places[i] = (row, column)
        column += width + 1
        shelf = max(shelf, height)
    return places, (row + shelf, _ATLAS_WIDTH)
