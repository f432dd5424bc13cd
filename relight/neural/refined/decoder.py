"""Maps of a view as the solve's points give them, and the network's changes on top."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import torch

from capture.cameras import Camera
from relight.alignment import Similarity
from relight.decoder import Decoder
from relight.maps import Maps, splat_maps
from relight.neural.precision import PRECISIONS, products_in
from relight.neural.raw_images import raw_images
from relight.neural.refined.layers import Layers, changed, features, layers_of, strided
from relight.neural.refined.network import RefinedNetwork
from relight.portrait import Portrait
from relight.raster import NEAR_M, project

_NEARER = 1.25  # a view as much nearer than the fitted ones is decoded at their resolution
_MARGIN_PX = 16  # about the subject, of what the network sees
_NETWORK = "network."
_SAMPLE = 5_000


@dataclass(frozen=True, eq=False)
class RefinedDecoder(Decoder):
    """Network and descriptors of one portrait.

    Attributes:
        network: Not learning any more.
        descriptors: [P, L] float32, one row a point.
        pixels_a_unit: Of the frames that were fitted: pixels that a unit of length spans at the subject.
        turn: [3, 3] float64, from the portrait's world to that of the fit, for directions.
        precision: In which the network computes.
    """

    kind: ClassVar[str] = "refined"

    network: RefinedNetwork
    descriptors: torch.Tensor
    pixels_a_unit: float
    turn: torch.Tensor
    precision: str = "float32"

    def decode(self, portrait: Portrait, camera: Camera) -> Maps:  # noqa: D102
        maps = splat_maps(portrait, camera)
        share = self._share(portrait.points, camera)
        if share == 1.0:
            changes = self.changes(maps, camera)
        else:
            # The network knows detail of the size that the frames show; what it changes is carried over.
            smaller = camera.scaled(share)
            changes = torch.nn.functional.interpolate(
                self.changes(splat_maps(portrait, smaller), smaller)[None],
                (camera.height, camera.width),
                mode="bilinear",
                align_corners=False,
            )[0]
        layers = changed(layers_of(maps), changes)
        return replace(
            maps,
            room_radiance=layers.room_radiance,
            mask=layers.mask,
            flash_gain=layers.flash_gain,
        )

    @torch.no_grad()
    def changes(self, maps: Maps, camera: Camera) -> torch.Tensor:
        """[CHANGES, H, W] of a view's maps, 0 off the subject's box."""
        height, width = maps.mask.shape
        whole = maps.albedo.new_zeros(self.network.changes, height, width)
        box = _box(maps.mask, self.network.multiple)
        if box is None:
            return whole
        top, left, rows, columns = box
        within = (slice(top, min(top + rows, height)), slice(left, min(left + columns, width)))
        padding = (0, columns - (within[1].stop - left), 0, rows - (within[0].stop - top))
        intrinsics = camera.K.copy()
        intrinsics[:2, 2] -= [left, top]
        boxed = replace(camera, width=columns, height=rows, K=intrinsics)
        layers = _padded(layers_of(maps), within, padding)
        ids = torch.nn.functional.pad(maps.point_ids[within], padding, value=-1)
        changes = apply_network(self.network, self.descriptors, layers, ids, boxed, self.turn, self.precision)
        whole[:, within[0], within[1]] = changes[:, : within[0].stop - top, : within[1].stop - left]
        return whole

    def settings(self) -> dict[str, Any]:  # noqa: D102
        return {
            "descriptors": self.network.descriptors,
            "widths": list(self.network.widths),
            "pixels_a_unit": self.pixels_a_unit,
            "turn": self.turn.tolist(),
            "precision": self.precision,
        }

    def tensors(self) -> dict[str, torch.Tensor]:  # noqa: D102
        network = {_NETWORK + name: values for name, values in self.network.state_dict().items()}
        return {"descriptors": self.descriptors, **network}

    @classmethod
    def restored(cls, settings: Mapping[str, Any], tensors: Mapping[str, torch.Tensor]) -> RefinedDecoder:  # noqa: D102
        descriptors, count = tensors["descriptors"], int(settings["descriptors"])
        if descriptors.ndim != 2 or descriptors.shape[1] != count:
            raise ValueError(f"descriptors are not of shape [P, {count}]")
        turn = torch.tensor(settings["turn"], dtype=torch.float64)
        if turn.shape != (3, 3) or not turn.isfinite().all():
            raise ValueError("turn is no rotation")
        pixels = float(settings["pixels_a_unit"])
        if not 0.0 < pixels < math.inf:
            raise ValueError(f"pixels_a_unit is {pixels}")
        if settings["precision"] not in PRECISIONS:
            raise ValueError(f"precision {settings['precision']!r} is unknown")
        if any(values.dtype != torch.float32 for values in tensors.values()):
            raise ValueError("not all of its tensors are of float32")
        widths = [int(width) for width in settings["widths"]]
        if min(widths, default=0) < 1:
            raise ValueError(f"widths are {widths}")
        own = {n.removeprefix(_NETWORK): v for n, v in tensors.items() if n.startswith(_NETWORK)}
        try:
            with torch.device("meta"):  # takes neither memory, whatever the settings say, nor chance
                network = RefinedNetwork(count, widths)
            network.load_state_dict(own, assign=True)
        except RuntimeError as error:
            raise ValueError("its network has other layers") from error
        network = network.to(descriptors.device).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        return cls(network.eval().requires_grad_(False), descriptors, pixels, turn, settings["precision"])

    def to(self, device: torch.device | str) -> RefinedDecoder:  # noqa: D102
        moved = {name: values.to(device) for name, values in self.tensors().items()}
        return RefinedDecoder.restored(self.settings(), moved)

    def subset(self, keep: torch.Tensor) -> RefinedDecoder:  # noqa: D102
        return replace(self, descriptors=self.descriptors[keep])

    def transformed(self, similarity: Similarity) -> RefinedDecoder:  # noqa: D102
        back = torch.as_tensor(np.ascontiguousarray(similarity.rotation.T), dtype=torch.float64)
        return replace(self, turn=self.turn @ back, pixels_a_unit=self.pixels_a_unit / similarity.scale)

    def _share(self, points: torch.Tensor, camera: Camera) -> float:
        """Size, relative to the camera's, at which the view is decoded: 1 unless it is much nearer."""
        pixels = pixels_a_unit(points, camera)
        if pixels is None or pixels <= _NEARER * self.pixels_a_unit:
            return 1.0
        return self.pixels_a_unit / pixels


