"""Metres from a flash whose place beside the lens is known.

How the flash lights a point depends on where it is: the light's direction and distance hold the offset over
the distance, so an offset known in metres tells how long a metre is. What can be seen of it is the offset's
share of the distance, in the part that albedo and flash strength do not explain: with a lamp at the lens
nothing, with one 1.5 cm off hardly anything, with one 10 cm off a few per cent.

Per candidate scale the flash's part of the frames is fitted with one albedo a point and one gain a frame, and
the robust misfit compared. The uncertainty comes from leaving out frames one block after the other: normals
and shadows err alike in neighbouring points, which the misfit's curvature does not know. What errs alike in
all frames is added to it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from relight.cloud import SurfaceCloud
from relight.face.plane import Floats
from relight.observations import observe_points
from relight.scene import Scene
from relight.stages import Progress, no_progress

WIDEST = 4.0
"""The scale is looked for from a quarter of the expected one to four times it."""

_STEPS = 33
_ROUNDS = 6
_BLOCKS = 6
_FEWEST_FRAMES = 4
_LEAST_COSINE = 0.25  # below, normals err too much
_MOST_POINTS = 3000
_VIEW_WIDTH_RAD = 0.15
_ROBUST = 0.08  # relative misfit that still counts in full
_SYSTEMATIC = 0.006  # share of the shading that gloss and normals imitate alike in all frames
_DARK = 0.01  # flash radiance that is lost in noise


@dataclass(frozen=True, eq=False)
class FlashSamples:
    """What the flash adds at P points in K frames.

    Attributes:
        radiance: [K, P], mean of the channels, the room's light taken off.
        weight: [K, P], 0 where the frame does not show the point.
        points: [P, 3], world.
        normals: [P, 3], unit.
        centres_world: [K, 3], cameras.
        world_from_cam: [K, 3, 3], their axes.
    """

    radiance: NDArray[np.float64]
    weight: NDArray[np.float64]
    points: NDArray[np.float64]
    normals: NDArray[np.float64]
    centres_world: NDArray[np.float64]
    world_from_cam: NDArray[np.float64]

    @property
    def albedo(self) -> NDArray[np.float64]:
        """[P] up to one factor: Lambert's, with the flash at the lens; 0 where no frame shows the point."""
        towards = self.centres_world[:, None] - self.points
        square = (towards * towards).sum(axis=-1)
        cosine = (towards * self.normals).sum(axis=-1) / np.sqrt(np.maximum(square, 1e-30))
        weight = self.weight * (cosine > _LEAST_COSINE)
        model = np.maximum(cosine, 0.0) / np.maximum(square, 1e-30)
        found: NDArray[np.float64] = (weight * model * self.radiance).sum(axis=0) / np.maximum(
            (weight * model**2).sum(axis=0), 1e-30
        )
        return np.maximum(found, 0.0)


@dataclass(frozen=True)
class FlashScale:
    """A scale seen in the shading.

    Attributes:
        metres_per_unit: The best one.
        sigma_relative: Its standard error; infinite where the misfit has no minimum within the range.
        offset_share: Length of the offset over the distance to the subject at that scale.
    """

    metres_per_unit: float
    sigma_relative: float
    offset_share: float


