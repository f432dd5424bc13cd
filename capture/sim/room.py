"""The room behind the sitter: walls, furniture, pictures, a window and a lamp, with the light baked in.

A room is a list of rectangles. Their textures lie in one atlas; the light that they receive from window and
lamp is computed once on a coarse grid and multiplied in. What the sitter receives of the room is the
panorama seen from the middle of the head.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from capture.cameras import Camera
from capture.sim.decor import DecorConfig
from capture.sim.environment import latlong_directions
from capture.sim.furniture import Panel, bare_room, furnish
from capture.sim.markers import PLACES, Marker
from capture.sim.rasterize import Raster, project

PANORAMA_ROWS = 64  # of the map that lights the sitter
_PATCH_M = 0.25  # side of the triangles' squares
_ATLAS_WIDTH = 2048
_AMBIENT = 0.9  # light that has bounced often, relative to the direct light's mean over the panels


def _received(panel: Panel, lights: list[Panel], rows: int, columns: int) -> np.ndarray:
    """Direct irradiance / pi [rows, columns, 3] from the glowing panels; furniture casts no shadow."""
    points = panel.grid(rows, columns)
    total = np.zeros((rows, columns, 3))
    for light in lights:
        samples = 5
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
        markers: those that hang in it.
    """

    vertices: np.ndarray
    normals: np.ndarray
    texels: np.ndarray
    triangles: np.ndarray
    radiance: np.ndarray
    albedo: np.ndarray
    markers: tuple[Marker, ...] = ()

    @classmethod
    def build(cls, seed: int, level: float, decor: DecorConfig | None = None) -> Room:
        """A furnished room; at the origin a white surface that faces its front has the radiance `level`."""
        decor = decor or DecorConfig()
        panels = bare_room() if decor.plain else furnish(seed)
        markers: list[Marker] = []
        if decor.markers != "none":
            papers, markers = PLACES[decor.markers](decor.marker_side_m)
            panels += papers
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
        directions, solid = latlong_directions(PANORAMA_ROWS, 2 * PANORAMA_ROWS)
        facing = np.maximum(directions[..., 2], 0.0) * solid
        seen = (room.panorama(PANORAMA_ROWS) * facing[..., None]).sum((0, 1)).mean() / np.pi
        return cls(
            room.vertices,
            room.normals,
            room.texels,
            room.triangles,
            (room.radiance * np.float32(level / seen)),
            room.albedo,
            tuple(markers),
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
    """Places (row, column) of rectangles laid in shelves from the tallest, and the atlas's shape."""
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
