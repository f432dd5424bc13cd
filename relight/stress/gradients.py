"""Every differentiable operator of ours against central differences, in float64 (torch's gradcheck).

Inputs stay a little off what is not smooth: the horizon of a cosine, the border of a pixel, a threshold. What
happens there is the business of the other cases, which ask for finite gradients.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from relight.environment import DiffuseIrradiance
from relight.lighting import (
    DirectionalLight,
    Light,
    PointLight,
    SphericalHarmonicsLight,
    shade,
)
from relight.maps import pull_push
from relight.observations import sample_bilinear
from relight.panorama import panorama_to_sh
from relight.raster import gather_descriptors, project
from relight.reflectance import Reflectance, gloss_lobe
from relight.spherical_harmonics import (
    irradiance_matrix,
    project_to_sh,
    quadratic_irradiance,
    rotate_sh,
    rotation_about_up,
    sh_basis,
    sh_irradiance,
)
from relight.stress.case import Case, Measured, Stage, gradients_of
from relight.stress.lights import kinds, panorama, points
from relight.stress.subject import looking_at_origin, sphere_points
from relight.surface import cosine, cosine_falloff, direction_to

GRADIENTS = Stage("gradients", (torch.float64,), "central differences need the digits of float64")

_CAMERA = looking_at_origin([0.05, 0.1, 0.5], 16, flash=1)
_SKIN = Reflectance(0.5, 0.25, 0.04)
Operator = Callable[..., Tensor | tuple[Tensor, ...]]
Checked = tuple[Operator, Mapping[str, Tensor]]
"""What is checked, and where."""
Made = Callable[[], Checked]


def cases() -> Iterator[Case]:
    """All cases of this module."""
    for name in kinds():
        yield checked(f"shade, {name}: albedo, normals, shading, points, colours", partial(_shade, name))
    yield checked("shade, glossy point: the same", partial(_shade, "point", _SKIN))
    yield checked("shade, the light's own colour and place", _own_colours)
    for name, operator in _OPERATORS.items():
        yield checked(name, operator)


def checked(stressed: str, made: Made) -> Case:
    """The case of one operator."""
    return Case(GRADIENTS, stressed, partial(_against_differences, made))


def _against_differences(made: Made, dtype: torch.dtype) -> Measured:
    """Raises what gradcheck finds wrong: which input, which output and by how much."""
    operator, inputs = made()
    given = {name: value.detach().double().clone().requires_grad_() for name, value in inputs.items()}
    torch.autograd.gradcheck(operator, tuple(given.values()))
    outputs = operator(*given.values())
    outputs = (outputs,) if isinstance(outputs, Tensor) else outputs
    together = torch.cat([output.flatten() for output in outputs])
    return Measured({"outputs": together}, gradients_of(together, **given))


def _shade(name: str, reflectance: Reflectance | None = None) -> Checked:
    # An even count: the middle of an odd one lies on the fold of the irradiance table.
    maps, light = points(6), kinds()[name]

    fields = ("albedo", "normals_world", "shading", "points_world")

    def radiance(*given: Tensor) -> Tensor:
        changed = replace(maps, **dict(zip(fields, given[:4], strict=True)))
        c_room, c_flash = given[4:]
        return shade(light, changed, camera=_CAMERA, c_room=c_room, c_flash=c_flash, reflectance=reflectance)

    colours = {"c_room": torch.tensor([0.9, 1.0, 1.1]), "c_flash": torch.tensor([0.09, 0.1, 0.11])}
    return radiance, {field: getattr(maps, field) for field in fields} | colours


def _own_colours() -> Checked:
    maps = points(7)

    def radiance(colour: Any, place: Any, coefficients: Tensor) -> Tensor:
        lights: list[Light] = [
            DirectionalLight((0.3, 0.4, 0.8), 0.2, colour),
            PointLight(place, colour),
            SphericalHarmonicsLight(coefficients),
        ]
        return torch.stack([shade(light, maps) for light in lights])

    return radiance, {
        "colour": torch.tensor([0.9, 1.0, 1.1]),
        "place": torch.tensor([0.2, 0.3, 0.4]),
        "coefficients": panorama_to_sh(panorama(), 3),
    }


def _random(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def _directions(count: int = 6, seed: int = 0) -> Tensor:
    return torch.nn.functional.normalize(_random(count, 3, seed=seed) - 0.37, dim=1)


def _near(seed: int) -> Tensor:
    """Directions that look towards +Z, so that light and view are before the surface."""
    return torch.nn.functional.normalize(_random(5, 3, seed=seed) + torch.tensor([-0.5, -0.5, 1.0]), dim=1)


def _response() -> Checked:
    inputs = {"albedo": _random(5, 3), "normals": _near(1), "light": _near(2), "view": _near(3)}
    return _SKIN.response, inputs | {"gloss": 0.5 + _random(5, 1)}


def _lobes() -> Checked:
    def lobes(c: Tensor) -> tuple[Tensor, ...]:
        return _SKIN.diffuse(c), _SKIN.gloss(c), gloss_lobe(c, 0.1)

    return lobes, {"cosine": 0.1 + 0.8 * _random(9)}


def _gathered() -> Checked:
    ids = torch.tensor([[0, 2, -1], [2, 2, 4]])
    return lambda descriptors: gather_descriptors(descriptors, ids), {"descriptors": _random(5, 3)}


def _sampled() -> Checked:
    places = torch.tensor([[1.2, 1.7], [2.9, 2.2], [0.3, 4.6], [3.8, 3.1]])
    return sample_bilinear, {"image": _random(2, 6, 5), "uv_px": places}


def _filled() -> Checked:
    weight = torch.where(_random(1, 7, 6, seed=1) > 0.6, 0.2 + _random(1, 7, 6, seed=2), 0.0)
    holes = weight == 0

    def filled(values: Tensor, more: Tensor) -> Tensor:
        # Where there is no weight there is a corner: one more weight would be the first.
        weights = torch.where(holes, 0.0, weight + more)
        return pull_push(torch.cat([values * weights, weights]), 5.0)

    return filled, {"values": _random(2, 7, 6), "more": 0.1 * _random(1, 7, 6, seed=3)}


def _environment() -> Checked:
    table = DiffuseIrradiance.of_panorama(np.ones((4, 8, 3)) * np.arange(1, 9)[None, :, None])
    smooth = DiffuseIrradiance(table.odd.double(), table.even.double())
    return smooth, {"normals": _directions()}


_OPERATORS: dict[str, Made] = {
    "cosine": lambda: (lambda n: cosine(n, _directions(1)[0]), {"normals": _directions()}),
    "cosine_falloff": lambda: (
        cosine_falloff,
        {"points": 0.1 * _directions(), "normals": _near(1)[:1].expand(6, 3), "position": torch.ones(3)},
    ),
    "direction_to": lambda: (direction_to, {"points": 0.1 * _directions(), "position": torch.ones(3)}),
    "reflectance: response": _response,
    "reflectance: diffuse, gloss, lobe": _lobes,
    "project": lambda: (lambda p: project(p, _CAMERA), {"points": 0.1 * _directions()}),
    "gather_descriptors": _gathered,
    "sample_bilinear": _sampled,
    "pull_push": _filled,
    "irradiance of a panorama": _environment,
    "sh_basis": lambda: (lambda d: sh_basis(d, 5), {"directions": torch.cat([torch.eye(3), _directions()])}),
    "sh_irradiance": lambda: (sh_irradiance, {"coefficients": _random(16, 3), "normals": _directions()}),
    "quadratic_irradiance": lambda: (
        lambda c, n: quadratic_irradiance(irradiance_matrix(c), n),
        {"coefficients": _random(9, 3), "normals": _directions()},
    ),
    "project_to_sh": lambda: (
        lambda r, d: project_to_sh(r, d, torch.full((20,), 0.6, dtype=torch.float64), 3),
        {"radiance": _random(20, 3), "directions": torch.from_numpy(sphere_points(20))},
    ),
    "rotate_sh": lambda: (lambda c: rotate_sh(c, rotation_about_up(40.0)), {"coefficients": _random(9, 3)}),
}
