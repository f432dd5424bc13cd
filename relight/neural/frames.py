"""The frames that a neural fit is compared with, read once and kept in half precision while memory allows.

An 8-bit code is at least a 256th of its value apart from the next wherever it matters; half floats err by a
2048th, and hold twice the frames.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from relight.maps import splat_maps
from relight.neural.crops import Crop
from relight.neural.kept import KeptTensors
from relight.portrait import Portrait
from relight.scene import Scene, View

_ROOM_BYTES = 1 << 30  # for frames; beyond, those not used for longest are read again
_MOST = 6e4  # radiance that half floats hold
_SURE = 0.999  # of a patch's pixel that must be known


@dataclass(frozen=True, eq=False)
class Target:
    """What a patch, or a whole frame, should look like.

    Attributes:
        radiance: [3, H, W] float32, linear; 0 where not valid.
        valid: [1, H, W] float32, 1 where the radiance can be trusted, 0 where it is clipped or not finite.
        inside: [1, H, W] float32, 1 where the frame is, 0 beyond its edge.
        mask: [1, H, W] float32, 0..1 coverage of the subject.
    """

    radiance: torch.Tensor
    valid: torch.Tensor
    inside: torch.Tensor
    mask: torch.Tensor


class FrameStore:
    """The frames of a scene as targets. Frames without a mask take that of the solved portrait."""

    def __init__(self, scene: Scene, solved: Portrait) -> None:
        """A store; nothing is read yet."""
        self._scene = scene
        self._solved = solved
        self._views = {view.index: view for view in scene.views}
        self._layers = KeptTensors(self._read, _ROOM_BYTES)

    def subject(self, view: View) -> torch.Tensor:
        """[H, W] bool, where the frame shows the subject."""
        return self._layers[view.index][4] > 0.5

    def whole(self, view: View) -> Target:
        """The whole frame."""
        layers = self._layers[view.index].float()
        return Target(layers[:3], layers[3:4], torch.ones_like(layers[3:4]), layers[4:5])

    def patch(self, view: View, crop: Crop) -> Target:
        """A patch of the frame."""
        layers = self._layers[view.index]
        radiance, known, mask = crop.of(layers).split([3, 1, 1])
        inside = (crop.of(torch.ones_like(layers[:1])) > _SURE).float()
        valid = (known > _SURE).float() * inside
        return Target(radiance * valid, valid, inside, mask)

    def _read(self, index: int) -> torch.Tensor:
        """[5, H, W] float16: radiance, validity, mask."""
        view = self._views[index]
        seen = self._scene.observe(view)
        mask = splat_maps(self._solved, view.camera).mask if seen.mask is None else seen.mask
        valid = seen.valid * (seen.radiance <= _MOST).all(dim=-1)
        radiance = torch.where(valid[..., None] > 0, seen.radiance, 0.0)
        return torch.cat([radiance.permute(2, 0, 1), valid[None], mask[None]]).half()
