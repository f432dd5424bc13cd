"""Triangles to pixels: a thin layer over OpenCV's software rasteriser, in the rig's own conventions.

World coordinates in metres, OpenCV camera axes, pixel (0, 0) covers [0, 1) x [0, 1): attributes and depth
are those of the pixel's centre, interpolated with perspective. This is not the rasteriser that the fit uses.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from capture.cameras import Camera

NEAR_M = 0.02
FAR_M = 20.0


def project(camera: Camera, points_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixel coordinates [P, 2] and depth [P] of world points [P, 3]; behind the camera: depth <= 0."""
    matrix = (camera.K @ camera.cam_from_world[:3]).astype(np.float32)
    projected = points_world @ matrix[:, :3].T + matrix[:, 3]
    depth = projected[:, 2]
    return projected[:, :2] / np.where(np.abs(depth) > 1e-9, depth, 1e-9)[:, None], depth


def rays_world(camera: Camera) -> np.ndarray:
    """[H, W, 3] float32 direction through each pixel's centre, scaled to depth 1 along the optical axis."""
    u = (np.arange(camera.width) + 0.5 - camera.K[0, 2]) / camera.K[0, 0]
    v = (np.arange(camera.height) + 0.5 - camera.K[1, 2]) / camera.K[1, 1]
    across, down = np.meshgrid(u, v)
    rays = np.stack([across, down, np.ones_like(across)], axis=-1)
    return (rays @ camera.cam_from_world[:3, :3]).astype(np.float32)


def _opengl_camera(camera: Camera) -> tuple[np.ndarray, float]:
    """Affine map [4, 4] into OpenCV's OpenGL-like camera (centred, one focal length), and its fovy."""
    focal = camera.K[1, 1]
    shear = np.array(
        [
            [camera.K[0, 0] / focal, 0.0, (camera.K[0, 2] - camera.width / 2) / focal],
            [0.0, 1.0, (camera.K[1, 2] - camera.height / 2) / focal],
            [0.0, 0.0, 1.0],
        ]
    )
    matrix = np.eye(4)
    matrix[:3] = np.diag([1.0, -1.0, -1.0]) @ shear @ camera.cam_from_world[:3]
    return matrix.astype(np.float32), float(2.0 * np.arctan(camera.height / 2 / focal))


@dataclass(eq=False)
class Raster:
    """Pictures under construction: draw several meshes one after the other, the nearest stays.

    Attributes:
        camera: where from.
        values: [H, W, 3] float32, `background` where nothing was drawn.
        depth: [H, W] float32 along the optical axis, metres; `FAR_M` where nothing was drawn.
    """

    camera: Camera
    values: np.ndarray
    depth: np.ndarray

    @classmethod
    def empty(cls, camera: Camera) -> Raster:
        """An empty picture."""
        shape = (camera.height, camera.width)
        return cls(camera, np.zeros((*shape, 3), np.float32), np.full(shape, FAR_M, np.float32))

    @property
    def covered(self) -> np.ndarray:
        """[H, W] bool: something was drawn."""
        return self.depth < FAR_M

    def draw(self, vertices: np.ndarray, triangles: np.ndarray, attributes: np.ndarray | None) -> None:
        """Draw triangles, in front of or behind what is there.

        Args:
            vertices: [V, 3] float32, world.
            triangles: [T, 3] int32, counter-clockwise seen from outside (their backs are not drawn); any
                that crosses the camera's plane must have been left out.
            attributes: [V, 3] float32 interpolated over the triangles; None draws depth alone.
        """
        matrix, fov_y = _opengl_camera(self.camera)
        settings = cv2.TriangleRasterizeSettings()
        settings.setShadingType(cv2.RASTERIZE_SHADING_SHADED)
        settings.setCullingMode(cv2.RASTERIZE_CULLING_CW)
        if attributes is None:
            self.depth = cv2.triangleRasterizeDepth(
                vertices, triangles, self.depth, matrix, fov_y, NEAR_M, FAR_M, settings
            )
            return
        self.values, self.depth = cv2.triangleRasterize(
            vertices, triangles, attributes, self.values, self.depth, matrix, fov_y, NEAR_M, FAR_M, settings
        )
