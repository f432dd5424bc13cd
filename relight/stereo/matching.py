"""How well pictures agree when one is warped into the other by a depth map.

A pixel p = (u, v, 1) of the reference at inverse depth r (1/z, reference camera) is seen by a source at

    x ~ A p + r b,    A = K_s R K_r^-1,    b = K_s t,

with R, t from reference to source camera axes. Agreement is the zero-mean normalised cross-correlation over
square windows of the warped pictures: a hypothesis is a whole map of inverse depths, so a window follows the
slant of the surface as far as the map does.
"""

from __future__ import annotations

import torch

from capture.cameras import Camera
from relight.stereo.windows import Window, relative_projection

_DIFFERENCE = 0.03  # of encoded radiance: a sixth of the radiance, more than the light of a room changes
_CHOICE = 0.3  # of correlation: sources that agree worse than the best ones by more are taken for hidden


class Warp:
    """Where pixels of a window of the reference picture lie in a source, as a function of inverse depth."""

    def __init__(self, reference: Camera, source: Camera, window: Window, device: torch.device) -> None:
        """Prepares a pair.

        Args:
            reference: Without distortion.
            source: Without distortion.
            window: In pixels of the reference.
            device: Where to compute.
        """
        self.source = source
        A, b = relative_projection(reference, source)
        u = torch.arange(window.width, dtype=torch.float64) + window.left + 0.5
        v = torch.arange(window.height, dtype=torch.float64)[:, None] + window.top + 0.5
        rows = [A[i, 0] * u + A[i, 1] * v + A[i, 2] for i in range(3)]
        # Scaled to grid_sample's range -1..1 here, once for all depths.
        sides = (2.0 / source.width, 2.0 / source.height)
        self._base = [
            (rows[0] * sides[0] - rows[2]).float().to(device),
            (rows[1] * sides[1] - rows[2]).float().to(device),
            rows[2].float().to(device),
        ]
        self._shift = [
            float(b[0] * sides[0] - b[2]),
            float(b[1] * sides[1] - b[2]),
            float(b[2]),
        ]

    def grid(self, inverse_depth: torch.Tensor) -> torch.Tensor:
        """[..., H, W, 2] for grid_sample, from inverse depths [..., H, W]; far outside behind the source."""
        x, y, z = (base + inverse_depth * shift for base, shift in zip(self._base, self._shift, strict=True))
        scale = torch.where(z > 0, 1.0 / z, torch.full_like(z, 1e6))
        return torch.stack([x * scale, y * scale], dim=-1)

    def sample(self, picture: torch.Tensor, inverse_depth: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """The source's picture [H, W] at inverse depths [D, h, w]: values [D, h, w], and whether inside."""
        grid = self.grid(inverse_depth)
        depths, height, width = inverse_depth.shape
        values = torch.nn.functional.grid_sample(
            picture[None, None],
            grid.view(1, depths * height, width, 2),
            mode="bilinear",
            padding_mode="border",
            align_corners=False,
        ).view(depths, height, width)
        inside = (grid.abs() <= 1.0).all(dim=-1)
        return values, inside


def box_mean(values: torch.Tensor, radius: int) -> torch.Tensor:
    """Means over (2 radius + 1)^2 windows of [..., H, W]; the border is repeated outwards."""
    if radius < 1:
        return values
    padded = torch.nn.functional.pad(values, (radius, radius, radius, radius), mode="replicate")
    size = 2 * radius + 1
    return _running_sum(_running_sum(padded, size, -1), size, -2) / (size * size)


def _running_sum(values: torch.Tensor, size: int, dim: int) -> torch.Tensor:
    """Sums of `size` neighbours by doubling: few passes, and no cancellation as a cumulative sum has."""
    length = values.shape[dim] - size + 1
    power, partial = 1, values
    total: torch.Tensor | None = None
    done = 0
    while True:
        if size & power:
            piece = partial.narrow(dim, done, length)
            total = piece if total is None else total + piece
            done += power
        power *= 2
        if power > size:
            break
        reach = partial.shape[dim] - power // 2
        partial = partial.narrow(dim, 0, reach) + partial.narrow(dim, power // 2, reach)
    assert total is not None
    return total


class Correlation:
    """Normalised cross-correlation with a fixed reference picture."""

    def __init__(self, reference: torch.Tensor, radius: int, noise: float) -> None:
        """Prepares the reference [H, W].

        Args:
            reference: [H, W] grey values.
            radius: Windows have 2 radius + 1 pixels a side.
            noise: Standard deviation of the grey values in a window that counts as none: windows with less
                contrast agree with everything alike.
        """
        self._radius = radius
        self._noise = noise * noise
        self._values = reference - box_mean(reference[None], radius)[0]  # small numbers: no cancellation
        self._mean = box_mean(self._values[None], radius)[0]
        variance = (box_mean((self._values**2)[None], radius)[0] - self._mean**2).clamp(min=0.0)
        self._deviation = (variance + self._noise).sqrt()
        self._offset = reference - self._values
        self._reference = reference

    def __call__(self, warped: torch.Tensor) -> torch.Tensor:
        """[D, H, W] correlation -1..1 of warped sources [D, H, W], towards 0 where contrast is noise."""
        values = warped - self._offset
        mean = box_mean(values, self._radius)
        variance = (box_mean(values * values, self._radius) - mean * mean).clamp_(min=0.0)
        covariance = box_mean(values * self._values, self._radius) - mean * self._mean
        return covariance / ((variance + self._noise).sqrt() * self._deviation)

    def difference(self, warped: torch.Tensor) -> torch.Tensor:
        """[D, H, W] 0..1, truncated difference of the grey values over 3 x 3 pixels."""
        return (box_mean(warped - self._reference, 1).abs() / _DIFFERENCE).clamp(max=1.0)


def agreement(
    correlation: Correlation,
    warps: list[Warp],
    pictures: list[torch.Tensor],
    inverse_depth: torch.Tensor,
    difference_weight: float = 0.5,
) -> torch.Tensor:
    """How well the sources agree with the reference at inverse depths [D, h, w], mostly those that agree
    best.

    Sources are weighted by exp(score / choice), so one in which the point is hidden or glossy hardly
    counts: the smooth form of the mean over the best half. Without any source it is -1.
    """
    weighted = torch.zeros_like(inverse_depth)
    total = torch.full_like(inverse_depth, 1e-6)
    for warp, picture in zip(warps, pictures, strict=True):
        values, inside = warp.sample(picture, inverse_depth)
        score = correlation(values)
        if difference_weight:
            score -= difference_weight * correlation.difference(values)
        weight = torch.exp(score / _CHOICE) * inside
        weighted += weight * score
        total += weight
    return torch.where(total > 1e-5, weighted / total, -1.0)