def apply_network(
    network: RefinedNetwork,
    descriptors: torch.Tensor,
    layers: Layers,
    ids: torch.Tensor,
    camera: Camera,
    turn: torch.Tensor,
    precision: str,
) -> torch.Tensor:
    """What the network changes of layers: [CHANGES, H, W], sides multiples of the network's.

    Args:
        network: Of the refinement.
        descriptors: [P, L].
        layers: Of the view, [H, W].
        ids: [H, W] int64, the visible point of each pixel, -1 = none.
        camera: Of the view.
        turn: [3, 3], from the portrait's world to that of the fit.
        precision: One of `PRECISIONS`.
    """
    seen = features(layers, camera, turn.to(layers.albedo))
    raw = raw_images(descriptors, strided(ids, network.scales))
    with products_in(precision, seen.device):
        changes: torch.Tensor = network(seen, raw)
    return changes.float()


def pixels_a_unit(points: torch.Tensor, camera: Camera) -> float | None:
    """Pixels that a unit of length spans at the median depth of points [P, 3]; None where none is in the
    picture."""
    uv_px, z = project(points[:: max(1, len(points) // _SAMPLE)], camera)
    seen = (z > NEAR_M) & (uv_px >= 0).all(dim=1)
    seen &= (uv_px[:, 0] < camera.width) & (uv_px[:, 1] < camera.height)
    return float(camera.K[0, 0]) / float(z[seen].median()) if bool(seen.any()) else None


def _box(mask: torch.Tensor, multiple: int) -> tuple[int, int, int, int] | None:
    """Top, left, rows and columns about where a mask [H, W] is not 0, on a grid of `multiple` pixels."""
    rows, columns = (mask > 0).any(dim=1).nonzero()[:, 0], (mask > 0).any(dim=0).nonzero()[:, 0]
    if not len(rows):
        return None
    top, left = (max(0, int(low[0]) - _MARGIN_PX) // multiple * multiple for low in (rows, columns))
    bottom, right = (int(high[-1]) + 1 + _MARGIN_PX for high in (rows, columns))
    height, width = mask.shape
    bottom, right = min(bottom, height), min(right, width)
    return top, left, -(-(bottom - top) // multiple) * multiple, -(-(right - left) // multiple) * multiple


def _padded(layers: Layers, within: tuple[slice, slice], padding: tuple[int, int, int, int]) -> Layers:
    """Part of layers, padded with zeros."""

    def part(image: torch.Tensor) -> torch.Tensor:
        own = (0, 0, *padding) if image.ndim == 3 else padding
        return torch.nn.functional.pad(image[within], own)

    return Layers(**{name: part(image) for name, image in vars(layers).items()})
