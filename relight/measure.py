"""Whatever renders views of a head, measured against the truth over its validation views.

Pixels count where the true mask is full. Pictures are compared display-referred, sRGB(clip(linear)), peak 1:

    captured   PSNR and SSIM of the view under its own light
    albedo     PSNR after one scale a channel for all views together (least squares, linear); relative error
    normals    mean and median angle, share within 10 degrees
    lights     each: PSNR after one scale a channel for all views together, at the exposure 1 / (99.5th
               percentile of the truth, all views and channels together)
    mask       IoU at 0.5; near the silhouette, where hair is, the mask's error and the outline's F-score

PSNR, SSIM and the measures of masks are means over the views; angles and relative errors are over all pixels.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture.cameras import Camera
from capture.transfer import to_display
from relight.lighting import CapturedLight, Light
from relight.metrics import (
    alpha_error,
    angles_deg,
    channel_scales,
    mask_iou,
    median_relative_error,
    psnr_db,
    silhouette_f_score,
    ssim,
)
from relight.stages import Progress, no_progress, peak_memory_mb
from relight.truth import FULL_COVERAGE, Truth, TruthView

SCHEMA = 1
EXPOSURE_PERCENTILE = 99.5
WITHIN_DEG = 10.0

# What the light of the capture is called when a view is rendered.
CAPTURED = "captured"

Pixels = NDArray[np.floating]
Pair = tuple[Pixels, Pixels]
"""[P, 3] pixels of one view: measured, true."""


@dataclass(frozen=True, eq=False)
class Rendering:
    """What a portrait gives for one view.

    Attributes:
        albedo: [H, W, 3], linear.
        normals_world: [H, W, 3], unit or 0.
        mask: [H, W], 0..1.
        radiance: [H, W, 3], linear, by the name of the light.
    """

    albedo: Pixels
    normals_world: Pixels
    mask: Pixels
    radiance: Mapping[str, Pixels]


Render = Callable[[Camera, dict[str, Light], int | None], Rendering]
"""Renders a view under named lights, with a flash flag."""


def measure(truth: Truth, render: Render, progress: Progress = no_progress) -> dict[str, Any]:
    """Measures whatever renders views against a truth.

    Returns:
        Measures under "captured", "albedo", "normals", "lights" (by name) and "mask", each with the number of
        its "views", absent where nothing could be measured; "missing", sentences that say what and why; and
        "time". Safe for JSON: what is infinite (equal pictures have no error) or does not exist is None.
    """
    scores = _Scores()
    seconds = []
    for done, view in enumerate(truth.views):
        progress("evaluate", done / len(truth.views))
        lights = {name: light for name, light in truth.lights.items() if view.has_light(name)}
        started_s = time.perf_counter()
        rendering = render(view.camera, {CAPTURED: CapturedLight(), **lights}, view.frame.flash)
        seconds.append(time.perf_counter() - started_s)
        scores.add(view, rendering, list(lights))
    progress("evaluate", 1.0)
    result = {
        "schema": SCHEMA,
        "truth": truth.name,
        "views": len(truth.views),
        **scores.measures(),
        "time": {
            "view_s": float(np.median(seconds)),
            "first_view_s": seconds[0],
            "peak_memory_mb": peak_memory_mb(),
        },
        "missing": [*truth.notes, *scores.missing(list(truth.lights))],
    }
    return {key: _json_safe(value) for key, value in result.items()}


class _Scores:
    """What is gathered view by view, and the measures of all of it."""

    def __init__(self) -> None:
        self._captured: dict[str, dict[str, float]] = {}
        self._masks: list[dict[str, float]] = []
        self._angles: list[NDArray[np.float64]] = []
        self._albedo: list[Pair] = []
        self._lights: dict[str, list[Pair]] = {}
        self._without_head: list[str] = []

    def add(self, view: TruthView, rendering: Rendering, lights: Sequence[str]) -> None:
        """Compares one view. Of pictures whose measure needs all views only the head's pixels are kept."""
        mask = view.mask()
        region = None if mask is None else mask >= FULL_COVERAGE / 255
        if mask is None or region is None or not region.any():
            self._without_head.append(view.camera.name)
            return
        self._masks.append(
            {
                "iou": mask_iou(rendering.mask, mask),
                "alpha_error": alpha_error(rendering.mask, mask),
                "silhouette_f": silhouette_f_score(rendering.mask, mask),
            }
        )
        captured = view.captured_srgb()
        if captured is not None and view.frame.flash is not None:
            rendered = to_display(rendering.radiance[CAPTURED])
            self._captured[view.camera.name] = {
                "psnr_db": psnr_db(rendered, captured, region),
                "ssim": ssim(rendered, captured, region),
            }
        if (albedo := view.albedo()) is not None:
            self._albedo.append((rendering.albedo[region], albedo[region]))
        if (normals := view.normals_world()) is not None:
            known = region & (normals != 0).any(axis=-1)
            if known.any():
                self._angles.append(angles_deg(rendering.normals_world[known], normals[known]))
        for name in lights:
            if (radiance := view.radiance(name)) is not None:
                pair = (rendering.radiance[name][region], radiance[region])
                self._lights.setdefault(name, []).append(pair)

    def measures(self) -> dict[str, Any]:
        """The measures of everything added."""
        result: dict[str, Any] = {}
        if self._captured:
            result["captured"] = _means(list(self._captured.values())) | {"by_view": self._captured}
        if self._albedo:
            result["albedo"] = _albedo_measures(self._albedo)
        if self._angles:
            result["normals"] = _normal_measures(self._angles)
        if self._lights:
            result["lights"] = {name: _light_measures(pairs) for name, pairs in self._lights.items()}
        if self._masks:
            result["mask"] = _means(self._masks)
        return result

    def missing(self, lights: Sequence[str]) -> list[str]:
        """Sentences about what could not be measured, given the lights that the truth names."""
        sentences = []
        if self._without_head:
            names = ", ".join(self._without_head[:5]) + (", ..." if len(self._without_head) > 5 else "")
            sentences.append(f"Views without a mask, or in which it is empty, are not measured: {names}.")
        if not self._captured:
            sentences.append("Captured views are not measured: no frame or linear/XXXX.exr has a flash flag.")
        if not self._albedo:
            sentences.append("Albedo is not measured: there is no gt/albedo_XXXX.exr.")
        if not self._angles:
            sentences.append("Normals are not measured: there is no gt/normal_XXXX.exr.")
        sentences += [
            f"The light {name} is not measured: there is no relight/{name}_XXXX.exr."
            for name in lights
            if name not in self._lights
        ]
        return sentences