def flash_samples(
    scene: Scene, points: Floats, normals: Floats, spacing: float, progress: Progress = no_progress
) -> FlashSamples:
    """Samples the frames of a scene at a few thousand points.

    Args:
        scene: With flash and no-flash frames.
        points: [P, 3] of the surface.
        normals: [P, 3] unit, outwards.
        spacing: Of the points before thinning: what hides what is told from all of them.
        progress: Told ("observe", fraction).
    """
    surface = SurfaceCloud(points.astype(np.float32), normals.astype(np.float32), spacing, 0.0)
    seen = observe_points(scene, surface, progress)
    some = slice(None, None, max(1, len(points) // _MOST_POINTS))
    radiance = seen.radiance[:, some].double().mean(dim=-1).cpu()
    cosine, lit = seen.cosine[:, some].double().cpu(), seen.flash.cpu()
    views = seen.view_direction_world.double().cpu()
    angle = torch.acos((views[lit] @ views[~lit].T).clamp(-1.0, 1.0))
    near = torch.exp(-0.5 * (angle / _VIEW_WIDTH_RAD) ** 2)
    total = near @ (cosine[~lit] > 0).double()
    room = near @ radiance[~lit] / total.clamp(min=1e-9)
    weight = (cosine[lit] * (total > 0.2)).numpy()
    lit_views = [view for view in scene.views if view.flash == 1]
    return FlashSamples(
        radiance=(radiance[lit] - room).numpy() * (weight > 0),
        weight=weight,
        points=np.asarray(points[some], np.float64),
        normals=np.asarray(normals[some], np.float64),
        centres_world=np.stack([view.camera.centre_world for view in lit_views]),
        world_from_cam=np.stack([view.camera.cam_from_world[:3, :3].T for view in lit_views]),
    )


def scale_from_flash(samples: FlashSamples, flash_offset_cam_m: Floats, expected: float) -> FlashScale | None:
    """The scale under which the flash's known offset explains the shading best.

    Args:
        samples: See `flash_samples`.
        flash_offset_cam_m: [3] lens to flash, metres, camera axes.
        expected: Metres per unit about which to search, to a factor of `WIDEST`.

    Returns:
        None where there are too few frames or the offset is zero.
    """
    offset = np.asarray(flash_offset_cam_m, np.float64)
    frames = np.flatnonzero((samples.weight > 0).sum(axis=1) >= 20)
    if len(frames) < _FEWEST_FRAMES or not np.linalg.norm(offset) > 0:
        return None
    logs = np.linspace(-np.log(WIDEST), np.log(WIDEST), _STEPS)
    misfits = np.stack([_misfits(samples, offset / (expected * np.exp(log)), frames) for log in logs])
    best = _minimum(logs, misfits.sum(axis=1))
    if best is None:
        return FlashScale(expected, float("inf"), _share(samples, offset, expected))
    # Frames are left out after the fit: gains and albedos rest on all of them, which moves little.
    block = np.arange(len(frames)) * _BLOCKS // len(frames)
    blocks = np.unique(block)
    without = [_minimum(logs, misfits[:, block != left_out].sum(axis=1)) for left_out in blocks]
    if any(value is None for value in without):
        return FlashScale(
            expected * float(np.exp(best)), float("inf"), _share(samples, offset, expected * np.exp(best))
        )
    values = np.array(without, float)
    sigma = float(np.sqrt((len(blocks) - 1) / len(blocks) * ((values - values.mean()) ** 2).sum()))
    scale = expected * float(np.exp(best))
    share = _share(samples, offset, scale)
    return FlashScale(scale, float(np.hypot(sigma, _SYSTEMATIC / share)), share)


def _misfits(samples: FlashSamples, offset: NDArray[np.float64], frames: NDArray[np.int64]) -> Floats:
    """Robust misfit of each frame [F] with the flash at an offset in world units."""
    flash = samples.centres_world[frames] + samples.world_from_cam[frames] @ offset
    towards = flash[:, None] - samples.points
    square = (towards * towards).sum(axis=-1)
    cosine = (towards * samples.normals).sum(axis=-1) / np.sqrt(np.maximum(square, 1e-30))
    model = np.maximum(cosine, 0.0) / np.maximum(square, 1e-30)
    model /= max(float(np.median(model[model > 0])) if (model > 0).any() else 1.0, 1e-30)
    radiance, weight = samples.radiance[frames], samples.weight[frames] * (cosine > _LEAST_COSINE)
    weight = weight * ((weight > 0).sum(axis=0) >= 3)
    gains, robust = np.ones(len(frames)), weight
    for _ in range(_ROUNDS):
        scaled = gains[:, None] * model
        albedo = (robust * scaled * radiance).sum(axis=0) / np.maximum(
            (robust * scaled**2).sum(axis=0), 1e-12
        )
        shaded = albedo * model
        gains = (robust * shaded * radiance).sum(axis=1) / np.maximum((robust * shaded**2).sum(axis=1), 1e-12)
        gains /= max(float(np.median(gains)), 1e-12)
        relative = (radiance - gains[:, None] * shaded) / (np.abs(gains[:, None] * shaded) + _DARK)
        robust = weight / (1.0 + (relative / _ROBUST) ** 2)
    loss: Floats = (weight * np.log1p((relative / _ROBUST) ** 2)).sum(axis=1)
    return loss


def _minimum(logs: Floats, misfit: Floats) -> float | None:
    """Place of the least misfit by a parabola through the lowest three; None at an end of the range."""
    k = int(np.argmin(misfit))
    if k in (0, len(logs) - 1):
        return None
    left, middle, right = misfit[k - 1 : k + 2]
    bend = left - 2.0 * middle + right
    if not bend > 0:
        return None
    return float(logs[k] + 0.5 * (left - right) / bend * (logs[1] - logs[0]))


def _share(samples: FlashSamples, offset: NDArray[np.float64], scale: float) -> float:
    distance = np.linalg.norm(samples.centres_world - np.median(samples.points, axis=0), axis=1)
    return float(np.linalg.norm(offset) / scale / max(float(np.median(distance)), 1e-12))
