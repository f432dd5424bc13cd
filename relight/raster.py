"""Z-buffer rasterisation of points into an image pyramid.

The raw images S[0], ..., S[T] of the paper (Sevastopolsky et al. 2020, section 3.2, after NPBG, Aliev et al.
2020): per pixel the nearest point that projects into it, at several scales. Point positions and poses do not
change during a fit, so the result kept here is the *id* of that point; descriptors are looked up through
the ids (`gather_descriptors`), which is where the gradient flows.

How it is fast: depth (as the bits of a positive float32, which sort like the number) and point id share one
64-bit key, so the z-test is one `scatter_reduce(amin)` and its result does not depend on the order of the
points. A coarser level is the minimum over 2x2 keys of the finer one: exactly what projecting the points
again would give, at a quarter of the pixels instead of all of the points. No compiler is needed, and the
same code runs on CUDA.

Pixel (0, 0) covers [0, 1) x [0, 1); depth is z along the optical axis in metres; points at or behind
`NEAR_M`, outside the picture, or with a non-finite coordinate are left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from capture.cameras import Camera

NEAR_M = 1e-3
"""Points nearer than this to the camera plane are not drawn: their projection has no meaning."""

_ID_BITS = 32
_CHUNK = 1 << 16  # points at a time on the CPU: what is computed of them stays in its cache
_EMPTY = 0x7F800000 << _ID_BITS
"""Key of depth +inf, behind every point. `pad` takes its value as a float64, in which the largest int64 is
none but this number is exact."""


@dataclass(frozen=True)
class IdPyramid:
    """Nearest point per pixel at every scale.

    Attributes:
        ids: level t is [ceil(H / 2^t), ceil(W / 2^t)] int64, the index of the nearest point, -1 where there
            is none.
        depth_m: as `ids`, float32, z of that point, +inf where there is none.
    """

    ids: tuple[torch.Tensor, ...]
    depth_m: tuple[torch.Tensor, ...]


def project(points_world: torch.Tensor, camera: Camera) -> tuple[torch.Tensor, torch.Tensor]:
    """Pixel coordinates and depths of points, without lens distortion.

    Args:
        points_world: [P, 3], metres.
        camera: its `K` and `cam_from_world` are used; images are undistorted before they reach this code.

    Returns:
        uv_px [P, 2] with pixel centres at 0.5, and z_m [P]. Behind the camera (z <= 0) uv_px has no
        meaning: test z.
    """
    cam_from_world = torch.as_tensor(camera.cam_from_world, dtype=torch.float64)
    # One matrix for rotation and intrinsics, multiplied in float64, spares a pass over the points. As rows,
    # u, v and z are each contiguous, which what follows reads at several times the speed.
    image_from_world = torch.as_tensor(np.asarray(camera.K), dtype=torch.float64) @ cam_from_world[:3]
    image_from_world = image_from_world.to(points_world)
    rows = torch.addmm(image_from_world[:, 3:], image_from_world[:, :3], points_world.T)
    z_m = rows[2]
    return (rows[:2] / z_m).T, z_m


def rasterize_ids(points_world: torch.Tensor, camera: Camera, levels: int = 1) -> IdPyramid:
    """Z-buffer points into a pyramid of ids in one pass over the points.

    Args:
        points_world: [P, 3] float32 metres; P may be 0 and must be below 2^31.
        camera: gives the size of level 0.
        levels: number of scales, at least 1.

    Returns:
        The nearest point of every pixel at each scale. Equal depths go to the lower id, so the result is
        the same for any number of threads and on any device.

    Raises:
        ValueError: if `levels` < 1 or there are too many points.
    """
    if levels < 1:
        raise ValueError(f"levels is {levels}; a pyramid has at least one level")
    if points_world.shape[0] >= 2**31:
        raise ValueError(
            f"{points_world.shape[0]} points do not fit the 31 bits of a point id; thin the cloud"
        )
    height, width = camera.height, camera.width
    device = points_world.device
    buffer = torch.full((height * width + 1,), _EMPTY, dtype=torch.int64, device=device)
    chunk = _CHUNK if device.type == "cpu" else max(1, len(points_world))
    for first in range(0, len(points_world), chunk):
        uv_px, z_m = project(points_world[first : first + chunk], camera)
        u, v = uv_px.unbind(1)
        # Comparisons with NaN are false, so non-finite points drop out here too.
        inside = (z_m > NEAR_M) & (u >= 0) & (u < width) & (v >= 0) & (v < height) & (z_m < torch.inf)
        u, v = u.where(inside, 0.0).to(torch.int64), v.where(inside, 0.0).to(torch.int64)
        # What is outside goes to a pixel behind the last: writing it costs less than picking out the others.
        pixel = (v * width + u).masked_fill_(~inside, height * width)
        key = z_m.float().view(torch.int32).to(torch.int64).bitwise_left_shift_(_ID_BITS)
        key |= torch.arange(first, first + len(key), device=device)
        buffer.scatter_reduce_(0, pixel, key, "amin")
    keys = [buffer[:-1].view(height, width)]
    for _ in range(levels - 1):
        keys.append(_min_2x2(keys[-1]))
    return IdPyramid(tuple(_ids(k) for k in keys), tuple(_depths(k) for k in keys))


def _min_2x2(key: torch.Tensor) -> torch.Tensor:
    """Minimum over 2x2 blocks; odd sizes are padded with empty pixels."""
    height, width = key.shape
    key = torch.nn.functional.pad(key, (0, width % 2, 0, height % 2), value=_EMPTY)
    key = torch.minimum(key[0::2], key[1::2])
    return torch.minimum(key[:, 0::2], key[:, 1::2])


def _ids(key: torch.Tensor) -> torch.Tensor:
    return torch.where(key == _EMPTY, -1, key & (2**_ID_BITS - 1))


def _depths(key: torch.Tensor) -> torch.Tensor:
    return (key >> _ID_BITS).to(torch.int32).view(torch.float32)


def gather_descriptors(descriptors: torch.Tensor, ids: torch.Tensor) -> torch.Tensor:
    """Raw image S[t]: the descriptor of each pixel's point, the null descriptor (zero) where there is none.

    Args:
        descriptors: [P, L]; gradients flow to the points that are seen, and only to those.
        ids: [H, W] int64, a level of an `IdPyramid`.

    Returns:
        [L, H, W].
    """
    height, width = ids.shape
    seen = (ids >= 0).flatten().nonzero()[:, 0]
    values = descriptors.index_select(0, ids.flatten()[seen])
    image = descriptors.new_zeros(height * width, descriptors.shape[1]).index_copy(0, seen, values)
    return image.T.reshape(-1, height, width)


def rasterize_ids_reference(points_world: np.ndarray, camera: Camera, levels: int = 1) -> list[np.ndarray]:
    """The same ids by the plainest means: one point after the other, every scale by itself, in float64.

    It is what `rasterize_ids` is tested and benchmarked against.

    Args:
        points_world: [P, 3] metres.
        camera: gives the size of level 0.
        levels: number of scales.

    Returns:
        One [ceil(H / 2^t), ceil(W / 2^t)] int64 array of ids a level, -1 where there is no point.
    """
    sizes = [(camera.height, camera.width)]
    for _ in range(levels - 1):
        sizes.append(((sizes[-1][0] + 1) // 2, (sizes[-1][1] + 1) // 2))
    images = [np.full(size, -1, dtype=np.int64) for size in sizes]
    nearest = [np.full(size, np.inf, dtype=np.float32) for size in sizes]
    for index, point in enumerate(np.asarray(points_world, dtype=np.float64)):
        if not np.isfinite(point).all():
            continue
        x, y, z = camera.cam_from_world[:3, :3] @ point + camera.cam_from_world[:3, 3]
        if z <= NEAR_M:
            continue
        u, v, _ = np.asarray(camera.K) @ np.array([x / z, y / z, 1.0])
        if not (0 <= u < camera.width and 0 <= v < camera.height):
            continue
        for level in range(levels):
            row, column = int(v) >> level, int(u) >> level
            if np.float32(z) < nearest[level][row, column]:
                nearest[level][row, column] = np.float32(z)
                images[level][row, column] = index
    return images
