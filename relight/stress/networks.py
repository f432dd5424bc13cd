"""The terms of a neural fit's loss and the rendering network: empty masks, constant pictures, one point.

Maps leave the network as float32 and losses are computed in it, so bf16 is asked only of what a network runs
in it: by autocast, which multiplies in bf16 and adds in float32, with the weights in float32.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import torch
from torch import Tensor

from relight.neural.display import display_values
from relight.neural.gated_unet import GatedUNet
from relight.neural.losses.dice import dice, mask_loss
from relight.neural.losses.face import colour_loss, normal_loss, symmetry_loss
from relight.neural.losses.mismatch import Mismatch, pooled_l1
from relight.neural.losses.total_variation import total_variation
from relight.neural.paper.heads import unit
from relight.neural.perceptual import VggPerceptual, laplacian_perceptual
from relight.neural.raw_images import raw_images
from relight.neural.vgg import Vgg16
from relight.stress.case import Bound, Case, Measured, Stage, epsilons, gradients_of
from relight.stress.gradients import Checked, checked

_MAPS = "maps leave the network as float32, and losses are computed in it"
LOSSES = Stage("losses", (torch.float64, torch.float32), _MAPS)
HEADS = Stage("heads", (torch.float64, torch.float32), _MAPS)
NETWORK = Stage("network")

_LENGTH, _WIDTHS = 8, (16, 24, 32)
_SUMMED = epsilons(64)  # means over a thousand pixels, some of them of squares and logarithms
# Sums of positive and negative numbers next to nothing: what is left of them is rounding.
_CANCELLED: dict[str, Bound | None] = {
    "bands of one pixel": None,
    "bands times 1e-6": epsilons(1024),
    "Delta of equal pictures": None,
}
_LAYERS = epsilons(8)
_SWITCHED = epsilons(1024)  # gates that open at zero are switched by the rounding of what is a million
_DELTA = Mismatch(laplacian_perceptual)
_VIEW = torch.arange(32 * 32).view(32, 32)
_NOWHERE = torch.full((32, 32), -1)


def cases() -> Iterator[Case]:
    """All cases of this module."""
    for stressed, (loss, pictures) in _LOSSES.items():
        bound = _CANCELLED.get(stressed, _SUMMED)
        yield Case(LOSSES, stressed, partial(_compared, loss, pictures), bound)
    for stressed, image in _IMAGES.items():
        varying = partial(_of_one, total_variation, image)
        yield Case(LOSSES, f"total variation of {stressed}", varying, _SUMMED)
    for stressed, vectors in _VECTORS.items():
        yield Case(HEADS, f"unit vectors of {stressed}", partial(_of_one, unit, vectors), epsilons(4))
    displayed = partial(_of_one, display_values, _decades)
    yield Case(HEADS, "display values over 24 decades", displayed, epsilons(4))
    for stressed, (ids, gain) in _VIEWS.items():
        bound = _LAYERS if gain <= 1.0 else _SWITCHED
        yield Case(NETWORK, f"rendering: {stressed}", partial(_rendered, ids, gain, False), bound)
        # A normalisation divides by a spread that may be of rounding alone: no bound.
        yield Case(NETWORK, f"a step of training: {stressed}", partial(_rendered, ids, gain, True))
    for name, operator in _OPERATORS.items():
        yield checked(name, operator)


def _flat(value: float, channels: int = 3) -> Tensor:
    return torch.full((1, channels, 32, 32), value, dtype=torch.float64)


def _noise(seed: int, channels: int = 3) -> Tensor:
    random = torch.Generator().manual_seed(seed)
    return torch.rand(1, channels, 32, 32, generator=random, dtype=torch.float64)


def _tiny(seed: int) -> Tensor:
    return _noise(seed)[:, :, :1, :1]


def _half(seed: int) -> Tensor:
    return torch.cat([_noise(seed)[..., :16], _flat(0.5)[..., 16:]], dim=-1)


def _vgg() -> VggPerceptual:
    torch.manual_seed(0)
    return VggPerceptual(Vgg16(("relu1_2", "relu2_2"))).requires_grad_(False)


def _by_vgg(picture: Tensor, reference: Tensor) -> Tensor:
    with torch.random.fork_rng():
        network = _vgg().to(picture.dtype)
    value: Tensor = network(picture, reference)
    return value


def _symmetry(albedo: Tensor, half: Tensor) -> Tensor:
    """Where nothing of the face is defined."""
    return symmetry_loss(_DELTA, albedo[0], torch.zeros_like(albedo[0, 0]), half[0, :, :, :16])


def _colour(albedo: Tensor, colour: Tensor) -> Tensor:
    """Where no texel is defined."""
    return colour_loss(albedo[0], torch.zeros_like(albedo[0, 0]), colour[0])


def _face_normal(normals: Tensor, known: Tensor) -> Tensor:
    """Of a face that is not in the picture."""
    return normal_loss(_DELTA, normals[0], known[0], torch.zeros_like(normals[0, :1]))


Pair = tuple[Tensor, Tensor]
_Loss = Callable[[Tensor, Tensor], Tensor]

_LOSSES: dict[str, tuple[_Loss, Callable[[], Pair]]] = {
    "Dice of empty masks": (mask_loss, lambda: (_flat(0.0, 1), _flat(0.0, 1))),
    "Dice of full masks": (mask_loss, lambda: (_flat(1.0, 1), _flat(1.0, 1))),
    "Dice of an empty mask, where one should be": (mask_loss, lambda: (_flat(0.0, 1), _flat(1.0, 1))),
    "Dice of a full mask, where none should be": (mask_loss, lambda: (_flat(1.0, 1), _flat(0.0, 1))),
    "Dice of 1e-30": (dice, lambda: (_flat(1e-30, 1), _flat(1e-30, 1))),
    "bands of equal constant pictures": (laplacian_perceptual, lambda: (_flat(0.5), _flat(0.5))),
    "bands of black against white": (laplacian_perceptual, lambda: (_flat(0.0), _flat(1.0))),
    "bands of noise against a constant": (laplacian_perceptual, lambda: (_noise(0), _flat(0.5))),
    "bands of a half constant picture": (laplacian_perceptual, lambda: (_half(0), _half(1))),
    "bands times 1e+6": (laplacian_perceptual, lambda: (1e6 * _noise(0), 1e6 * _noise(1))),
    "bands times 1e-6": (laplacian_perceptual, lambda: (1e-6 * _noise(0), 1e-6 * _noise(1))),
    "bands of one pixel": (laplacian_perceptual, lambda: (_tiny(0), _tiny(1))),
    "VGG of equal constant pictures": (_by_vgg, lambda: (_flat(0.5), _flat(0.5))),
    "VGG of black against white": (_by_vgg, lambda: (_flat(0.0), _flat(1.0))),
    "VGG of noise": (_by_vgg, lambda: (_noise(0), _noise(1))),
    "Delta of noise": (_DELTA, lambda: (_noise(0), _noise(1))),
    "Delta of equal pictures": (_DELTA, lambda: (_noise(0), _noise(0))),
    "pooled L1 times 1e+6": (pooled_l1, lambda: (1e6 * _noise(0), 1e6 * _noise(1))),
    "symmetry where nothing is defined": (_symmetry, lambda: (_noise(0), _noise(1))),
    "colour where nothing is defined": (_colour, lambda: (_noise(0), _noise(1))),
    "normals without a face": (_face_normal, lambda: (_noise(0), _noise(1))),
}

_IMAGES: dict[str, Callable[[], Tensor]] = {
    "a constant": lambda: _flat(0.3),
    "noise": lambda: _noise(0),
    "noise times 1e+6": lambda: 1e6 * _noise(0),
    "one pixel": lambda: _tiny(0),
    "a row": lambda: _noise(0)[:, :, :1],
}

_VECTORS: dict[str, Callable[[], Tensor]] = {
    "zero": lambda: torch.zeros(3, 4, dtype=torch.float64),
    "1e-20": lambda: torch.full((3, 4), 1e-20, dtype=torch.float64),
    "1 to 1e+15": lambda: torch.logspace(0, 15, 12, dtype=torch.float64).view(3, 4),
}

_VIEWS: dict[str, tuple[Tensor, float]] = {
    "usual": (_VIEW, 1.0),
    "no point in the picture": (_NOWHERE, 1.0),
    "one point": (torch.where(_VIEW == 500, 500, -1), 1.0),
    "the same point everywhere": (torch.zeros_like(_VIEW), 1.0),
    "descriptors times 1e-6": (_VIEW, 1e-6),
    "descriptors times 1e+6": (_VIEW, 1e6),
}


def _decades() -> Tensor:
    steps = torch.logspace(-12, 12, 25, dtype=torch.float64)
    return torch.cat([-steps, torch.zeros(1, dtype=torch.float64), steps[steps <= 1e6]])


def _compared(loss: _Loss, pictures: Callable[[], Pair], dtype: torch.dtype) -> Measured:
    picture, reference = pictures()
    given = picture.to(dtype).requires_grad_()
    value = loss(given, reference.to(dtype))
    return Measured({"loss": value}, gradients_of(value, picture=given))


def _of_one(work: Callable[[Tensor], Tensor], image: Callable[[], Tensor], dtype: torch.dtype) -> Measured:
    given = image().to(dtype).requires_grad_()
    values = work(given)
    return Measured({"values": values}, gradients_of(values, given=given))


def _rendered(ids: Tensor, gain: float, training: bool, dtype: torch.dtype) -> Measured:
    """The network's image of a view, and gradients in its descriptors and weights."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = GatedUNet([_LENGTH] * len(_WIDTHS), 8, _WIDTHS)
        descriptors = gain * torch.randn(32 * 32, _LENGTH)
    full = torch.float32 if dtype == torch.bfloat16 else dtype
    network = network.to(full).train(training)
    given = descriptors.to(full).requires_grad_()
    levels = [ids[:: 2**t, :: 2**t] for t in range(len(_WIDTHS))]
    with torch.autocast("cpu", torch.bfloat16, enabled=dtype == torch.bfloat16):
        image = network(raw_images(given, levels))
    weights = dict(network.named_parameters())
    # A mean of squares: the sum of a normalised image has no gradient.
    return Measured({"image": image}, gradients_of((image.float() ** 2).mean(), given=given, **weights))


