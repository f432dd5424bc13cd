"""Whether a portrait shows what its own frames show: the last guard against geometry wrong in silence."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from capture.transfer import to_display
from relight.lighting import CapturedLight
from relight.metrics import psnr_db
from relight.portrait import Portrait
from relight.render import PortraitRenderer
from relight.scene import Scene, View

VIEWS = 6
"""Frames that are rendered again, lit and unlit ones spread over the path."""


@dataclass(frozen=True)
class SelfCheck:
    """How well a portrait gives its own frames back.

    Attributes:
        psnr_db: Median over the frames, of display values where both portrait and pixels can be trusted.
        covered: Median share of the given or found mask that the portrait covers; 1 without masks.
    """

    psnr_db: float
    covered: float


def check_portrait(portrait: Portrait, scene: Scene) -> SelfCheck:
    """Renders some of a scene's frames and compares.

    Returns:
        The check; -inf dB where no frame shows the portrait at all.
    """
    renderer = PortraitRenderer(portrait, shadows=False)
    ratios, covered = [], []
    for view in _spread(scene.views):
        observation = scene.observe(view)
        maps, radiances = renderer.view(view.camera, {"captured": CapturedLight()}, view.flash)
        shown = maps.mask > 0.5
        if observation.mask is not None:
            subject = observation.mask > 0.5
            covered.append(float((shown & subject).sum() / subject.sum().clamp(min=1)))
            shown = shown & subject
        region = (shown & (observation.valid > 0.99)).cpu().numpy()
        if not region.any():
            ratios.append(-np.inf)
            continue
        rendered, seen = (
            to_display(np.clip(values.cpu().numpy(), 0.0, 1.0))
            for values in (radiances["captured"], observation.radiance)
        )
        ratios.append(float(psnr_db(rendered, seen, region)))
    return SelfCheck(float(np.median(ratios)), float(np.median(covered)) if covered else 1.0)


def _spread(views: tuple[View, ...]) -> list[View]:
    chosen = []
    for flash in (1, 0):
        kind = [view for view in views if view.flash == flash]
        picks = np.unique(np.linspace(0, len(kind) - 1, min(VIEWS // 2, len(kind))).round().astype(int))
        chosen += [kind[pick] for pick in picks]
    return chosen
