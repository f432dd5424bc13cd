"""How well a calibration knows the lens: covariance of its parameters, and what that means in pixels.

The noise of the corners is estimated from the residuals. Where the residuals of one picture hang together (a
bent board, a moving one, a lens that the model cannot follow), as many corners know less than their number
says: the pictures then pull on the lens more differently than independent corners would. Where they clearly
do, the covariance is that of the pulls (clustered by picture, unbiased for few: Bell & McCaffrey 2002, CR2).

How far a projected pixel may be off depends on what holds the camera in place. Here it is the boards
themselves (mrcal's "mean-pcam"): a point is carried along by the mean of what a change of the lens does to
all boards' poses. So a shift of the centre that a turn of the camera undoes is no error, and a point as far
away as the boards were is known best.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student_t

from calib.errors import IntrinsicsError
from calib.lens.bundle import SHARED_SIZE, Normals, Observations, Solution, normals_at
from calib.lens.projection import LENS_SIZE, project_with_slopes, rays_of

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Uncertainty of a solution.

    Attributes:
        covariance: [11, 11] of the shared parameters; zero for those that were not sought.
        noise_px: standard deviation of a corner's coordinate, weighted mean over the views.
        view_noise_px: [V] of each view.
        correlation_factor: by how much variances grew on average because the residuals of a picture hang
            together; at least 1.
        mean_motion: [6, 11] mean turn and shift of the boards (about the camera) by a change of the shared
            parameters.
        mean_motion_noise: [6, 6] covariance of what the corners' noise adds to it.
    """

    covariance: Floats
    noise_px: float
    view_noise_px: Floats
    correlation_factor: float
    mean_motion: Floats
    mean_motion_noise: Floats

    def scaled(self, factor: float) -> Uncertainty:
        """All covariances times a factor."""
        return Uncertainty(
            self.covariance * factor,
            self.noise_px,
            self.view_noise_px,
            self.correlation_factor * factor,
            self.mean_motion,
            self.mean_motion_noise * factor,
        )


def uncertainty_of(observations: Observations, solution: Solution, free: Sequence[int]) -> Uncertainty:
    """Covariances at the minimum of the least squares.

    Raises:
        IntrinsicsError: the views leave a parameter open.
    """
    normals = normals_at(observations, solution, free)
    try:
        pose_inverse = np.linalg.inv(normals.poses)
        by_pose = normals.mixed @ pose_inverse
        view_information = normals.view_shared - by_pose @ np.swapaxes(normals.mixed, 1, 2)
        information = view_information.sum(0)
        scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-300))
        if np.linalg.cond(information * np.outer(scale, scale)) > 1e14:
            raise np.linalg.LinAlgError
        inverse = np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale)
    except np.linalg.LinAlgError as cause:
        raise IntrinsicsError(
            "The pictures leave the focal length, the centre or the distortion open; show the board in more "
            "places and at more tilts (30 to 45 degrees, to all sides)."
        ) from cause
    views = len(observations.pixels)
    freedom = int(2 * observations.seen.sum()) - 6 * views - len(free)
    if freedom < 1:
        raise IntrinsicsError(
            f"{int(observations.seen.sum())} corners in {views} pictures are too few to tell anything."
        )
    variance = solution.cost / freedom
    factor, spread = _clustered(normals, by_pose, view_information, information, variance)
    covariance = np.zeros((SHARED_SIZE, SHARED_SIZE))
    covariance[np.ix_(free, free)] = inverse * variance if spread is None else spread
    motions = _about_camera(solution)
    mean_motion = np.zeros((6, SHARED_SIZE))
    mean_motion[:, list(free)] = -(motions @ np.swapaxes(by_pose, 1, 2)).mean(0)
    motion_noise = (motions @ pose_inverse @ np.swapaxes(motions, 1, 2)).sum(0) / views**2
    counts = np.maximum(observations.seen.sum(1), 1)
    view_noise = np.sqrt((solution.residuals**2).sum((1, 2)) / (2 * counts) * _spent(observations, free))
    return Uncertainty(
        covariance=covariance,
        noise_px=float(np.sqrt((view_noise**2 * counts).sum() / counts.sum())),
        view_noise_px=view_noise,
        correlation_factor=factor,
        mean_motion=mean_motion,
        mean_motion_noise=motion_noise * variance * factor,
    )


