"""Reflectance and its fit: grazing, opposite and missing directions, narrow gloss, nothing observed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import torch
from torch import Tensor

from relight.reflectance import Reflectance, fit_local_gloss, fit_reflectance
from relight.stress.case import Case, Measured, Stage, at_most, epsilons, gradients_of
from relight.stress.subject import sphere_points

REFLECTANCE = Stage("reflectance")
GLOSS = Stage(
    "gloss",
    (torch.float64, torch.float32),
    "a highlight is narrower than the spacing of bf16's cosines next to 1",
)
FIT = Stage("fit of the gloss", (torch.float32,), "frames are float32 by contract; the sums are in float64")

_CLOTH, _SKIN, _OIL = Reflectance(0.75), Reflectance(0.5, 0.25, 0.04), Reflectance(0.0, 0.08, 0.08)


def cases() -> Iterator[Case]:
    """All cases of this module."""
    yield Case(REFLECTANCE, "cosines from -1 to 1", partial(_curve, _CLOTH.diffuse), epsilons(8))
    yield Case(REFLECTANCE, "any directions, and none", partial(_response, _CLOTH), epsilons(8))
    # A lobe of width alpha turns an epsilon of the cosine into epsilon / alpha^2 of itself.
    for name, kind in (("skin", _SKIN), ("oil", _OIL)):
        bound = epsilons(4.0 / kind.alpha**2)
        yield Case(GLOSS, f"{name}: cosines from -1 to 1", partial(_curve, kind.gloss), bound)
        yield Case(GLOSS, f"{name}: any directions, and none", partial(_response, kind), bound)
    yield Case(GLOSS, "a mirror: alpha of 1e-3", partial(_response, Reflectance(0.0, 1e-3, 0.04)))
    for stressed, gain in (("usual", 1.0), ("ten times brighter", 10.0), ("a tenth as bright", 0.1)):
        yield Case(FIT, stressed, partial(_fitted, _SKIN, gain), at_most(0.05))
    for stressed, observed in _NOTHING.items():
        yield Case(FIT, f"{stressed}: taken for matte", partial(_found_matte, observed), at_most(0.0))


def _curve(curve: Callable[[Tensor], Tensor], dtype: torch.dtype) -> Measured:
    cosine = torch.linspace(-1.0, 1.0, 41, dtype=torch.float64).to(dtype).requires_grad_()
    values = curve(cosine)
    return Measured({"values": values}, gradients_of(values, cosine=cosine))


def _response(kind: Reflectance, dtype: torch.dtype) -> Measured:
    """Light and view in line, opposite, grazing, within the surface, behind it; and zero normals."""
    directions = torch.cat([torch.eye(3), -torch.eye(3), torch.from_numpy(sphere_points(10)).float()])
    normals = torch.cat([directions, torch.zeros(1, 3)])
    choices = [torch.arange(len(of)) for of in (normals, directions, directions)]
    normal, light, view = torch.cartesian_prod(*choices).unbind(1)
    given = {
        "albedo": torch.full((len(normal), 3), 0.5),
        "normals": normals[normal],
        "to_light": directions[light],
        "to_view": directions[view],
    }
    inputs = {name: value.to(dtype).requires_grad_() for name, value in given.items()}
    values = kind.response(**inputs)
    return Measured({"response": values}, gradients_of(values, **inputs))


def _observed(kind: Reflectance, gain: float) -> tuple[Tensor, Tensor, Tensor]:
    """Cosines, responses and weights [8, 400] of points of albedo 0.2 to 0.7."""
    random = torch.Generator().manual_seed(0)
    cosine = 0.25 + 0.75 * torch.rand(8, 400, generator=random)
    albedo = torch.linspace(0.2, 0.7, 400)
    response = gain * (albedo * kind.diffuse(cosine) + kind.gloss(cosine))
    return cosine, response, torch.ones_like(cosine)


def _fitted(kind: Reflectance, gain: float, dtype: torch.dtype) -> Measured:
    """The error is that of f0, which is in the units of the response; the widths come from a grid."""
    cosine, response, weight = _observed(kind, gain)
    found = fit_reflectance(cosine, response, weight)
    along, square = fit_local_gloss(cosine, response, weight, found)
    numbers = torch.tensor([found.retro, found.alpha, found.f0])
    error = abs(found.f0 / (gain * kind.f0) - 1.0)
    return Measured({"numbers": numbers, "along": along, "square": square}, error=error)


def _found_matte(observed: Callable[[], tuple[Tensor, Tensor, Tensor]], dtype: torch.dtype) -> Measured:
    found = fit_reflectance(*observed())
    return Measured({"numbers": torch.tensor([found.retro, found.alpha, found.f0])}, error=abs(found.f0))


def _unseen() -> tuple[Tensor, Tensor, Tensor]:
    cosine, response, weight = _observed(_SKIN, 1.0)
    return cosine, response, 0.0 * weight


def _turned_away() -> tuple[Tensor, Tensor, Tensor]:
    cosine, response, weight = _observed(_SKIN, 1.0)
    return -cosine, response, weight


def _in_two_frames() -> tuple[Tensor, Tensor, Tensor]:
    cosine, response, weight = _observed(_SKIN, 1.0)
    return cosine[:2], response[:2], weight[:2]


def _black() -> tuple[Tensor, Tensor, Tensor]:
    return _observed(_SKIN, 0.0)


_NOTHING: dict[str, Callable[[], tuple[Tensor, Tensor, Tensor]]] = {
    "no observation": _unseen,
    "turned away from every light": _turned_away,
    "two frames": _in_two_frames,
    "black": _black,
}
