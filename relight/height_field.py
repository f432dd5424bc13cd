"""Heights over scattered points of a surface, and the normals that they make.

A surface's normals are not free: they are the slopes of one height field, so what is known of the slope in
one direction says something of the other (Horn and Brooks 1986, "The variational approach to shape from
shading"). Every point i may move by h_i along its normal; slopes are differences to its neighbours in the
tangent plane, by weighted least squares, and `HeightField.fit` finds the heights that a sum of squares over
slopes, heights and bending asks for (as Nehab et al. 2005, "Efficiently combining positions and normals for
precise 3D geometry", on points instead of a grid).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from relight.tangents import tangents

_NEIGHBOURS = 10
_WIDTH = 1.3  # standard deviation of a neighbour's weight, in spacings: the first ring and some of the second
_FACING = 0.5  # cosine between normals: neighbours across a fold are on another sheet
_STEADY = 0.05  # keeps the slopes of points with neighbours on one line finite, in squared spacings
_ENOUGH = 1e-3  # residual relative to the right side: heights are known to a percent at best


@dataclass(frozen=True, eq=False)
class SlopeTerms:
    """What is known of the slopes of P points: the sum over points of 1/2 s' A s - b' s.

    Attributes:
        uu, uv, vv: [P], the symmetric A, positive semi-definite.
        right: [2, P], b.
    """

    uu: torch.Tensor
    uv: torch.Tensor
    vv: torch.Tensor
    right: torch.Tensor


class HeightField:
    """Differences between neighbouring points of one surface.

    Attributes:
        u, v: [P, 3], unit tangents along which slopes are told.
    """

    def __init__(self, points: torch.Tensor, normals_world: torch.Tensor, spacing: float) -> None:
        """A field over points.

        Args:
            points: [P, 3] float32, world.
            normals_world: [P, 3] unit, of the surface at height 0.
            spacing: Of the points, world units; heights are in the same.
        """
        self._normals = normals_world
        self.u, self.v = (torch.from_numpy(axis).to(points) for axis in tangents(normals_world.cpu().numpy()))
        count = min(_NEIGHBOURS, len(points) - 1)
        near = np.zeros((len(points), 0), np.int64)
        if count > 0:
            places = points.cpu().numpy()
            _, near = cKDTree(places).query(places, k=list(range(2, count + 2)), workers=-1)
        rows = self._differences_to(points, torch.from_numpy(near).to(points.device), spacing)
        differences = _stacked([row.cpu().numpy() for row in rows], near)
        transposed = differences.T.tocsr()
        self._differences = _Sparse(differences, points.device)
        self._transposed = _Sparse(transposed, points.device)
        squares = csr_array((transposed.data**2, transposed.indices, transposed.indptr), transposed.shape)
        self._squared = _Sparse(squares, points.device)

    def slopes(self, heights: torch.Tensor) -> torch.Tensor:
        """Slopes [2, P] of heights [P], along u and v."""
        return self._apply(heights)[:2]

    def normals(self, heights: torch.Tensor) -> torch.Tensor:
        """Unit normals [P, 3] of the surface at heights [P]."""
        along_u, along_v = self.slopes(heights)
        tilted = self._normals - along_u[:, None] * self.u - along_v[:, None] * self.v
        return torch.nn.functional.normalize(tilted, dim=1)

    def fit(
        self, terms: SlopeTerms, *, anchor: float, bending: float, start: torch.Tensor, iterations: int
    ) -> torch.Tensor:
        """Heights [P] that minimise the slopes' terms + anchor h^2 / 2 + bending (bend of h)^2 / 2, summed.

        The bend of a point is its neighbours' mean height over its own, in spacings. Conjugate gradients with
        the diagonal as preconditioner; the system is positive definite for anchor > 0.

        Args:
            terms: Of the slopes of the heights.
            anchor: Per squared unit of height.
            bending: Weight, without unit.
            start: [P] to begin with.
            iterations: At most; it ends before where the residual is a thousandth of the right side.
        """

        def product(heights: torch.Tensor) -> torch.Tensor:
            along_u, along_v, bend = self._apply(heights)
            pulled_u = terms.uu * along_u + terms.uv * along_v
            pulled_v = terms.uv * along_u + terms.vv * along_v
            return self._adjoint(pulled_u, pulled_v, bending * bend) + anchor * heights

        right = self._adjoint(*terms.right, torch.zeros_like(start))
        diagonal = self._diagonal(terms.uu, terms.vv, torch.full_like(start, bending)) + anchor
        return _conjugate_gradients(product, right, diagonal, start, iterations)

    def _apply(self, heights: torch.Tensor) -> torch.Tensor:
        """Slopes along u and v, and the bend: [3, P]."""
        return self._differences(heights).view(3, -1)

    def _adjoint(self, *parts: torch.Tensor) -> torch.Tensor:
        """What the three parts [P] of `_apply` pull at each height: [P]."""
        return self._transposed(torch.cat(parts))

    def _diagonal(self, *weights: torch.Tensor) -> torch.Tensor:
        """Diagonal [P] of `_adjoint` after weights after `_apply`."""
        return self._squared(torch.cat(weights))

    def _differences_to(
        self, points: torch.Tensor, near: torch.Tensor, spacing: float
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Factors [P, k] on the differences to neighbours [P, k] that give slopes and bend.

        Slopes are those of the plane through the point that fits its neighbours best, weighted.
        """
        offsets = (points[near] - points[:, None]) / spacing
        x, y = ((offsets * axis[:, None]).sum(dim=-1) for axis in (self.u, self.v))
        facing = (self._normals[near] * self._normals[:, None]).sum(dim=-1) > _FACING
        weight = facing * torch.exp(-0.5 * (offsets * offsets).sum(dim=-1) / _WIDTH**2)
        xx, yy = ((weight * axis * axis).sum(dim=1, keepdim=True) + _STEADY for axis in (x, y))
        xy = (weight * x * y).sum(dim=1, keepdim=True)
        scale = weight / ((xx * yy - xy * xy) * spacing)
        share = weight / weight.sum(dim=1, keepdim=True).clamp(min=1e-6)
        return scale * (yy * x - xy * y), scale * (xx * y - xy * x), share / spacing


