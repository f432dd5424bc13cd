"""Real spherical harmonics: basis, projection, rotation and Lambertian irradiance.

Letters: l is the band, m in -l..l the degree within it, L_lm a coefficient of incident radiance, A_l the
cosine convolution, E irradiance, M the paper's 4 x 4 matrix. B bands have B^2 coefficients, ordered l^2 + l +
m; the paper's "third order" is B = 3, nine coefficients a channel.

The basis is orthonormal over the sphere, without the Condon-Shortley sign, and a polynomial of the *world*
direction (x, y, z) as in Ramamoorthi and Hanrahan 2001, eq. 3: Y_1,-1 = 0.4886 y, Y_1,0 = 0.4886 z, Y_1,1 =
0.4886 x, Y_2,-2 = 1.0925 x y and so on. (Their z is only the polar axis of the basis; our world's up is y all
the same.)
"""

from __future__ import annotations

import math

import torch
from torch import Tensor


def sh_basis(directions: Tensor, bands: int) -> Tensor:
    """Basis functions Y_lm, by a recurrence without trigonometry, so smooth at the poles.

    Args:
        directions: [..., 3], unit, world. Other lengths give the polynomials' values, which mean nothing.
        bands: number of bands B >= 1.

    Returns:
        [..., B^2].
    """
    if bands < 1:
        raise ValueError(f"spherical harmonics need at least one band, got {bands}")
    x, y, z = directions.unbind(-1)
    # legendre[l, m]: normalised associated Legendre function of z without its factor sin^m, which is instead
    # in (x + i y)^m = cosine[m] + i sine[m].
    legendre: dict[tuple[int, int], Tensor] = {(0, 0): torch.full_like(z, math.sqrt(1.0 / (4.0 * math.pi)))}
    cosine, sine = [torch.ones_like(x)], [torch.zeros_like(x)]
    for m in range(1, bands):
        cosine.append(x * cosine[m - 1] - y * sine[m - 1])
        sine.append(x * sine[m - 1] + y * cosine[m - 1])
        legendre[m, m] = legendre[m - 1, m - 1] * math.sqrt((2 * m + 1) / (2 * m))
    for m in range(bands - 1):
        legendre[m + 1, m] = math.sqrt(2 * m + 3) * z * legendre[m, m]
        for l in range(m + 2, bands):  # noqa: E741 - the field's letter
            scale = math.sqrt((4 * l * l - 1) / (l * l - m * m))
            before = math.sqrt(((l - 1) ** 2 - m * m) / (4 * (l - 1) ** 2 - 1))
            legendre[l, m] = scale * (z * legendre[l - 1, m] - before * legendre[l - 2, m])
    values = []
    for l in range(bands):  # noqa: E741
        values += [math.sqrt(2.0) * legendre[l, m] * sine[m] for m in range(l, 0, -1)]
        values += [legendre[l, 0]]
        values += [math.sqrt(2.0) * legendre[l, m] * cosine[m] for m in range(1, l + 1)]
    return torch.stack(values, dim=-1)


def project_to_sh(radiance: Tensor, directions: Tensor, solid_angles: Tensor, bands: int) -> Tensor:
    """Coefficients L_lm = sum of radiance * Y_lm * solid angle (Ramamoorthi and Hanrahan 2001, eq. 9).

    Args:
        radiance: [S, C], linear.
        directions: [S, 3], unit, where the radiance comes from.
        solid_angles: [S], steradian; together they cover the sphere (4 pi) for a full environment.
        bands: number of bands B.

    Returns:
        [B^2, C].
    """
    return sh_basis(directions, bands).T @ (radiance * solid_angles[:, None])


def cosine_convolution(bands: int) -> list[float]:
    """Factors A_l from radiance to irradiance, one a band (Ramamoorthi and Hanrahan 2001, eqs. 7-8)."""
    factors = []
    for l in range(bands):  # noqa: E741
        if l == 1:
            factors.append(2.0 * math.pi / 3.0)
        elif l % 2:
            factors.append(0.0)
        else:
            half = l // 2
            sign = -1.0 if half % 2 == 0 else 1.0
            central = math.comb(l, half) / 2.0**l
            factors.append(2.0 * math.pi * sign * central / ((l + 2) * (l - 1)))
    return factors


def sh_irradiance(coefficients: Tensor, normals: Tensor) -> Tensor:
    """Irradiance E(n) = sum A_l L_lm Y_lm(n) for any number of bands; may ring below zero.

    Args:
        coefficients: [B^2, C] of incident radiance.
        normals: [..., 3], unit.

    Returns:
        [..., C].
    """
    bands = bands_of(coefficients)
    per_coefficient = [a for l, a in enumerate(cosine_convolution(bands)) for _ in range(2 * l + 1)]  # noqa: E741
    return sh_basis(normals, bands) @ (coefficients * coefficients.new_tensor(per_coefficient)[:, None])


