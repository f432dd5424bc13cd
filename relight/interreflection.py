"""Light that a subject throws upon itself: what keeps shadows and hollows from going black.

The subject is taken for some ten thousand surfels, one for each cube that its points lie in and each way they
face. What each of them sees of the others is told by bundles of parallel rays (Szirmay-Kalos and Purgathofer
1998, "Global ray-bundle tracing with hardware acceleration"): for each of many directions, the surfels that
share a cell across it are put in order along it, and each sees the next one that faces it. With w for the K
directions, spread evenly over the sphere, and B the radiance of a white surface in its place,

    indirect B_i = sum over w of 4 / K max(0, <n_i, w>) A_j (B_j + indirect B_j),   j seen from i along w

is what arrives, over pi (Goral et al. 1984, "Modeling the interaction of light between diffuse surfaces",
with the sum over directions in place of form factors). It does not depend on the light, so it is found once;
a light then costs its direct part at the surfels and a few sparse products.

Surfaces are taken for diffuse here, and the albedo for absolute. Where its scale is a convention
(`relight.photometric`) a factor on it comes with the portrait, found from what bounced under the capture's
own flash (`relight.flash_bounces`).
"""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
import torch
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

_SURFELS = 60_000
_GOLDEN_RAD = math.pi * (3.0 - math.sqrt(5.0))
_DIRECTIONS = 128  # in pairs: one order serves both ways
_CELL = 1.5  # across a bundle, in sides of a surfel
_FACING = 0.05  # cosine under which a surfel takes no part in a bundle
_BOUNCES = 3  # with an albedo of one half and half of the sky hidden, a fiftieth is left
_NEIGHBOURS = 6  # surfels that a point takes its indirect light from


class Reflecting(Protocol):
    """A surface that reflects; a portrait is one."""

    @property
    def points(self) -> torch.Tensor:
        """[P, 3], world."""

    @property
    def normals_world(self) -> torch.Tensor:
        """[P, 3], unit."""

    @property
    def albedo(self) -> torch.Tensor:
        """[P, 3]."""

    @property
    def spacing(self) -> float:
        """Of the points, world units."""


