"""`--preset paper`: the paper's fit from beginning to end, within the time that it is given."""

from __future__ import annotations

import logging
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from relight.face.prior import FacePrior
from relight.neural.losses.mismatch import Perceptual
from relight.neural.paper.baking import baked
from relight.neural.paper.config import PaperConfig
from relight.neural.paper.fitting import PaperFit
from relight.neural.perceptual import VggPerceptual, laplacian_perceptual
from relight.neural.precision import products_in
from relight.neural.stopwatch import Stopwatch
from relight.neural.vgg import load_vgg16
from relight.portrait import Portrait
from relight.scene import Scene, View
from relight.stages import Progress, no_progress

log = logging.getLogger(__name__)

_SAVE_EVERY_S = 60.0
_LOST_DB = 3.0  # that held-out frames may fall from their best: patches make them waver by less
_WITHOUT_VGG = (
    "VGG-16's weights were not given (--vgg FILE): pictures are compared by bands of a Laplacian pyramid "
    "instead, which is not the paper's measure."
)
_WITHOUT_FACE = (
    "No face is known: the paper's losses of symmetry, colour and normals of the face are left out."
)


def refine_paper(
    scene: Scene,
    solved: Portrait,
    *,
    config: PaperConfig,
    seconds: float | None = None,
    face: FacePrior | None = None,
    checkpoint: Path | None = None,
    seed: int = 0,
    progress: Progress = no_progress,
    stopwatch: Stopwatch | None = None,
) -> Portrait:
    """Fits the paper's network to a scene (a `relight.presets.Refine`).

    Args:
        scene: With the frames.
        solved: From the photometric solve; gives the points.
        config: What can be set.
        seconds: Wall-clock time that it may take.
        face: What is known of the face.
        checkpoint: Folder in which the state is kept, and from which an earlier fit goes on.
        seed: Of chance.
        progress: Told ("paper", fraction).
        stopwatch: Instead of `seconds`: another clock, and portraits at marks on the way.

    Returns:
        The portrait with its decoder; the solved one, with a word, where there was no time for a step.

    Raises:
        RefineError: The weights of VGG-16 cannot be read, or the loss is not finite any more.
    """
    watch = stopwatch or Stopwatch(seconds)
    progress("paper", 0.0)
    said = []
    if not config.vgg:
        said.append(_WITHOUT_VGG)
    if face is None:
        said.append(_WITHOUT_FACE)
    for sentence in said:
        log.info(sentence)
    fit = PaperFit(scene, solved, config, _perceptual(config, scene.device), face, seed)
    if checkpoint is not None:
        fit.resume(checkpoint)
    first_step = fit.step

    def portrait() -> Portrait:
        return _portrait(fit, solved, watch, said)

    view_s = _seconds_a_view(fit, solved)
    bake_s = view_s * min(config.baked_views, len(fit.fitted))
    saved_s = time.perf_counter()
    while fit.step < config.steps and watch.left_s > bake_s:
        fit.advance()
        if fit.step % config.validate_every == 0:
            fit.look_at_held_out()
        if checkpoint is not None and time.perf_counter() - saved_s > _SAVE_EVERY_S:
            fit.save(checkpoint)
            saved_s = time.perf_counter()
        watch.look(portrait)
        done = fit.step / config.steps
        if watch.limit_s is not None:
            done = max(done, watch.elapsed_s / max(watch.limit_s, 1e-9))
        progress("paper", min(1.0, done))
    if fit.step == 0:
        return _with_word(
            solved, "There was no time for a step of the paper's fit: this is the photometric solve."
        )
    if not fit.held_out_db or fit.held_out_db[-1][0] != fit.step:
        fit.look_at_held_out()
    if checkpoint is not None and fit.step > first_step:
        fit.save(checkpoint)
    progress("paper", 1.0)
    return portrait()


def _perceptual(config: PaperConfig, device: torch.device) -> Perceptual:
    if not config.vgg:
        return laplacian_perceptual
    network = VggPerceptual(load_vgg16(Path(config.vgg))).to(device)
    network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def vgg(picture: torch.Tensor, reference: torch.Tensor) -> torch.Tensor:
        with products_in(config.precision, device):
            difference: torch.Tensor = network(picture, reference)
        return difference.float()

    return vgg


def _seconds_a_view(fit: PaperFit, solved: Portrait) -> float:
    """What the network takes for a whole frame: the points get their values from several."""
    started_s = time.perf_counter()
    fit.decoder().neural_maps(solved.points, fit.fitted[0].camera)
    return 1.5 * (time.perf_counter() - started_s)


def _portrait(fit: PaperFit, solved: Portrait, watch: Stopwatch, said: list[str]) -> Portrait:
    """The portrait as the fit has it now."""
    c_room, c_flash = fit.colours()
    portrait = baked(solved, fit.decoder(), c_room, c_flash, _spread(fit.fitted, fit.config.baked_views))
    facts: dict[str, Any] = {
        "steps": fit.step,
        "skipped_steps": fit.skipped,
        "shortened_gradients": fit.shortened,
        "seconds": round(watch.elapsed_s, 1),
        "perceptual": "VGG-16" if fit.config.vgg else "weight-free",
        "held_out_frames": [view.index for view in fit.checked],
        "held_out_db": [[step, round(ratio, 3)] for step, ratio in fit.held_out_db],
    }
    warnings = [*solved.info.get("warnings", ()), *said]
    if fit.step < fit.config.steps:
        warnings.append(
            f"The paper's fit was ended by its time, after {fit.step} of {fit.config.steps} steps."
        )
    best_step, best_db = max(fit.held_out_db, key=lambda look: look[1], default=(0, 0.0))
    if fit.held_out_db and fit.held_out_db[-1][1] < best_db - _LOST_DB:
        warnings.append(
            f"The paper's fit lost what it had: frames that it was not fitted to had {best_db:.1f} dB after "
            f"{best_step} steps and have {fit.held_out_db[-1][1]:.1f} dB now; fit with a lower rate."
        )
    if fit.skipped:
        warnings.append(f"{fit.skipped} steps of the paper's fit had no finite loss and were skipped.")
    return replace(portrait, info={**solved.info, "refinement": facts, "warnings": warnings})


def _with_word(portrait: Portrait, sentence: str) -> Portrait:
    warnings = [*portrait.info.get("warnings", ()), sentence]
    return replace(portrait, info={**portrait.info, "warnings": warnings})


def _spread(views: tuple[View, ...], most: int) -> tuple[View, ...]:
    """At most so many of the views, evenly over the capture."""
    count = min(most, len(views))
    return tuple(views[int((k + 0.5) * len(views) / count)] for k in range(count))
