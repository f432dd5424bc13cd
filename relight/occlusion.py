"""Which points of a surface a camera sees, told from a z-buffer of cells a few points wide.

A point is hidden if something lies nearer in its cell, or in one of the cells about it. So no hole between
points lets light through from behind; and the tolerance grows with the slant of the surface across these
cells, so that a slanted surface does not hide itself.
"""

from __future__ import annotations

import torch

from capture.cameras import Camera
from relight.raster import NEAR_M, project

_SLANT = 2.0  # cells between a point and the nearest one of its 3x3 cells


class Sight:
    """A camera's sight of P points.

    Attributes:
        uv_px: [P, 2], where they project; without meaning behind the camera.
        z: [P], depth.
        inside: [P] bool, whether they project into the picture.
        cosine: [P], between the normal and the direction to the camera; 0 outside the picture.
    """

    def __init__(
        self,
        points: torch.Tensor,
        normals: torch.Tensor,
        camera: Camera,
        spacing: float,
        cell: float = 4.8,
        tolerance: float = 7.5,
    ) -> None:
        """Looks at all points once.

        Args:
            points: [P, 3], world.
            normals: [P, 3], unit, world.
            camera: Without distortion.
            spacing: Of the points, world units.
            cell: Width of a z-buffer cell in spacings, and at least two pixels. With 4.8 some twenty points
                fall into a cell and none is empty; smaller ones resolve finer occluders.
            tolerance: Depth in spacings that does not hide: the noise of a dense cloud stays within 7.5.
        """
        self.uv_px, self.z = project(points, camera)
        u, v = self.uv_px.unbind(1)
        self.inside = (self.z > NEAR_M) & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
        self.cosine = torch.zeros_like(self.z)
        if not self.inside.any():
            return
        focal_px = float(camera.K[0, 0])
        cell_px = max(2.0, cell * spacing * focal_px / float(self.z[self.inside].median()))
        self._tolerance, self._slant = tolerance * spacing, _SLANT * cell_px / focal_px
        self._size = int(camera.height / cell_px) + 1, int(camera.width / cell_px) + 1
        rows, columns = self._size
        # Outside the picture, behind the camera and for NaN any cell will do: the depth there counts as inf.
        u, v = ((value / cell_px).where(self.inside, 0.0).long() for value in (u, v))
        self._place = v.mul_(columns).add_(u)
        self._nearest = self.z.new_full((rows * columns,), torch.inf)
        depth = self.z.where(self.inside, torch.inf)
        self._nearest.scatter_reduce_(0, self._place, depth, "amin")
        towards = torch.as_tensor(camera.centre_world).to(points) - points
        length = (towards * towards).sum(dim=1).sqrt()
        cosine = (normals * towards).sum(dim=1) / length.clamp(min=1e-12)
        self.cosine = torch.where(self.inside, cosine, 0.0)

    def unhidden(self, ids: torch.Tensor, margin: bool = True) -> torch.Tensor:
        """Whether nothing lies before some of the points, [len(ids)] bool; they must be inside the picture.

        Args:
            ids: Of the points.
            margin: Whether what is nearer in a neighbouring cell hides a point too. Without, nothing near an
                outline is hidden wrongly, but what lies behind may show between the nearer surface's points.
        """
        if not len(ids):
            return torch.zeros_like(ids, dtype=torch.bool)
        nearest = self._nearest
        if margin:
            nearest = -torch.nn.functional.max_pool2d(-nearest.view(1, 1, *self._size), 3, 1, 1).flatten()
        cosine, z = self.cosine[ids], self.z[ids]
        slope = (1.0 - cosine**2).clamp(min=0.0).sqrt() / cosine.clamp(min=0.15)
        return z <= nearest[self._place[ids]] + self._tolerance + self._slant * z * slope