def projection_sigma(
    lens: Floats, uncertainty: Uncertainty, pixels: Floats, distance_m: float
) -> tuple[Floats, Floats]:
    """How far projected pixels may be off.

    Args:
        lens: [9].
        uncertainty: of it.
        pixels: [n, 2] where in the picture.
        distance_m: from the camera, along the ray.

    Returns:
        [n] standard deviation in the direction in which it is largest, pixels, and [n, 2, 2] the whole
        covariance; NaN where the lens model has no ray.
    """
    rays = rays_of(lens, pixels)
    points = rays / np.linalg.norm(rays, axis=-1, keepdims=True) * distance_m
    _, by_lens, by_point = project_with_slopes(lens, np.nan_to_num(points, nan=1.0))
    carried = by_point @ np.concatenate(
        [-_cross_matrices(np.nan_to_num(points, nan=1.0)), np.broadcast_to(np.eye(3), (len(points), 3, 3))],
        axis=-1,
    )
    by_shared = carried @ uncertainty.mean_motion
    by_shared[..., :LENS_SIZE] += by_lens
    covariance = by_shared @ uncertainty.covariance @ np.swapaxes(by_shared, 1, 2)
    covariance += carried @ uncertainty.mean_motion_noise @ np.swapaxes(carried, 1, 2)
    covariance[np.isnan(rays).any(-1)] = np.nan
    sigma = np.full(len(pixels), np.nan)
    known = np.isfinite(covariance).all((1, 2))
    sigma[known] = np.sqrt(np.maximum(np.linalg.eigvalsh(covariance[known])[:, -1], 0.0))
    return sigma, covariance


def pixel_grid(size: tuple[int, int], columns: int = 32) -> tuple[Floats, tuple[int, int]]:
    """[n, 2] middles of nearly square parts of a picture, row by row, and their number (columns, rows)."""
    width, height = size
    rows = max(2, round(columns * height / width))
    x, y = np.meshgrid((np.arange(columns) + 0.5) * width / columns, (np.arange(rows) + 0.5) * height / rows)
    return np.stack([x.ravel(), y.ravel()], axis=-1), (columns, rows)


def _clustered(
    normals: Normals, by_pose: Floats, view_information: Floats, information: Floats, variance: float
) -> tuple[float, Floats | None]:
    """Whether the residuals of a picture hang together, and the covariance if they do.

    The spread of the views' pulls on the shared parameters is compared with that of independent corners.

    Returns:
        Their ratio, with independent corners 1 on average; it is 1 unless it is clearly above. And the
        covariance by the spread of the pulls, None where the ratio is 1; in no direction is it less than the
        ratio times that of independent corners (a few views tell each direction's spread only roughly).
    """
    pulls = normals.view_slopes - (by_pose @ normals.pose_slopes[..., None])[..., 0]
    values, vectors = np.linalg.eigh(information)
    if values.min() <= 0:
        return 1.0, None
    white = vectors / np.sqrt(values)  # information becomes the unit matrix
    spread = np.zeros_like(information)
    scatter = 0.0
    for pull, own in zip(pulls, view_information, strict=True):
        shares, axes = np.linalg.eigh(white.T @ own @ white)
        # A view's residuals are smaller than its noise by its own share of the information (CR2).
        rest = np.clip(1.0 - shares, 0.02, 1.0)
        whitened = axes @ ((axes.T @ (white.T @ pull)) / np.sqrt(rest))
        spread += np.outer(whitened, whitened)
        scatter += 2.0 * float((shares**2).sum())
    ratio = float(np.trace(spread)) / (len(information) * variance)
    if ratio <= 1.0 + 2.0 * np.sqrt(scatter) / len(information):
        return 1.0, None
    # The spread is known from few views only: Student's 95 % interval, drawn as that of a wider normal. Its
    # freedom is between that of one direction (scatter) and that of the ratio, which all directions share.
    freedom = max(4.0 * len(information) / scatter - 1.0, 2.0)
    student = float((student_t.ppf(0.975, freedom) / 1.95996) ** 2)
    sizes, directions = np.linalg.eigh(spread)
    root = white @ directions * np.sqrt(student * np.maximum(sizes, ratio * variance))
    return student * ratio, root @ root.T


def _about_camera(solution: Solution) -> Floats:
    """[V, 6, 6] from a pose's turn about the board's middle and shift to turn and shift about the camera."""
    motions = np.tile(np.eye(6), (len(solution.translations_m), 1, 1))
    motions[:, 3:, :3] = _cross_matrices(solution.translations_m)
    return motions


def _cross_matrices(vectors: Floats) -> Floats:
    """[n, 3, 3] matrices that take the cross product with vectors [n, 3] from the left."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack(
        [np.stack([zero, -z, y], -1), np.stack([z, zero, -x], -1), np.stack([-y, x, zero], -1)], axis=-2
    )


def _spent(observations: Observations, free: Sequence[int]) -> float:
    """How much larger the noise is than the residuals, as a ratio of variances."""
    count = 2 * int(observations.seen.sum())
    return count / max(count - 6 * len(observations.pixels) - len(free), 1)