class Interreflection:
    """What the surfels of one surface see of each other.

    Attributes:
        ids: [S] int64, the point that stands for each surfel.
        normals_world: [S, 3], unit, mean of the surfel's points.
        albedo: [S, 3], mean of the surfel's points, times a factor.
        side: Of a surfel, world units.
        points_world, shading, mask: with normals and albedo the maps that a light falls on; grey ones.
    """

    def __init__(
        self,
        surface: Reflecting,
        factor: float = 1.0,
        surfels: int = _SURFELS,
        directions: int = _DIRECTIONS,
    ) -> None:
        """Finds it, for the surface's albedo times a factor; a second or two on two cores for the default
        numbers."""
        points, normals = surface.points, surface.normals_world
        side = surface.spacing * max(1.0, math.sqrt(len(points) / surfels))
        member, self.ids = _surfels(points, normals, side)
        sums = torch.zeros(len(self.ids), 7, device=points.device, dtype=points.dtype)
        rows = torch.cat([normals, factor * surface.albedo, torch.ones_like(points[:, :1])], dim=1)
        sums.index_add_(0, member, rows)
        self.normals_world = torch.nn.functional.normalize(sums[:, :3], dim=1)
        self.albedo = (sums[:, 3:6] / sums[:, 6:]).clamp(0.0, 1.0)
        self.points_world = points[self.ids]
        self.shading = self.mask = torch.ones_like(self.points_world[:, 0])
        self._points, self.side = points, side
        receiver, sender, share = _bundles(self.points_world, self.normals_world, _CELL * side, directions)
        self._transport = _Transport(receiver, sender, share, len(self.ids))
        self._near: tuple[torch.Tensor, torch.Tensor] | None = None

    def indirect(self, direct: torch.Tensor) -> torch.Tensor:
        """Light that arrives from other parts of the subject, [S, C] or [S, K, C], after up to three bounces.

        Args:
            direct: [S, C] of one light or [S, K, C] of several, what arrives from the light itself; both as
                the radiance of a white surface.
        """
        albedo = self.albedo if direct.ndim == 2 else self.albedo[:, None]
        indirect = torch.zeros_like(direct, memory_format=torch.contiguous_format)
        for _ in range(_BOUNCES):
            sent = albedo * (direct + indirect)
            indirect = self._transport(sent.flatten(1)).view_as(indirect)
        return indirect

    def of_points(self, values: torch.Tensor, ids: torch.Tensor) -> torch.Tensor:
        """Values [S, C] of the surfels at some points [N], from those beside each: [N, C]."""
        if self._near is None:
            self._near = self._beside()
        near, weight = self._near
        near, weight = near[ids], weight[ids]
        result = values.new_zeros(len(ids), values.shape[1])
        for k in range(near.shape[1]):
            result += weight[:, k, None] * values[near[:, k]]
        return result

    def _beside(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Surfels beside every point [P, k], and their weights [P, k], which sum to 1."""
        surfels = self.points_world.cpu().numpy()
        count = min(_NEIGHBOURS, len(surfels))
        distances, near = cKDTree(surfels).query(
            self._points.cpu().numpy(), k=list(range(1, count + 1)), workers=-1
        )
        # Relative to the nearest, so that the weights cannot all underflow.
        square = (distances**2 - distances[:, :1] ** 2) / self.side**2
        weight = torch.from_numpy(np.exp(-0.5 * square).astype(np.float32)).to(self._points)
        ids = torch.from_numpy(near).to(self._points.device)
        # Beside a fold lie surfels of its other side.
        nearest = self.normals_world[ids[:, 0]]
        for k in range(1, count):
            weight[:, k] *= (nearest * self.normals_world[ids[:, k]]).sum(dim=1).clamp(min=0.0)
        return ids, weight / weight.sum(dim=1, keepdim=True)


class _Transport:
    """The sparse matrix that takes what surfels send to what they receive.

    On a CPU as one of scipy, whose product is some ten times as fast as torch's `index_add_`.
    """

    def __init__(self, receiver: torch.Tensor, sender: torch.Tensor, share: torch.Tensor, count: int) -> None:
        self._entries = receiver, sender, share
        self._matrix = None
        if share.device.type == "cpu":
            places = receiver.numpy(), sender.numpy()
            self._matrix = csr_array((share.numpy(), places), shape=(count, count))

    def __call__(self, sent: torch.Tensor) -> torch.Tensor:
        """What is received, [S, C], of what is sent, [S, C]."""
        if self._matrix is not None:
            return torch.from_numpy(self._matrix @ sent.numpy())
        receiver, sender, share = self._entries
        return torch.zeros_like(sent).index_add_(0, receiver, sent[sender] * share[:, None])


def _surfels(points: torch.Tensor, normals: torch.Tensor, side: float) -> tuple[torch.Tensor, torch.Tensor]:
    """The surfel of every point [P], and a point for every surfel [S]: of the same cube and facing alike."""
    lattice = ((points - points.amin(dim=0)) / side).long()
    sides = lattice.amax(dim=0) + 1
    axis = normals.abs().argmax(dim=1)
    facing = 2 * axis + (normals.gather(1, axis[:, None])[:, 0] < 0)
    number = ((lattice[:, 0] * sides[1] + lattice[:, 1]) * sides[2] + lattice[:, 2]) * 6 + facing
    _, member = torch.unique(number, return_inverse=True)
    ids = torch.empty(int(member.max()) + 1, dtype=torch.int64, device=points.device)
    every = torch.arange(len(points), device=points.device)
    return member, ids.scatter_reduce_(0, member, every, "amin", include_self=False)


def _bundles(
    points: torch.Tensor, normals: torch.Tensor, cell: float, directions: int
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Who receives from whom, and which share of what a white surface there would send: [N], [N], [N]."""
    receivers, senders, shares = [], [], []
    place = torch.arange(len(points), device=points.device)
    offsets = np.random.default_rng(0).random((directions // 2, 2))  # cells' borders do not line up
    for axes, offset in zip(_frames(directions // 2).to(points), offsets, strict=True):
        local = points @ axes.T
        grid = (local[:, :2] - local[:, :2].amin(dim=0)) / cell + torch.from_numpy(offset).to(local)
        whole = grid.long()
        column = whole[:, 0] * (whole[:, 1].max() + 1) + whole[:, 1]
        along = local[:, 2] - local[:, 2].amin()
        # One key to sort by: the cell, then the depth to a 2^20th of the subject.
        depth = (along / along.amax().clamp(min=1e-12) * (2**20 - 1)).long()
        order = torch.argsort(column * 2**20 + depth)
        column, cosine = column[order], (normals @ axes[2])[order]
        ahead, back = cosine > _FACING, cosine < -_FACING
        following = torch.where(back, place, len(place)).flip(0).cummin(0).values.flip(0)
        before = torch.where(ahead, place, -1).cummax(0).values
        for receiving, sending in ((ahead, following), (back, before)):
            at = (receiving & (sending >= 0) & (sending < len(place))).nonzero()[:, 0]
            of = sending[at]
            same = column[at] == column[of]
            at, of = at[same], of[same]
            receivers.append(order[at])
            senders.append(order[of])
            shares.append(cosine[at].abs() * (4.0 / directions))
    return torch.cat(receivers), torch.cat(senders), torch.cat(shares)


def _frames(count: int) -> torch.Tensor:
    """Frames [count, 3, 3] (float64), their last rows evenly over half a sphere."""
    w = even_directions(2 * count)[:count]
    u = torch.nn.functional.normalize(torch.linalg.cross(w.new_tensor([[0.0, 1.0, 0.0]]), w), dim=1)
    return torch.stack([u, torch.linalg.cross(w, u), w], dim=1)


def even_directions(count: int) -> torch.Tensor:
    """Directions [count, 3] (float64) evenly over the sphere, on a golden-angle spiral from +z to -z."""
    step = torch.arange(count, dtype=torch.float64) + 0.5
    z = 1.0 - 2.0 * step / count
    phi = step * _GOLDEN_RAD
    radius = torch.sqrt(1.0 - z * z)
    return torch.stack([radius * torch.cos(phi), radius * torch.sin(phi), z], dim=1)


def spiral(count: int) -> torch.Tensor:
    """Places [count, 2] (float64) evenly over the unit disc (Vogel 1979, "A better way to construct the
    sunflower head")."""
    step = torch.arange(count, dtype=torch.float64) + 0.5
    radius, phi = torch.sqrt(step / count), step * _GOLDEN_RAD
    return torch.stack([radius * torch.cos(phi), radius * torch.sin(phi)], dim=1)
