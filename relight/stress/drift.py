"""How far results move between one thread and two, and between the processor and a card.

Sums of floating point numbers depend on their order, and threads and cards add in another one. What does not
add (which point a pixel shows) may not move at all; what adds a few numbers may move by some epsilons; a
solve, which decides and iterates, by what its stage says.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial

import torch
from torch import Tensor

from relight.cloud import CloudConfig
from relight.lighting import Light, PointLight, shade
from relight.maps import pull_push, render_maps
from relight.photometric import SolveConfig, solve
from relight.raster import gather_descriptors, rasterize_ids
from relight.shadows import ShadowCaster
from relight.stress.captures import film
from relight.stress.case import Bound, Case, Measured, NotRunError, Stage, at_most, epsilons, worst_error
from relight.stress.lights import Points, kinds, points
from relight.stress.subject import looking_at_origin, portrait

THREADS = Stage("1 and 2 threads", (torch.float32,), "the precision that everything is fitted and drawn in")
DEVICES = Stage(
    "processor and card", (torch.float32,), "the precision that everything is fitted and drawn in"
)

_CAMERA = looking_at_origin([0.05, 0.1, 0.5], 128, flash=1)
Work = Callable[[torch.device], Mapping[str, Tensor]]


def cases() -> Iterator[Case]:
    """All cases of this module."""
    for name, (work, bound) in _WORK.items():
        yield Case(THREADS, name, partial(_over_threads, work), bound)
    for name, (work, bound) in _WORK.items():
        yield Case(DEVICES, name, partial(_over_devices, work), bound)


def _over_threads(work: Work, dtype: torch.dtype) -> Measured:
    cpu = torch.device("cpu")
    with _threads(1):
        one = work(cpu)
    with _threads(2):
        two = work(cpu)
    return Measured(two, error=worst_error(two, one))


def _over_devices(work: Work, dtype: torch.dtype) -> Measured:
    if not torch.cuda.is_available():
        raise NotRunError("no card: torch sees no CUDA device")
    here, there = work(torch.device("cpu")), work(torch.device("cuda"))
    brought = {name: value.cpu() for name, value in there.items()}
    return Measured(brought, error=worst_error(brought, here))


@contextmanager
def _threads(count: int) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _rasterized(device: torch.device) -> Mapping[str, Tensor]:
    pyramid = rasterize_ids(portrait(200_000).points.to(device), _CAMERA, 4)
    return {f"ids {level}": ids.double() for level, ids in enumerate(pyramid.ids)}


def _gathered(device: torch.device) -> Mapping[str, Tensor]:
    made = portrait(200_000).to(device)
    descriptors = made.albedo.clone().requires_grad_()
    image = gather_descriptors(descriptors, rasterize_ids(made.points, _CAMERA).ids[0])
    (gradient,) = torch.autograd.grad((image**2).sum(), descriptors)
    return {"image": image.detach(), "gradient": gradient}


def _mapped(device: torch.device) -> Mapping[str, Tensor]:
    maps = render_maps(portrait(100_000).to(device), _CAMERA)
    return {name: getattr(maps, name) for name in ("albedo", "normals_world", "shading", "mask", "depth")}


def _filled(device: torch.device) -> Mapping[str, Tensor]:
    random = torch.Generator().manual_seed(0)
    weight = torch.rand(1, 256, 256, generator=random).clamp(min=0.9) - 0.9
    values = torch.rand(8, 256, 256, generator=random)
    return {"image": pull_push(torch.cat([values * weight, weight]).to(device), 0.05)}


def _shaded(device: torch.device) -> Mapping[str, Tensor]:
    maps = points(50_000).to(torch.float32)
    there = Points(**{name: value.to(device) for name, value in vars(maps).items()})
    capture = {"camera": _CAMERA, "c_room": (0.9, 1.0, 1.1), "c_flash": (0.1, 0.1, 0.1)}
    return {name: shade(light, there, **capture) for name, light in kinds().items()}  # type: ignore[arg-type]


def _shadowed(device: torch.device) -> Mapping[str, Tensor]:
    made = portrait(100_000).to(device)
    maps = render_maps(made, _CAMERA)
    visibility = ShadowCaster(made).of_view(maps)
    lights: dict[str, Light] = {"point": PointLight((0.2, 0.3, 0.8)), "environment": kinds()["environment"]}
    return {name: shade(light, maps, visibility=visibility) for name, light in lights.items()}


def _solved(device: torch.device) -> Mapping[str, Tensor]:
    scene = film()
    scene.device = device
    found = solve(scene, SolveConfig(cloud=CloudConfig(max_points=1000)))
    return {"albedo": found.albedo, "normals": found.normals_world, "room": found.room_radiance}


_WORK: dict[str, tuple[Work, Bound]] = {
    "rasterised ids": (_rasterized, at_most(0.0)),
    "gathered descriptors, and their gradients": (_gathered, epsilons(4)),
    "maps": (_mapped, epsilons(64)),
    "pull-push": (_filled, epsilons(8)),
    "every light": (_shaded, epsilons(8)),
    "shadows": (_shadowed, at_most(1e-3)),
    "solve": (_solved, at_most(1e-3)),
}
