"""The light of a small flash on a surface nearby, and how it changes with every number in it.

A flash at p with axis a (unit) lights a white Lambertian surface at x with unit normal n, v = x - p, d = |v|
(camera axes, metres; Quéau et al. 2018, eq. 2.9):

    radiance = rho C cos(theta) cos(phi)^mu / d^2,   cos(theta) = -n.v / d,   cos(phi) = a.v / d

so that C is the radiance of white at 1 m on the axis. `Light` has the eight numbers that are sought: position
(3), slopes of the axis s, t with a ~ (s, t, 1), mu, log C, and the droop: how log C changes over the capture,
whose time runs from -1/2 to 1/2. All light is a product, so everything here is logarithms.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

#: Order of the numbers in a vector of a light, and in its covariance.
LIGHT_NAMES = ("x_m", "y_m", "z_m", "axis_x", "axis_y", "falloff", "log_strength", "droop")
LIGHT_SIZE = len(LIGHT_NAMES)
POSITION, AXIS, FALLOFF, LOG_STRENGTH, DROOP = slice(0, 3), slice(3, 5), 5, 6, 7
# Cosines below this are put there: the light's back, and surfaces turned away, send no light, and a logarithm
# needs some. No measurement comes near it.
_LEAST_COSINE = 1e-4


@dataclass(frozen=True, eq=False)
class Light:
    """A flash.

    Attributes:
        vector: [8] in the order of `LIGHT_NAMES`.
    """

    vector: Floats = field(default_factory=lambda: np.array([0, 0, 0, 0, 0, 1.0, 0, 0]))

    @property
    def position_m(self) -> Floats:
        """[3] in camera axes."""
        return self.vector[POSITION]

    @property
    def axis(self) -> Floats:
        """[3] unit, camera axes."""
        direction = np.array([*self.vector[AXIS], 1.0])
        unit: Floats = direction / np.linalg.norm(direction)
        return unit

    @property
    def axis_slopes(self) -> Floats:
        """[3, 2] how the axis changes with s and t."""
        direction = np.array([*self.vector[AXIS], 1.0])
        length = np.linalg.norm(direction)
        slopes: Floats = (np.eye(3) - np.outer(direction, direction) / length**2)[:, :2] / length
        return slopes


def log_light(light: Light, points_cam: Floats, normals_cam: Floats, time: Floats) -> Floats:
    """[...] logarithm of the radiance of a white surface.

    Args:
        light: the flash.
        points_cam: [..., 3] of the surface, metres.
        normals_cam: [..., 3] unit, towards the camera.
        time: [...] within the capture, -1/2..1/2.
    """
    return log_light_with_slopes(light, points_cam, normals_cam, time)[0]


def log_light_with_slopes(
    light: Light, points_cam: Floats, normals_cam: Floats, time: Floats
) -> tuple[Floats, Floats, Floats, Floats]:
    """As `log_light`, and its derivatives.

    Returns:
        [...]; by the light [..., 8], by the point [..., 3], and by the normal [..., 3].
    """
    s, t = light.vector[AXIS]
    falloff = light.vector[FALLOFF]
    v = points_cam - light.position_m
    d2 = (v * v).sum(-1)
    d = np.sqrt(d2)
    facing = np.maximum(-(normals_cam * v).sum(-1), _LEAST_COSINE * d)
    direction = np.array([s, t, 1.0])
    length2 = float(direction @ direction)
    ahead = np.maximum(v @ direction, _LEAST_COSINE * d * np.sqrt(length2))
    log_cos_phi = np.log(ahead) - 0.5 * np.log(length2 * d2)
    value = (
        np.log(facing)
        - 1.5 * np.log(d2)
        + falloff * log_cos_phi
        + light.vector[LOG_STRENGTH]
        + light.vector[DROOP] * time
    )
    by_normal = -v / facing[..., None]
    by_point = (
        -normals_cam / facing[..., None]
        - (3.0 + falloff) * v / d2[..., None]
        + falloff * direction / ahead[..., None]
    )
    by_light = np.empty((*value.shape, LIGHT_SIZE))
    by_light[..., POSITION] = -by_point
    by_light[..., 3] = falloff * (v[..., 0] / ahead - s / length2)
    by_light[..., 4] = falloff * (v[..., 1] / ahead - t / length2)
    by_light[..., FALLOFF] = log_cos_phi
    by_light[..., LOG_STRENGTH] = 1.0
    by_light[..., DROOP] = time
    return value, by_light, by_point, by_normal
