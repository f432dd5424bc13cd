"""Tensors that are made when first asked for, and kept while there is room for them."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable

import torch


class KeptTensors:
    """By number; when the room is full, those not used for longest are given up and made again."""

    def __init__(self, make: Callable[[int], torch.Tensor], room_bytes: int) -> None:
        """Nothing is made yet; one tensor is kept whatever its size."""
        self._make = make
        self._room_bytes = room_bytes
        self._kept: OrderedDict[int, torch.Tensor] = OrderedDict()

    def __getitem__(self, number: int) -> torch.Tensor:
        if number in self._kept:
            self._kept.move_to_end(number)
            return self._kept[number]
        made = self._make(number)
        self._kept[number] = made
        while len(self._kept) > 1 and sum(kept.nbytes for kept in self._kept.values()) > self._room_bytes:
            self._kept.popitem(last=False)
        return made