def _albedo_measures(pairs: Sequence[Pair]) -> dict[str, Any]:
    scales, scaled = _scaled(pairs)
    values, truth = (np.concatenate(side) for side in zip(*scaled, strict=True))
    return {
        "psnr_db": _mean_psnr_db(scaled),
        "median_relative_error": median_relative_error(values, truth),
        "scales": scales.tolist(),
        "views": len(pairs),
    }


def _light_measures(pairs: Sequence[Pair]) -> dict[str, Any]:
    scales, scaled = _scaled(pairs)
    truth = np.concatenate([truth.ravel() for _, truth in pairs])
    bright = float(np.percentile(truth, EXPOSURE_PERCENTILE)) if truth.size else 0.0
    exposure = 1.0 / bright if bright > 0 else 1.0
    return {
        "psnr_db": _mean_psnr_db([(exposure * values, exposure * truth) for values, truth in scaled]),
        "scales": scales.tolist(),
        "exposure": exposure,
        "views": len(pairs),
    }


def _normal_measures(angles: Sequence[NDArray[np.float64]]) -> dict[str, Any]:
    every = np.concatenate(angles)
    return {
        "mean_deg": float(np.mean(every)),
        "median_deg": float(np.median(every)),
        "within_10_deg": float(np.mean(every <= WITHIN_DEG)),
        "views": len(angles),
    }


def _scaled(pairs: Sequence[Pair]) -> tuple[NDArray[np.float64], list[Pair]]:
    """One scale a channel for all views together, and the pairs with it applied."""
    scales = channel_scales(*(np.concatenate(side) for side in zip(*pairs, strict=True)))
    return scales, [(values * scales, truth) for values, truth in pairs]


def _mean_psnr_db(pairs: Sequence[Pair]) -> float:
    """Mean over the views of the PSNR of linear pixels as they are displayed."""
    views = [
        psnr_db(to_display(values), to_display(truth), np.ones(len(truth), bool)) for values, truth in pairs
    ]
    return float(np.mean(views))


def _means(views: Sequence[Mapping[str, float]]) -> dict[str, Any]:
    """The mean of each measure over the views."""
    return {name: float(np.mean([view[name] for view in views])) for name in views[0]} | {"views": len(views)}


def _json_safe(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _json_safe(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_json_safe(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
