"""Gloss of the room's light on the subject, which moves with the camera.

The room's radiance of a point is its diffuse part, alike from everywhere, and what its gloss mirrors of the
room. A lobe as wide as skin's blurs the room to a few spherical harmonics of the mirrored direction r
(Ramamoorthi and Hanrahan 2001, "A signal-processing framework for inverse rendering", section 4):

    L_room(x, v) = diffuse(x) + F(x, v) sum_lm c_lm Y_lm(r),    r = 2 <n, v> n - v
    F = gloss(x) (f0 + (1 - f0) (1 - <n, v>)^5)

with f0 and the points' gloss from the flash (`relight.reflectance`). So all points and unlit frames share few
numbers c, found by least squares with the diffuse part of every point taken out of the problem (variable
projection). What of the gloss is the same in all views cannot be told from the diffuse part and stays there.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch

from relight.reflectance import Reflectance
from relight.spherical_harmonics import bands_of, rotate_sh, sh_basis

BANDS = 5
"""A lobe of GGX width 0.25 leaves little of a sixth."""

_SMOOTH = 1e-3  # weight, relative to the data's, of a coefficient's square times (l (l + 1))^2 + 1
_MODEL = 0.05  # relative deviation that counts as large
_BRIGHT = 4.0  # coefficient: an even room as bright as white has 3.5; bounds what noise makes of near views
_FLOOR = 0.02  # radiance under which deviations are no longer told relative to it
_ITERATIONS = 3
_SAMPLE = 50_000
_MEAN_CAMERAS = 24
_CHUNK = 1 << 13  # points at a time: [K, chunk, BANDS^2] floats stay under some 100 MB


@dataclass(frozen=True, eq=False)
class RoomGloss:
    """What the subject's gloss mirrors of the room.

    Attributes:
        coefficients: [B^2, 3] of the mirrored radiance, blurred by the lobe; world axes.
    """

    coefficients: torch.Tensor

    def __post_init__(self) -> None:
        bands_of(self.coefficients)

    def radiance(
        self,
        points: torch.Tensor,
        normals: torch.Tensor,
        gloss: torch.Tensor,
        centre: torch.Tensor,
        reflectance: Reflectance,
    ) -> torch.Tensor:
        """Radiance [..., 3] that it adds, of either sign: what all views share is in the diffuse part.

        Args:
            points: [..., 3], world.
            normals: [..., 3], unit.
            gloss: [...], factor on f0.
            centre: [3], of the camera.
            reflectance: Of the subject.
        """
        mirrored, strength = _mirror(points, normals, gloss, centre, reflectance)
        coefficients = self.coefficients.to(points)
        return strength[..., None] * (sh_basis(mirrored, bands_of(coefficients)) @ coefficients)

    def mean_radiance(
        self,
        points: torch.Tensor,
        normals: torch.Tensor,
        gloss: torch.Tensor,
        reflectance: Reflectance,
        weight: torch.Tensor,
        centres: torch.Tensor,
    ) -> torch.Tensor:
        """Mean [P, 3] of what it adds over cameras; `weight` [K, P] and `centres` [K, 3] as for the fit.

        Of many cameras some, evenly: from one to the next it changes little.
        """
        sums, total = torch.zeros_like(points), torch.zeros_like(points[:, :1])
        step = -(-len(centres) // _MEAN_CAMERAS)
        for centre, seen in zip(centres[::step], weight[::step], strict=True):
            ids = (seen > 0).nonzero()[:, 0]
            added = self.radiance(points[ids], normals[ids], gloss[ids], centre, reflectance)
            sums.index_add_(0, ids, seen[ids, None] * added)
            total += seen[:, None]
        return sums / total.clamp(min=1e-6)

    def turned(self, rotation: torch.Tensor) -> RoomGloss:
        """In a world that is turned by a rotation [3, 3]."""
        return RoomGloss(rotate_sh(self.coefficients, rotation.to(self.coefficients)))


def fit_room_gloss(
    points: torch.Tensor,
    normals: torch.Tensor,
    gloss: torch.Tensor,
    reflectance: Reflectance,
    radiance: torch.Tensor,
    weight: torch.Tensor,
    centres: torch.Tensor,
) -> RoomGloss | None:
    """Fits the gloss to unlit frames.

    Args:
        points: [P, 3], world.
        normals: [P, 3], unit.
        gloss: [P], factor on f0.
        reflectance: Of the subject.
        radiance: [K, P, 3] of the unlit frames.
        weight: [K, P], 0 where a frame does not show a point.
        centres: [K, 3], of the cameras.

    Returns:
        The gloss; None where the subject has none, or fewer than three frames or no point show it.
    """
    if reflectance.f0 <= 0 or len(centres) < 3:
        return None
    step = max(1, len(points) // _SAMPLE)
    some = slice(None, None, step)
    points, normals, gloss = points[some], normals[some], gloss[some]
    radiance, weight = radiance[:, some], weight[:, some]
    count = BANDS * BANDS
    degree = torch.cat([torch.full((2 * band + 1,), float(band)) for band in range(BANDS)])
    roughness = (degree * (degree + 1.0)) ** 2 + 1.0
    coefficients = points.new_zeros(count, 3)
    for _ in range(_ITERATIONS):
        left = torch.zeros(count, count, dtype=torch.float64)
        right = torch.zeros(count, 3, dtype=torch.float64)
        for part in _chunks(len(points)):
            mirrored, strength = _mirror(
                points[part], normals[part], gloss[part], centres[:, None], reflectance
            )
            basis = strength[..., None] * sh_basis(mirrored, BANDS)
            shares = weight[:, part] / weight[:, part].sum(dim=0).clamp(min=1e-6)
            basis = basis - torch.einsum("kp,kpi->pi", shares, basis)
            mean = torch.einsum("kp,kpc->pc", shares, radiance[:, part])
            scale = mean.mean(dim=-1).clamp(min=0.0) + _FLOOR
            moving = (radiance[:, part] - mean) / scale[:, None]
            basis = basis / scale[:, None]
            deviation = (moving - basis @ coefficients).mean(dim=-1) / _MODEL
            robust = weight[:, part] / (1.0 + deviation * deviation)
            weighted = (robust[..., None] * basis).flatten(0, 1)
            left += (weighted.T @ basis.flatten(0, 1)).cpu().double()
            right += (weighted.T @ moving.flatten(0, 1)).cpu().double()
        usual = float(left.diagonal().mean())
        if not usual > 0:
            return None
        left += torch.diag((_SMOOTH * usual + (_MODEL / _BRIGHT) ** 2) * roughness.double())
        coefficients = torch.linalg.solve(left, right).to(points)
    return RoomGloss(coefficients)


def _mirror(
    points: torch.Tensor,
    normals: torch.Tensor,
    gloss: torch.Tensor,
    centre: torch.Tensor,
    reflectance: Reflectance,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Mirrored directions [..., 3] and F [...]; 0 where the camera sees the surface from behind."""
    towards = torch.nn.functional.normalize(centre - points, dim=-1)
    cosine = (normals * towards).sum(dim=-1)
    mirrored = 2.0 * cosine[..., None] * normals - towards
    fresnel = reflectance.f0 + (1.0 - reflectance.f0) * (1.0 - cosine.clamp(0.0, 1.0)) ** 5
    return mirrored, gloss * fresnel * (cosine > 0)


def _chunks(count: int) -> Iterator[slice]:
    for start in range(0, count, _CHUNK):
        yield slice(start, min(start + _CHUNK, count))
