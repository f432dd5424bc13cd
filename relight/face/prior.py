"""What the fit knows of the face, whoever found it: the one interface for position maps, normals and masks.

For the paper's losses (Sevastopolsky et al. 2020, section 3.4), per frame i:

    Posmap_i        position_map(i)                      albedo A ⊙ Posmap_i = sample_texture(A, ...)
    N_i, M_face     face_normals(i)                      world space; the mask where the normals are known
    T_F             texture_of(pictures of flash frames)
    T_A             half_texture(T_F) to begin with; [T_A, flip(T_A)] = whole_texture(T_A)

A fit that draws crops or zooms asks with the camera of the crop: same pose, other K and size.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from capture.cameras import Camera
from relight.face.plane import Plane
from relight.face.surface import FaceSurface
from relight.face.textures import PositionMap, median_texture, sample_texture
from relight.raster import project, rasterize_ids

_FINEST = 8  # points along a texel's side: frames of 4K pixels need about this many
_COSINES = 255.0  # a cosine is kept as a byte


@dataclass(frozen=True, eq=False)
class FaceNormals:
    """The face as a frame sees it.

    Attributes:
        normals_world: [H, W, 3] float32, unit, 0 off the face.
        mask: [H, W] float32, 1 where the frame shows the face.
    """

    normals_world: torch.Tensor
    mask: torch.Tensor


@dataclass(frozen=True, eq=False)
class FacePrior:
    """A face in F frames.

    Attributes:
        source: "cloud", "landmarks" or "maps": who found it.
        reason: Why it is believed, for a person.
        surface: The face in texels.
        plane: Of symmetry, normal to the subject's left.
        cameras: By frame index; frames are taken as undistorted.
        cosines: [F, 256, 256] uint8, 255 * cosine between normal and camera, 0 where the frame does not show
            the texel or it is not the face's; in the order of `cameras`.
        uv_px: [F, 256, 256, 2] float32 where the provider gave the maps themselves; None = they are the
            surface's projections.
        report: Plain numbers and words about how it was found.
    """

    source: str
    reason: str
    surface: FaceSurface
    plane: Plane
    cameras: Mapping[int, Camera]
    cosines: torch.Tensor
    uv_px: torch.Tensor | None
    report: Mapping[str, Any]

    @property
    def indices(self) -> tuple[int, ...]:
        """Frames with a map, in order."""
        return tuple(self.cameras)

    @property
    def normals_uv(self) -> torch.Tensor:
        """[256, 256, 3] normals of the texels, world; 0 where there is no surface."""
        return self.surface.normals_world

    def to(self, device: torch.device | str) -> FacePrior:
        """The prior with its tensors on a device."""
        old = self.surface
        surface = FaceSurface(
            old.points.to(device),
            old.normals_world.to(device),
            old.valid.to(device),
            old.region.to(device),
            None if old.albedo is None else old.albedo.to(device),
        )
        maps = None if self.uv_px is None else self.uv_px.to(device)
        return replace(self, surface=surface, cosines=self.cosines.to(device), uv_px=maps)

    def position_map(self, index: int, camera: Camera | None = None) -> PositionMap:
        """Where the texels of the face are in a frame.

        Args:
            index: Of the frame.
            camera: Of a crop or zoom of the frame: the same pose with another K and size. None = the frame.

        Raises:
            KeyError: The frame has no map.
        """
        own, place = self.cameras[index], self._place(index)
        cosine = self.cosines[place].float() / _COSINES
        if self.uv_px is None:
            points = self.surface.points.reshape(-1, 3)
            uv_px, _ = project(points, camera or own)
            uv_px = uv_px.reshape(*self.surface.valid.shape, 2)
            # Texels without a surface project anywhere, even to infinity.
            uv_px = torch.where(self.surface.valid[..., None], uv_px.nan_to_num(0.0, 0.0, 0.0), 0.0)
            return PositionMap(uv_px, cosine)
        uv_px = self.uv_px[place]
        if camera is not None:
            change = torch.as_tensor(camera.K @ np.linalg.inv(own.K)).to(uv_px)
            uv_px = uv_px @ change[:2, :2].T + change[:2, 2]
        return PositionMap(uv_px, cosine)

    def face_normals(self, index: int, camera: Camera | None = None) -> FaceNormals:
        """N_i and M_face: the face's normals drawn into a frame, or into a crop of it."""
        camera = camera or self.cameras[index]
        shown = self.cosines[self._place(index)] > 0
        empty = self.surface.points.new_zeros(camera.height, camera.width, 3)
        if not bool(shown.any()):
            return FaceNormals(empty, empty[..., 0].clone())
        points, normals = self._refined(shown, camera)
        ids = rasterize_ids(points, camera).ids[0]
        seen = ids >= 0
        empty[seen] = normals[ids[seen]]
        return FaceNormals(empty, seen.float())

    def texture_of(
        self, load_image: Callable[[int], torch.Tensor], indices: Iterable[int], most: int = 64
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """T_F: the median of the textures of some frames.

        Args:
            load_image: Gives the picture [C, H, W] of a frame.
            indices: Frames to take, such as those with the flash; those without a map are passed over.
            most: More frames than this are thinned evenly: a median of 64 is as good.

        Returns:
            [C, 256, 256] and [256, 256] as `median_texture`; no gradients flow.

        Raises:
            ValueError: None of the frames has a map.
        """
        chosen = [index for index in indices if index in self.cameras]
        chosen = chosen[:: max(1, math.ceil(len(chosen) / most))]
        with torch.no_grad():
            sampled = [sample_texture(load_image(index), self.position_map(index)) for index in chosen]
        return median_texture([texture for texture, _ in sampled], [defined for _, defined in sampled])

    def _place(self, index: int) -> int:
        if index not in self.cameras:
            raise KeyError(f"frame {index} has no position map")
        return self.indices.index(index)

    def _refined(self, shown: torch.Tensor, camera: Camera) -> tuple[torch.Tensor, torch.Tensor]:
        """Points and normals of the shown texels, so dense that no pixel between them is missed."""
        surface = self.surface
        uv_px, _ = project(surface.points.reshape(-1, 3), camera)
        uv_px = uv_px.reshape(*shown.shape, 2)
        pitches = []
        for axis in (0, 1):
            step = (uv_px.diff(dim=axis) ** 2).sum(dim=-1).sqrt()
            both = shown.narrow(axis, 1, shown.shape[axis] - 1) & shown.narrow(axis, 0, shown.shape[axis] - 1)
            pitches.append(step[both])
        pitch = torch.cat(pitches)
        wanted = (
            2.5 * float(torch.quantile(pitch[:: max(1, len(pitch) // 100_000)], 0.95)) if len(pitch) else 1
        )
        factor = int(np.clip(math.ceil(wanted), 1, _FINEST))
        size = (factor * shown.shape[0], factor * shown.shape[1])

        def enlarged(values: torch.Tensor, mode: str) -> torch.Tensor:
            corners = None if mode == "nearest" else False
            return torch.nn.functional.interpolate(values[None], size, mode=mode, align_corners=corners)[0]

        # Between a texel of the face and one that is none, a mixture of the two is neither.
        whole = enlarged(shown[None].float(), "bilinear")[0] > 0.999
        points = enlarged(surface.points.permute(2, 0, 1), "bilinear").permute(1, 2, 0)[whole]
        normals = enlarged(surface.normals_world.permute(2, 0, 1), "bilinear").permute(1, 2, 0)[whole]
        return points, torch.nn.functional.normalize(normals, dim=1)
