"""Maps of a view by the paper's network; what it does not give (depth, confidence) comes from the splats.

The network works on the box that holds the points and a margin about it: beyond there is nothing to render.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch

from capture.cameras import Camera
from relight.alignment import Similarity
from relight.decoder import Decoder
from relight.maps import Maps, pull_push, splat_maps, unproject
from relight.neural.gated_unet import GatedUNet
from relight.neural.paper.config import DESCRIPTOR_LENGTH
from relight.neural.paper.heads import NeuralMaps
from relight.neural.paper.lighting import flash_distance, flash_image, room_image, towards_camera
from relight.neural.paper.model import LEVELS, rendered_maps, rendering_network
from relight.neural.precision import PRECISIONS
from relight.portrait import Portrait
from relight.raster import NEAR_M, project, rasterize_ids

_MARGIN_PX = 32  # about the points: hair reaches beyond them
_STEP_PX = 2 ** (LEVELS - 1)
_LEAST_MASK = 1.0 / 255.0  # below it a pixel is not the subject's
_NETWORK = "network."


@dataclass(frozen=True, eq=False)
class PaperDecoder(Decoder):
    """Network and descriptors of one portrait.

    Attributes:
        network: Not learning any more.
        descriptors: [P, 8] float32, one row a point.
        turn: [3, 3] float64, from the world of the fit to the portrait's, for normals.
        precision: In which the network computes.
    """

    kind: ClassVar[str] = "paper"

    network: GatedUNet
    descriptors: torch.Tensor
    turn: torch.Tensor
    precision: str = "float32"

    def decode(self, portrait: Portrait, camera: Camera) -> Maps:  # noqa: D102
        splats = splat_maps(portrait, camera)
        view = self.neural_maps(portrait.points, camera)
        mask = torch.where(view.mask[0] >= _LEAST_MASK, view.mask[0], 0.0)
        support = (mask > 0)[..., None]
        c_room, c_flash = (torch.tensor(colour).to(mask) for colour in (portrait.c_room, portrait.c_flash))
        flash = flash_image(view, c_flash, flash_distance(portrait.points, camera), towards_camera(camera))
        known = (splats.depth > 0).to(mask)
        depth = torch.where(known > 0, splats.depth, pull_push(torch.stack([splats.depth, known]), 1.0)[0])
        images = [view.albedo, view.normals_world, room_image(view, c_room), flash.clamp(min=0.0)]
        albedo, normals, room, flash = (torch.where(support, image.permute(1, 2, 0), 0.0) for image in images)
        return Maps(
            albedo=albedo,
            normals_world=normals,
            room_radiance=room,
            shading=torch.where(support[..., 0], view.shading[0], 0.0),
            mask=mask,
            depth=torch.where(support[..., 0], depth, 0.0),
            points_world=torch.where(support, unproject(depth, camera), 0.0),
            confidence=torch.where(support[..., 0], splats.confidence, 0.0),
            gloss=torch.where(support[..., 0], splats.gloss, 0.0),
            flash_bounce=torch.zeros_like(splats.gloss),
            point_ids=torch.where(support[..., 0], splats.point_ids, -1),
            flash_radiance=flash,
        )

    @torch.no_grad()
    def neural_maps(self, points: torch.Tensor, camera: Camera) -> NeuralMaps:
        """What the network says of a view of points [P, 3]; all 0 outside of their box."""
        height, width = camera.height, camera.width
        whole = NeuralMaps(*(points.new_zeros(count, height, width) for count in (3, 3, 1, 1)))
        box = _box(points, camera)
        if box is None:
            return whole
        left, top, columns, rows = box
        intrinsics = camera.K.copy()
        intrinsics[:2, 2] -= [left, top]
        boxed = replace(camera, width=columns, height=rows, K=intrinsics)
        ids = rasterize_ids(points, boxed, LEVELS).ids
        maps = rendered_maps(self.network, self.descriptors, ids, self.precision)
        normals = torch.einsum("ij,jhw->ihw", self.turn.to(points), maps.normals_world)
        maps = replace(maps, normals_world=torch.nn.functional.normalize(normals, dim=0, eps=1e-12))
        bottom, right = min(top + rows, height), min(left + columns, width)
        for name in ("albedo", "normals_world", "shading", "mask"):
            part = getattr(maps, name)[:, : bottom - top, : right - left]
            getattr(whole, name)[:, top:bottom, left:right] = part
        return whole

    def settings(self) -> dict[str, Any]:  # noqa: D102
        return {"precision": self.precision, "turn": self.turn.tolist()}

    def tensors(self) -> dict[str, torch.Tensor]:  # noqa: D102
        network = {_NETWORK + name: values for name, values in self.network.state_dict().items()}
        return {"descriptors": self.descriptors, **network}

    @classmethod
    def restored(cls, settings: Mapping[str, Any], tensors: Mapping[str, torch.Tensor]) -> PaperDecoder:  # noqa: D102
        descriptors = tensors["descriptors"]
        if descriptors.ndim != 2 or descriptors.shape[1] != DESCRIPTOR_LENGTH:
            raise ValueError(f"descriptors are not of shape [P, {DESCRIPTOR_LENGTH}]")
        turn = torch.tensor(settings["turn"], dtype=torch.float64)
        if turn.shape != (3, 3) or not turn.isfinite().all():
            raise ValueError("turn is no rotation")
        if settings["precision"] not in PRECISIONS:
            raise ValueError(f"precision {settings['precision']!r} is unknown")
        network = rendering_network()
        try:
            network.load_state_dict(
                {
                    name.removeprefix(_NETWORK): values
                    for name, values in tensors.items()
                    if name.startswith(_NETWORK)
                }
            )
        except RuntimeError as error:
            raise ValueError("its network has other layers") from error
        network = network.to(descriptors.device).eval().requires_grad_(False)
        return cls(network, descriptors, turn, settings["precision"])

    def to(self, device: torch.device | str) -> PaperDecoder:  # noqa: D102
        # A module moves in place: a copy, so that the portrait on the old device stays whole.
        moved = {name: values.to(device) for name, values in self.tensors().items()}
        return PaperDecoder.restored(self.settings(), moved)

    def subset(self, keep: torch.Tensor) -> PaperDecoder:  # noqa: D102
        return replace(self, descriptors=self.descriptors[keep])

    def transformed(self, similarity: Similarity) -> PaperDecoder:  # noqa: D102
        return replace(self, turn=torch.as_tensor(similarity.rotation, dtype=torch.float64) @ self.turn)


def _box(points: torch.Tensor, camera: Camera) -> tuple[int, int, int, int] | None:
    """Left, top, columns and rows of what the points and their margin take of the picture; None = nothing.

    Columns and rows are multiples of what the network halves, so the box may end beyond the picture.
    """
    uv_px, z = project(points, camera)
    size = uv_px.new_tensor([camera.width, camera.height])
    seen = uv_px[(z > NEAR_M) & (uv_px >= 0).all(dim=1) & (uv_px < size).all(dim=1)]
    if not len(seen):
        return None
    low, high = (
        (seen.amin(dim=0) - _MARGIN_PX).clamp(min=0),
        torch.minimum(seen.amax(dim=0) + _MARGIN_PX, size),
    )
    left, top = (int(value) for value in low)
    columns, rows = (
        _STEP_PX * max(1, math.ceil((float(end) - start) / _STEP_PX))
        for end, start in zip(high, (left, top), strict=True)
    )
    return left, top, columns, rows
