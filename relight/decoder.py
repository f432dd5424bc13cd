"""What makes the maps of a view where a portrait is more than its points' values: a network of its own.

A portrait without a decoder is splatted (`relight.maps.splat_maps`). One with a decoder is saved with it: its
kind and settings lie in portrait.json, its tensors in portrait.safetensors under `decoder.`. The module of a
kind is imported when it is first needed.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from importlib import import_module
from typing import TYPE_CHECKING, Any, ClassVar

from torch import Tensor, device

from capture.cameras import Camera
from relight.alignment import Similarity
from relight.errors import PortraitError

if TYPE_CHECKING:
    from relight.maps import Maps
    from relight.portrait import Portrait

KINDS: dict[str, str] = {
    "paper": "relight.neural.paper.decoder:PaperDecoder",
    "refined": "relight.neural.refined.decoder:RefinedDecoder",
}
"""Module and class by the kind that a portrait.json names."""


class Decoder(ABC):
    """What makes the maps of a view from a portrait's points beyond splatting their values.

    Attributes:
        kind: Its name in `KINDS`.
    """

    kind: ClassVar[str]

    @abstractmethod
    def decode(self, portrait: Portrait, camera: Camera) -> Maps:
        """Maps of the portrait that this decoder belongs to; lens distortion is not drawn."""

    @abstractmethod
    def settings(self) -> dict[str, Any]:
        """Safe for JSON; with `tensors` all that is needed to make the decoder again."""

    @abstractmethod
    def tensors(self) -> dict[str, Tensor]:
        """By name, finite."""

    @classmethod
    @abstractmethod
    def restored(cls, settings: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> Decoder:
        """The decoder that gave these settings and tensors.

        Raises:
            ValueError: They are not those of such a decoder.
            KeyError: One is missing.
        """

    @abstractmethod
    def to(self, device: device | str) -> Decoder:
        """The decoder with its tensors on a device."""

    @abstractmethod
    def subset(self, keep: Tensor) -> Decoder:
        """The decoder of some of the points: [P] bool, or their indices."""

    @abstractmethod
    def transformed(self, similarity: Similarity) -> Decoder:
        """The decoder of the same portrait in another world.

        Raises:
            PortraitError: What it gives cannot be taken there.
        """


def restored_decoder(kind: Any, settings: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> Decoder:
    """The decoder of a kind from its settings and tensors.

    Raises:
        PortraitError: There is no such kind.
        ValueError: Settings or tensors are not those of such a decoder.
        KeyError: One is missing.
    """
    if not isinstance(kind, str) or kind not in KINDS:
        raise PortraitError(
            f"The decoder {kind!r} is none of those known ({', '.join(KINDS)}); update the program."
        )
    module, _, name = KINDS[kind].partition(":")
    decoder: Decoder = getattr(import_module(module), name).restored(settings, tensors)
    return decoder
