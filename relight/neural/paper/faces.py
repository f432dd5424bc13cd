"""What the face prior says of a patch: where its texels are, and normals of the face, drawn once a frame."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from relight.face.prior import FacePrior
from relight.face.textures import PositionMap
from relight.neural.crops import Crop
from relight.neural.kept import KeptTensors
from relight.scene import View

_ROOM_BYTES = 1 << 28
_BYTE = 127.0  # a component of a normal is kept as a signed byte: to a quarter of a degree


@dataclass(frozen=True, eq=False)
class FacePatch:
    """What is known of the face in a patch.

    Attributes:
        position_map: Where the texels of the face are in it.
        normals_world: [3, H, W] N_i, unit where the mask is 1, else 0.
        mask: [1, H, W] M_face, 0 or 1.
    """

    position_map: PositionMap
    normals_world: torch.Tensor
    mask: torch.Tensor


class FacePatches:
    """Patches of the frames that show the face."""

    def __init__(self, face: FacePrior) -> None:
        """Of a prior; the normals of a frame are drawn when it is first asked for."""
        self._face = face
        self._normals = KeptTensors(self._drawn, _ROOM_BYTES)

    def of(self, view: View, crop: Crop) -> FacePatch | None:
        """A patch of a frame; None where the frame has no position map."""
        if view.index not in self._face.cameras:
            return None
        camera = crop.camera(self._face.cameras[view.index])
        normals, mask = crop.of(self._normals[view.index]).split([3, 1])
        mask = (mask > 0.5 * _BYTE).float()
        return FacePatch(
            self._face.position_map(view.index, camera),
            torch.nn.functional.normalize(normals, dim=0) * mask,
            mask,
        )

    def _drawn(self, index: int) -> torch.Tensor:
        """[4, H, W] int8: normals and mask of a frame, times 127."""
        drawn = self._face.face_normals(index)
        layers = torch.cat([drawn.normals_world.permute(2, 0, 1), drawn.mask[None]])
        return (_BYTE * layers).round().to(torch.int8)
