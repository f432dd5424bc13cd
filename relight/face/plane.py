"""A plane of symmetry: x · normal = offset."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Plane:
    """A plane in the world.

    Attributes:
        normal: Unit.
        offset: Distance of the plane from the origin along the normal, world units.
    """

    normal: tuple[float, float, float]
    offset: float

    @classmethod
    def of(cls, normal: Floats, offset: float) -> Plane:
        """The plane x · normal = offset; a normal that is not unit is made so, and the offset with it."""
        length = float(np.linalg.norm(normal))
        if not length > 0:
            raise ValueError("the normal of a plane must not be zero")
        x, y, z = (float(value) / length for value in normal)
        return cls((x, y, z), float(offset) / length)

    @property
    def n(self) -> NDArray[np.float64]:
        """[3] the normal as an array."""
        return np.array(self.normal)

    def distance(self, points: Floats) -> NDArray[np.float64]:
        """Signed distances [...] of points [..., 3], positive on the normal's side."""
        return np.asarray(points @ self.n - self.offset, dtype=np.float64)

    def reflect(self, points: Floats) -> NDArray[np.float64]:
        """Mirror images [..., 3] of points [..., 3]."""
        return np.asarray(points - 2.0 * self.distance(points)[..., None] * self.n, dtype=np.float64)

    def reflect_directions(self, directions: Floats) -> NDArray[np.float64]:
        """Mirror images [..., 3] of directions, such as normals."""
        return np.asarray(directions - 2.0 * (directions @ self.n)[..., None] * self.n, dtype=np.float64)

    def angle_to(self, other: Plane) -> float:
        """Angle between two planes, radians 0..pi/2: which way a normal points does not matter."""
        across = float(np.linalg.norm(np.cross(self.n, other.n)))
        return float(np.arctan2(across, abs(self.n @ other.n)))
