"""What a panorama does to a glossy surface: the lobe of its gloss integrated beforehand.

The integral of radiance times gloss is split (Karis 2013, "Real shading in Unreal Engine 4") into the mean
radiance under the lobe, which is looked up in a panorama blurred by it, and what the lobe would give in an
even light, which depends on the angle of the view alone. The lobe is that of a view along the normal: towards
grazing angles the true one is stretched, and bends away from the mirror direction.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from relight.environment import flux_tiles
from relight.panorama import lat_long_directions
from relight.reflectance import Reflectance

_ROWS = 32  # of the blurred panorama: steps of 5.6 degrees, under the width of the lobes that are fitted
_ANGLES = 64  # cosines of the view in the table of even light, from 1/128
_RINGS, _SPOKES = 64, 64  # directions of light over which that is integrated


@dataclass(frozen=True, eq=False)
class GlossyEnvironment:
    """A panorama blurred by a GGX lobe.

    Attributes:
        radiance: [C, 32, 64 + 2], mean under the lobe about each direction, lat-long, the first and last
            column repeated on the other side.
    """

    radiance: Tensor

    @classmethod
    def of_panorama(cls, panorama: NDArray[np.floating], alpha: float) -> GlossyEnvironment:
        """Blurs a panorama [H, W, C] by the lobe of a GGX width; a quarter of a second on two cores."""
        flux = torch.from_numpy(flux_tiles(panorama)).float()  # [rows, columns, C, 3]
        axes = normalize(torch.from_numpy(lat_long_directions(*flux.shape[:2])).float(), dim=-1).view(-1, 3)
        # Radiance times solid angle of a tile: its flux along its middle.
        power = (flux.view(-1, *flux.shape[2:]) * axes[:, None]).sum(dim=-1)
        solid_angle = torch.from_numpy(flux_tiles(np.ones((1, 2, 1)))).float().view(-1, 3)
        solid_angle = (solid_angle * axes).sum(dim=-1, keepdim=True)
        middles = torch.from_numpy(lat_long_directions(_ROWS, 2 * _ROWS)).float().view(-1, 3)
        means = []
        for part in middles.split(512):  # 512 x 8192 weights are 16 MiB
            cosine = part @ axes.T
            half = (1.0 + cosine) / 2.0  # squared cosine of half the angle
            lobe = cosine.clamp(min=0.0) / (half * (alpha**2 - 1.0) + 1.0) ** 2
            means.append((lobe @ power) / (lobe @ solid_angle))
        image = torch.cat(means).T.reshape(-1, _ROWS, 2 * _ROWS)
        return cls(torch.cat([image[..., -1:], image, image[..., :1]], dim=-1))

    def __call__(self, directions: Tensor) -> Tensor:
        """Mean radiance [P, C] under the lobe about unit directions [P, 3] in the panorama's axes."""
        x, y, z = directions.unbind(-1)
        columns = torch.atan2(-x, z) / torch.pi  # phi = pi (1 + this): -1 at the first column's left edge
        inner = 2 * _ROWS
        across = columns * inner / (inner + 2)
        down = 2.0 / torch.pi * torch.acos(y.clamp(-1.0, 1.0)) - 1.0
        return grid_sample(
            self.radiance.to(directions)[None],
            torch.stack([across, down], dim=-1)[None, None],
            mode="bilinear",
            padding_mode="border",
            align_corners=False,
        )[0, :, 0].T


def even_light(reflectance: Reflectance, cosine: Tensor) -> tuple[Tensor, Tensor]:
    """What diffuse part and gloss give in an even light of radiance 1, at cosines of the view [P]: [P], [P].

    The diffuse part is a factor on the albedo, 1 for Lambert; the gloss is for a gloss factor of 1.
    """
    diffuse, gloss = (table.to(cosine) for table in _even_light(reflectance))
    at = (cosine.clamp(0.0, 1.0) * _ANGLES - 0.5).clamp(0.0, _ANGLES - 1.0)
    low = at.long().clamp(max=_ANGLES - 2)
    share = at - low
    return tuple(table[low] * (1.0 - share) + table[low + 1] * share for table in (diffuse, gloss))  # type: ignore[return-value]


@lru_cache(maxsize=16)
def _even_light(reflectance: Reflectance) -> tuple[Tensor, Tensor]:
    """The two tables, [64] each."""
    cosine = (torch.arange(_ANGLES, dtype=torch.float64) + 0.5) / _ANGLES
    to_view = torch.stack([(1.0 - cosine**2).sqrt(), torch.zeros_like(cosine), cosine], dim=1)
    # Even steps of the cosine are even in solid angle.
    up = (torch.arange(_RINGS, dtype=torch.float64) + 0.5) / _RINGS
    around = 2.0 * torch.pi * (torch.arange(_SPOKES, dtype=torch.float64) + 0.5) / _SPOKES
    up, around = (side.flatten() for side in torch.meshgrid(up, around, indexing="ij"))
    flat = (1.0 - up**2).sqrt()
    to_light = torch.stack([flat * around.cos(), flat * around.sin(), up], dim=1)
    normal = to_light.new_tensor([0.0, 0.0, 1.0])
    tables = []
    for albedo, of in ((1.0, Reflectance(reflectance.retro)), (0.0, reflectance)):
        response = of.response(
            to_light.new_full((1, 1, 3), albedo), normal, to_light[None], to_view[:, None]
        )[..., 0]
        # The response is pi times BRDF and cosine; the mean over half a sphere is over 2 pi. What is matte is
        # the same from all sides.
        tables.append(2.0 * response.mean(dim=1).expand(_ANGLES))
    return tables[0], tables[1]