def _stacked(rows: list[NDArray[np.float32]], near: NDArray[np.int64]) -> csr_array:
    """[3 P, P] of factors [P, k] on differences to neighbours [P, k]."""
    count, neighbours = near.shape
    # 32-bit indices: half of what a product reads.
    own = np.arange(count, dtype=np.int32)[:, None]
    columns = np.concatenate([near.astype(np.int32), own], axis=1).ravel()
    starts = np.arange(len(rows) * count + 1, dtype=np.int32) * np.int32(neighbours + 1)
    values = [np.concatenate([row, -row.sum(axis=1, keepdims=True)], axis=1).ravel() for row in rows]
    return csr_array(
        (np.concatenate(values), np.tile(columns, len(rows)), starts), shape=(len(rows) * count, count)
    )


class _Sparse:
    """A sparse matrix times vectors: scipy's on the CPU, which takes a fifth of the time of torch's there."""

    def __init__(self, matrix: csr_array, device: torch.device) -> None:
        self._matrix = matrix
        self._on_card: torch.Tensor | None = None
        if device.type != "cpu":
            self._on_card = torch.sparse_csr_tensor(
                torch.from_numpy(matrix.indptr.astype(np.int64)),
                torch.from_numpy(matrix.indices.astype(np.int64)),
                torch.from_numpy(matrix.data),
                matrix.shape,
                device=device,
                check_invariants=False,
            )

    def __call__(self, vector: torch.Tensor) -> torch.Tensor:
        """[rows] of a vector [columns]."""
        if self._on_card is not None:
            return self._on_card @ vector
        return torch.from_numpy(self._matrix @ vector.numpy())


def _conjugate_gradients(
    product: Callable[[torch.Tensor], torch.Tensor],
    right: torch.Tensor,
    diagonal: torch.Tensor,
    start: torch.Tensor,
    iterations: int,
) -> torch.Tensor:
    """Solves product(x) = right (Hestenes and Stiefel 1952); inner products in float64."""

    def inner(first: torch.Tensor, second: torch.Tensor) -> float:
        return float((first * second).sum(dtype=torch.float64))

    solution = start.clone()
    residual = right - product(solution)
    enough = _ENOUGH**2 * inner(right, right)
    step = residual / diagonal
    slope = inner(residual, step)
    for _ in range(iterations):
        if inner(residual, residual) <= enough:
            break
        pulled = product(step)
        curvature = inner(step, pulled)
        if curvature <= 0.0:  # the step has rounded to none
            break
        length = slope / curvature
        solution += length * step
        residual -= length * pulled
        preconditioned = residual / diagonal
        next_slope = inner(residual, preconditioned)
        step = preconditioned + (next_slope / slope) * step
        slope = next_slope
    return solution