def irradiance_matrix(coefficients: Tensor) -> Tensor:
    """Matrix M of E(n) = [n 1] M [n 1]^T (Sevastopolsky 2020, eq. 7; Ramamoorthi and Hanrahan 2001, eq. 12).

    Args:
        coefficients: [9, C] of incident radiance.

    Returns:
        [C, 4, 4], symmetric, linear in the coefficients.
    """
    if coefficients.shape[0] != 9:
        raise ValueError(f"the quadratic form needs 9 coefficients a channel, got {coefficients.shape[0]}")
    l00, l1m, l10, l11, l2mm, l2m, l20, l21, l22 = coefficients.unbind(0)
    c1, c2, c3, c4, c5 = _QUADRATIC_CONSTANTS
    rows = [
        [c1 * l22, c1 * l2mm, c1 * l21, c2 * l11],
        [c1 * l2mm, -c1 * l22, c1 * l2m, c2 * l1m],
        [c1 * l21, c1 * l2m, c3 * l20, c2 * l10],
        [c2 * l11, c2 * l1m, c2 * l10, c4 * l00 - c5 * l20],
    ]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def quadratic_irradiance(matrix: Tensor, normals: Tensor) -> Tensor:
    """Irradiance [n 1] M [n 1]^T (Sevastopolsky 2020, eq. 7): the same as `sh_irradiance` with three bands.

    Args:
        matrix: [C, 4, 4] from `irradiance_matrix`.
        normals: [..., 3], unit.

    Returns:
        [..., C].
    """
    x, y, z = normals.unbind(-1)
    # The ten distinct products make this one matrix product: several times faster than einsum over [..., 4,
    # 4].
    products = torch.stack([x * x, y * y, z * z, x * y, x * z, y * z, x, y, z, torch.ones_like(x)], dim=-1)
    pairs = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2), (0, 3), (1, 3), (2, 3), (3, 3)]
    weights = torch.stack([matrix[:, i, j] * (1.0 if i == j else 2.0) for i, j in pairs])
    return products @ weights


def rotate_sh(coefficients: Tensor, rotation: Tensor) -> Tensor:
    """Coefficients of the rotated function: what was seen along d is then seen along `rotation @ d`.

    Exact up to rounding: the function is sampled at more directions than it has coefficients and solved for.

    Args:
        coefficients: [B^2, C].
        rotation: [3, 3], proper.

    Returns:
        [B^2, C].
    """
    bands = bands_of(coefficients)
    directions = _spiral_directions(4 * bands * bands).to(coefficients)
    before = sh_basis(directions @ rotation.to(coefficients), bands)  # rows: rotation^T @ d
    return torch.linalg.lstsq(sh_basis(directions, bands), before @ coefficients).solution


def rotation_about_up(angle_deg: float) -> Tensor:
    """Rotation [3, 3] (float64) about the world's up (+Y), right-handed: +90 degrees takes +Z to +X."""
    c, s = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    return torch.tensor([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]], dtype=torch.float64)


def bands_of(coefficients: Tensor) -> int:
    """Number of bands of a [B^2, C] set; raises ValueError when the count is not a square."""
    bands = math.isqrt(coefficients.shape[0])
    if bands * bands != coefficients.shape[0] or bands == 0:
        raise ValueError(
            f"{coefficients.shape[0]} coefficients of spherical harmonics make no whole bands; 1, 4, 9, 16 do"
        )
    return bands


def _spiral_directions(count: int) -> Tensor:
    """Nearly even directions [count, 3] (float64) on a golden-angle spiral."""
    i = torch.arange(count, dtype=torch.float64) + 0.5
    z = 1.0 - 2.0 * i / count
    phi = i * math.pi * (3.0 - math.sqrt(5.0))
    radius = torch.sqrt(1.0 - z * z)
    return torch.stack([radius * torch.cos(phi), radius * torch.sin(phi), z], dim=-1)


# c1..c5 of Ramamoorthi and Hanrahan 2001, eq. 12 (0.429043, 0.511664, 0.743125, 0.886227, 0.247708), to full
# precision: each is A_l times the basis constant, halved where M holds the entry twice.
_QUADRATIC_CONSTANTS = (
    math.sqrt(15.0 * math.pi) / 16.0,
    math.sqrt(math.pi / 3.0) / 2.0,
    3.0 * math.sqrt(5.0 * math.pi) / 16.0,
    math.sqrt(math.pi) / 2.0,
    math.sqrt(5.0 * math.pi) / 16.0,
)
