"""Panoramas and spherical harmonics: black, constant, over 12 decades, at the poles, broken files."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path

import numpy as np
import torch

from capture.images import write_exr
from relight.environment import DiffuseIrradiance, cluster_lights
from relight.errors import LightError
from relight.panorama import lat_long_directions, lat_long_solid_angles, panorama_to_sh, read_panorama
from relight.spherical_harmonics import (
    irradiance_matrix,
    quadratic_irradiance,
    rotate_sh,
    rotation_about_up,
    sh_basis,
    sh_irradiance,
)
from relight.stress.case import Case, Measured, Stage, epsilons, gradients_of
from relight.stress.lights import panorama
from relight.stress.subject import Floats, sphere_points

ENVIRONMENT = Stage("environment")
HARMONICS = Stage("harmonics")

_TABLE_ERROR = 0.01  # of the irradiance table against the integral, as `DiffuseIrradiance` says
_SOLVED = (torch.float64, torch.float32)  # a least squares problem, which torch has in no other precision


def cases() -> Iterator[Case]:
    """All cases of this module."""
    yield from _environments()
    yield from _harmonics()


def _environments() -> Iterator[Case]:
    for stressed, radiance in _PANORAMAS.items():
        irradiance = partial(_irradiance, cache(partial(_table, radiance)), radiance)
        yield Case(ENVIRONMENT, f"irradiance of {stressed}", irradiance, _table_error)
    yield Case(ENVIRONMENT, "zero, poles and edges of the table: gradients", _at_poles, epsilons(4))
    one = (torch.float64,)
    black = np.zeros((8, 16, 3))
    yield Case(ENVIRONMENT, "lights of black", partial(_clustered, black), dtypes=one)
    yield Case(ENVIRONMENT, "lights of 1e-30 to 1e30", partial(_clustered, _steep()), dtypes=one)
    yield Case(ENVIRONMENT, "file with NaN", partial(_read, np.nan), refused=LightError, dtypes=one)
    yield Case(ENVIRONMENT, "file with Inf and -Inf", partial(_read, np.inf), dtypes=one)


_PANORAMAS: dict[str, Callable[[], Floats]] = {
    "a room with a sun": panorama,
    "black": lambda: np.zeros((8, 16, 3)),
    "1": lambda: np.ones((8, 16, 3)),
    "a single cell": lambda: np.ones((1, 1, 3)),
    "a room times 1e-30": lambda: 1e-30 * panorama(),
    "a room times 1e+30": lambda: 1e30 * panorama(),
}


def _table(radiance: Callable[[], Floats]) -> DiffuseIrradiance:
    return DiffuseIrradiance.of_panorama(radiance())


def _table_error(dtype: torch.dtype) -> float:
    return _TABLE_ERROR + epsilons(4)(dtype)


def _harmonics() -> Iterator[Case]:
    yield Case(HARMONICS, "basis of 6 bands at poles and axes", _basis, epsilons(4))
    yield Case(HARMONICS, "irradiance over 12 decades", _decades, epsilons(4))
    yield Case(HARMONICS, "constant light is pi everywhere", _constant, epsilons(8))
    yield Case(HARMONICS, "turned about and back", _turned, epsilons(16), dtypes=_SOLVED)
    yield Case(HARMONICS, "zero normals", _zero_normals, epsilons(4))


def _irradiance(
    table: Callable[[], DiffuseIrradiance], panorama_of: Callable[[], Floats], dtype: torch.dtype
) -> Measured:
    """Against the plain sum over a panorama's cells, each split into 256."""
    normals = torch.from_numpy(sphere_points(50))
    found = table()(normals.to(dtype))
    fine = np.repeat(np.repeat(panorama_of(), 16, axis=0), 16, axis=1)
    height, width = fine.shape[:2]
    directions = lat_long_directions(height, width).reshape(-1, 3)
    weights = np.repeat(lat_long_solid_angles(height, width), width)[:, None] * fine.reshape(-1, 3)
    truth = (normals.numpy() @ directions.T).clip(min=0.0) @ weights
    largest = np.abs(truth).max()
    error = np.abs(found.double().numpy() - truth).max() / (largest if largest > 0 else 1.0)
    return Measured({"irradiance": found}, error=float(error))