def _network() -> Checked:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = GatedUNet([2, 2], 3, (4, 6)).double()
    return lambda fine, coarse: network([fine, coarse]), {
        "fine": _noise(0, 2)[..., :4, :4],
        "coarse": _noise(1, 2)[..., :2, :2],
    }


def _looked_up() -> Checked:
    ids = [torch.tensor([[0, 2, -1, 1], [2, 2, 4, -1]]), torch.tensor([[2, -1]])]
    return lambda descriptors: tuple(raw_images(descriptors, ids)), {"descriptors": _noise(0)[0, 0, :5, :3]}


def _small(loss: _Loss, channels: int = 3, size: int = 6) -> Checked:
    """In the picture alone: by what the bands are normalised is held fixed."""
    reference = _noise(1, channels)[..., :size, :size]
    return lambda picture: loss(picture, reference), {"picture": _noise(0, channels)[..., :size, :size]}


_OPERATORS: dict[str, Callable[[], Checked]] = {
    "network": _network,
    "raw_images": _looked_up,
    "mask_loss": partial(_small, mask_loss, 1),
    "laplacian_perceptual": partial(_small, laplacian_perceptual),
    "pooled_l1": partial(_small, pooled_l1, size=8),
    "total_variation": lambda: (total_variation, {"image": _noise(0)[..., :5, :4]}),
    "display_values": lambda: (display_values, {"radiance": _noise(0)[..., :5, :4] - 0.3}),
    "unit": lambda: (unit, {"vectors": _noise(0)[0, :, :3, :3] - 0.5}),
}
