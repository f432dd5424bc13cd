"""The depth map of one frame, from coarse to fine.

1. At a quarter of the resolution every depth from before the head to infinity is tried (so that the
   background is found to be background), and the costs are regularised semi-globally.
2. At a half and at the full resolution depths about the last map are tried: each hypothesis is the whole map
   moved by a fraction of a pixel of parallax, so windows follow the surface's slant. Regularised the same
   way, refined by a parabola, and smoothed as a thin plate as far as the costs leave it open.

Inverse depths are counted in labels: pixels of parallax in the source that moves most.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch

from capture.cameras import Camera
from relight.head_region import HeadRegion
from relight.stereo.frames import GreyFrames
from relight.stereo.matching import Correlation, Warp, agreement
from relight.stereo.semiglobal import regularised
from relight.stereo.thin_plate import smoothed
from relight.stereo.windows import Window, parallax_px, region_window, transferred

_COARSE_PX = 96  # side of the window at the coarse resolution, at least
_FARTHEST = 50.0  # times the distance of the head: infinity
_FULL_CONFIDENCE = 0.3  # curvature of the cost, per pixel of parallax squared, that counts as usual
_MOST_CONFIDENCE = 4.0
_STIFFNESS = 100.0
_CREASE = 0.5  # label: second differences beyond it are steps of the surface
_EDGE = 0.03  # difference of grey values at which a jump of depth costs half
_SMALLEST_JUMP = 0.25  # of the jump's cost, however strong the edge


@dataclass(frozen=True)
class LevelSettings:
    """One resolution.

    Attributes:
        scale: Relative to the fine one.
        radius: Of the windows, pixels.
        labels: Hypotheses on either side of the last map; 0 = all depths.
        step: Between hypotheses, pixels of parallax.
        noise: Standard deviation of the grey values in a window without contrast.
        difference: Weight of the difference of grey values against the correlation.
        step_penalty: Of neighbours one label apart.
        jump_penalty: Of neighbours further apart.
    """

    scale: float
    radius: int
    labels: int
    step: float
    noise: float
    difference: float
    step_penalty: float
    jump_penalty: float


COARSE = LevelSettings(0.25, 2, 0, 0.7, 0.001, 0.5, 0.1, 2.5)
MIDDLE = LevelSettings(0.5, 2, 7, 0.6, 0.002, 0.5, 0.02, 0.1)
FINE = LevelSettings(1.0, 3, 4, 0.35, 0.003, 0.3, 0.02, 0.1)
AGAIN = LevelSettings(1.0, 3, 4, 0.4, 0.003, 0.3, 0.02, 0.1)


@dataclass(frozen=True, eq=False)
class DepthMap:
    """Depths of a window of a frame.

    Attributes:
        index: The frame.
        camera: Of the resolution of the map, without distortion.
        window: Which pixels of that camera.
        inverse_depth: [h, w], 1 / z.
        weight: [h, w] how well the costs tell it, about 1 where as usual, 0 where not at all.
    """

    index: int
    camera: Camera
    window: Window
    inverse_depth: torch.Tensor
    weight: torch.Tensor


class _Level:
    """One resolution of a reference and its sources."""

    def __init__(
        self,
        frames: GreyFrames,
        index: int,
        gains: Mapping[int, float],
        region: HeadRegion,
        scale: float,
        settings: LevelSettings,
    ) -> None:
        scale *= settings.scale
        self.settings = settings
        self.camera = frames.cameras[index].scaled(scale)
        window = region_window(self.camera, region)
        if window is None:
            raise ValueError(f"frame {index} does not show the region")
        self.window = window
        picture = window.cut(frames.grey(index, scale))
        sources = [frames.cameras[source].scaled(scale) for source in gains]
        self.warps = [Warp(self.camera, source, window, picture.device) for source in sources]
        self.pictures = [frames.grey(source, scale) * gain for source, gain in gains.items()]
        self.correlation = Correlation(picture, settings.radius, settings.noise)
        self.label = 1.0 / max(parallax_px(self.camera, sources, region.centre_world), 1e-9)
        self.jump_penalty = _jump_penalty(picture, settings.jump_penalty)

    def cost(self, inverse_depth: torch.Tensor) -> torch.Tensor:
        """[h, w, D] of inverse depths [D, h, w]."""
        score = agreement(
            self.correlation, self.warps, self.pictures, inverse_depth, self.settings.difference
        )
        return (1.0 - score).permute(1, 2, 0).contiguous()

    def best(self, cost: torch.Tensor, diagonals: bool) -> tuple[torch.Tensor, torch.Tensor]:
        total = regularised(cost, self.settings.step_penalty, self.jump_penalty, diagonals)
        return _parabola(total)


def estimate_depth(
    frames: GreyFrames,
    index: int,
    sources: tuple[Mapping[int, float], Mapping[int, float], Mapping[int, float]],
    region: HeadRegion,
    scale: float,
) -> DepthMap:
    """A frame's depth map from nothing but its sources.

    Args:
        frames: The pictures.
        index: The reference.
        sources: At the three resolutions, frames and the gain of their grey values.
        region: What is looked for.
        scale: Of the fine resolution, relative to the pictures.
    """
    coarse = replace(COARSE, scale=_coarse_scale(frames.cameras[index].scaled(scale), region))
    level = _Level(frames, index, sources[0], region, scale, coarse)
    distance = level.window.distance
    # Farther ones would be before the camera: nearest is what the region begins with.
    nearest = 1.0 / max(distance - region.radius, 0.1 * distance)
    step = COARSE.step * level.label
    device = level.pictures[0].device
    labels = torch.arange(1.0 / (_FARTHEST * distance), nearest + 2.0 * step, step, device=device)
    height, width = level.window.height, level.window.width
    cost = level.cost(labels[:, None, None].expand(-1, height, width))
    place, _ = level.best(cost, diagonals=True)
    inverse_depth, window, camera = labels[0] + place * step, level.window, level.camera
    for settings, others in zip((MIDDLE, FINE), sources[1:], strict=True):
        level = _Level(frames, index, others, region, scale, settings)
        base = transferred(inverse_depth, window, camera, level.window, level.camera)
        inverse_depth, weight = _about(level, base)
        window, camera = level.window, level.camera
    return DepthMap(index, camera, window, inverse_depth, weight)


def _coarse_scale(camera: Camera, region: HeadRegion) -> float:
    """A quarter, or as much more as a small picture needs to keep its pattern."""
    window = region_window(camera, region)
    side = max(window.width, window.height) if window is not None else 1
    return float(min(MIDDLE.scale, max(COARSE.scale, _COARSE_PX / side)))


def estimate_about(
    frames: GreyFrames,
    sources: Mapping[int, float],
    region: HeadRegion,
    scale: float,
    given: DepthMap,
    known: torch.Tensor,
) -> DepthMap:
    """A frame's depth map once more, about what is known of it.

    Args:
        frames: The pictures.
        sources: Frames and the gain of their grey values.
        region: As for `given`.
        scale: As for `given`.
        given: Its inverse depths are a first guess.
        known: [h, w] weight of the guess, 0 where it is to be spanned from what is around.
    """
    level = _Level(frames, given.index, sources, region, scale, AGAIN)
    guess = given.inverse_depth / level.label
    base = smoothed(guess, known + 1e-4, _STIFFNESS, _CREASE, iterations=80) * level.label
    inverse_depth, weight = _about(level, base)
    return DepthMap(given.index, given.camera, given.window, inverse_depth, weight)


def _about(level: _Level, base: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Inverse depths and their weights from hypotheses about a map."""
    settings = level.settings
    offsets = torch.arange(-settings.labels, settings.labels + 1, device=base.device) * settings.step
    cost = level.cost(base[None] + (offsets * level.label)[:, None, None])
    place, curvature = level.best(cost, diagonals=False)
    found = base / level.label + (place - settings.labels) * settings.step
    weight = (curvature / (settings.step**2 * _FULL_CONFIDENCE)).clamp(max=_MOST_CONFIDENCE)
    return smoothed(found, weight, _STIFFNESS, _CREASE) * level.label, weight


def _parabola(cost: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Place of the minimum between the labels [H, W] and the curvature there, of costs [H, W, D].

    A minimum at the first or last label has no curvature: the true one lies beyond.
    """
    best = cost.argmin(dim=2, keepdim=True)
    inner = best.clamp(1, cost.shape[2] - 2)
    low, middle, high = (cost.gather(2, inner + offset)[..., 0] for offset in (-1, 0, 1))
    curvature = (low + high - 2.0 * middle).clamp(min=1e-6)
    shift = (0.5 * (low - high) / curvature).clamp(-0.5, 0.5)
    at_end = (best != inner)[..., 0]
    place = torch.where(at_end, best[..., 0].float(), inner[..., 0] + shift)
    return place, torch.where(at_end, 0.0, curvature)


def _jump_penalty(picture: torch.Tensor, penalty: float) -> torch.Tensor:
    """[H, W], smaller at the edges of the picture."""
    edge = torch.zeros_like(picture)
    edge[:, 1:] = (picture[:, 1:] - picture[:, :-1]).abs()
    edge[1:] = torch.maximum(edge[1:], (picture[1:] - picture[:-1]).abs())
    return penalty * (_EDGE / (_EDGE + edge) + _SMALLEST_JUMP)