def _at_poles(dtype: torch.dtype) -> Measured:
    rows = [
        [0, 0, 0],
        [0, 0, 1],
        [0, 0, -1],
        [1, 0, 0],
        [0, -1, 0],
        [0.6, 0.8, 0],
        [1e-20, 0, 1],
        [0, 1, -1e-20],
    ]
    normals = torch.tensor(rows, dtype=dtype, requires_grad=True)
    irradiance = _room()(normals)
    (gradient,) = torch.autograd.grad(irradiance.sum(), normals)
    return Measured({"irradiance": irradiance}, {"normals": gradient})


@cache
def _room() -> DiffuseIrradiance:
    return _table(panorama)


def _clustered(radiance: Floats, dtype: torch.dtype) -> Measured:
    directions, irradiances = cluster_lights(radiance, 64)
    return Measured({"directions": directions, "irradiances": irradiances})


def _steep() -> Floats:
    return np.logspace(-30, 30, 8 * 16 * 3).reshape(8, 16, 3)


def _read(value: float, dtype: torch.dtype) -> Measured:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "room.exr"
        radiance = np.ones((8, 16, 3), np.float32)
        radiance[2, 3], radiance[4, 5] = value, -value
        write_exr(path, radiance)
        return Measured({"radiance": torch.from_numpy(read_panorama(path))})


def _poles(dtype: torch.dtype) -> torch.Tensor:
    axes = torch.cat([torch.eye(3), -torch.eye(3), torch.from_numpy(sphere_points(20))]).to(dtype)
    return axes.requires_grad_()


def _basis(dtype: torch.dtype) -> Measured:
    directions = _poles(dtype)
    basis = sh_basis(directions, 6)
    return Measured({"basis": basis}, gradients_of(basis, directions=directions))


def _decades(dtype: torch.dtype) -> Measured:
    normals, coefficients = _poles(dtype), panorama_to_sh(panorama())
    values, gradients = {}, {}
    for exponent in (-6, -3, 0, 3, 6):
        scaled = (coefficients * 10.0**exponent).to(dtype)
        for name, found in (
            ("quadratic", quadratic_irradiance(irradiance_matrix(scaled), normals)),
            ("basis", sh_irradiance(scaled, normals)),
        ):
            values[f"{name} 1e{exponent:+d}"] = found
            gradients[f"{name} 1e{exponent:+d}"] = gradients_of(found, normals=normals)["normals"]
    return Measured(values, gradients)


def _constant(dtype: torch.dtype) -> Measured:
    coefficients = torch.zeros(9, 3, dtype=dtype)
    coefficients[0] = 2.0 * math.sqrt(math.pi)
    found = sh_irradiance(coefficients, _poles(dtype)).detach()
    return Measured({"irradiance": found}, error=float((found.double() / math.pi - 1.0).abs().max()))


def _turned(dtype: torch.dtype) -> Measured:
    coefficients = panorama_to_sh(panorama()).to(dtype)
    rotation = rotation_about_up(123.0).to(dtype)
    back = rotate_sh(rotate_sh(coefficients, rotation), rotation.T)
    error = (back - coefficients).abs().max() / coefficients.abs().max()
    return Measured({"coefficients": back}, error=float(error))


def _zero_normals(dtype: torch.dtype) -> Measured:
    normals = torch.zeros(4, 3, dtype=dtype, requires_grad=True)
    found = sh_irradiance(panorama_to_sh(panorama()).to(dtype), normals)
    return Measured({"irradiance": found}, gradients_of(found, normals=normals))
