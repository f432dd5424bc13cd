"""`--preset fast` and `--preset balanced`: the refinement from beginning to end, within the time it is
given."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from relight.face.prior import FacePrior
from relight.neural.refined.config import RefinedConfig
from relight.neural.refined.fitting import RefinedFit
from relight.neural.stopwatch import Stopwatch
from relight.portrait import Portrait
from relight.scene import Scene
from relight.stages import Progress, no_progress

_SAVE_EVERY_S = 60.0
_FEWEST_STEPS = 20  # fewer teach nothing


def refine_solved(
    scene: Scene,
    solved: Portrait,
    *,
    config: RefinedConfig,
    seconds: float | None = None,
    face: FacePrior | None = None,
    checkpoint: Path | None = None,
    seed: int = 0,
    progress: Progress = no_progress,
    stopwatch: Stopwatch | None = None,
) -> Portrait:
    """Teaches a small network what the solve leaves (a `relight.presets.Refine`).

    It ends when its steps are made, its time is spent, or the held-out frames get no better, and gives the
    state in which these were best: never one in which they are worse than after the solve.

    Args:
        scene: With the frames.
        solved: What is refined.
        config: What can be set.
        seconds: Wall-clock time that it may take.
        face: Not asked for: what is known of the face is in the solve.
        checkpoint: Folder in which the state is kept, and from which an earlier fit goes on.
        seed: Of chance.
        progress: Told ("refine", fraction).
        stopwatch: Instead of `seconds`: another clock, and portraits at marks on the way.

    Returns:
        The portrait with its decoder; the solved one, with a word, where nothing was gained.

    Raises:
        RefineError: The loss is not finite any more, or a checkpoint cannot be read.
    """
    watch = stopwatch or Stopwatch(seconds)
    progress("refine", 0.0)
    fit = RefinedFit(scene, solved, config, seed)
    best = None
    went_on = False
    if checkpoint is not None:
        went_on, best = fit.resume(checkpoint)
    if not went_on:
        fit.check()

    def portrait() -> Portrait:
        return _portrait(fit, solved, best if fit.checks else fit.state(), watch)

    saved_s = time.perf_counter()
    while fit.step < config.steps and watch.left_s > 0 and not _settled(fit, config.patience):
        fit.advance()
        last = fit.step == config.steps
        if fit.checks and (fit.step % config.check_every == 0 or last):
            best = _better(fit, best)
        if checkpoint is not None and time.perf_counter() - saved_s > _SAVE_EVERY_S:
            fit.save(checkpoint, best)
            saved_s = time.perf_counter()
        watch.look(portrait)
        done = fit.step / config.steps
        if watch.limit_s is not None:
            done = max(done, watch.elapsed_s / max(watch.limit_s, 1e-9))
        progress("refine", min(1.0, done))
    if checkpoint is not None:
        fit.save(checkpoint, best)
    # A look out of turn is not kept: a fit that goes on shall be as if it had never been stopped.
    if fit.checks and fit.checks[-1][0] != fit.step and fit.step >= _FEWEST_STEPS:
        best = _better(fit, best)
    progress("refine", 1.0)
    return portrait()


def _better(fit: RefinedFit, best: dict[str, torch.Tensor] | None) -> dict[str, torch.Tensor] | None:
    """The state of now if the held-out frames are better with it than ever, else the best one."""
    lowest = min(loss for _, _, loss in fit.checks)
    found = fit.check()
    return fit.state() if found is not None and found[1] < lowest else best


def _settled(fit: RefinedFit, patience: int) -> bool:
    """Whether the last looks at the held-out frames brought nothing."""
    losses = [loss for _, _, loss in fit.checks]
    return len(losses) > patience and min(losses[-patience:]) >= min(losses[:-patience])


def _portrait(
    fit: RefinedFit, solved: Portrait, state: dict[str, torch.Tensor] | None, watch: Stopwatch
) -> Portrait:
    """The portrait with a state; the solved one where there is none."""
    facts: dict[str, Any] = {
        "steps": fit.step,
        "skipped_steps": fit.skipped,
        "seconds": round(watch.elapsed_s, 1),
        "held_out_frames": [view.index for view in fit.checked],
        "held_out_db": [[step, round(ratio, 3)] for step, ratio, _ in fit.checks],
        "held_out_loss": [[step, round(loss, 6)] for step, _, loss in fit.checks],
    }
    warnings = list(solved.info.get("warnings", ()))
    if fit.step < _FEWEST_STEPS:
        state = None
        warnings.append(
            f"The refinement had no time for {_FEWEST_STEPS} steps, and fewer teach nothing: this is the "
            "photometric solve."
        )
    elif state is None:
        warnings.append(
            "The refinement made frames that it was not fitted to no better: this is the photometric solve."
        )
    elif not fit.checks:
        warnings.append(
            "There are too few lit frames to spare some, so nothing says whether the refinement shows new "
            "views better than the photometric solve."
        )
    if fit.skipped:
        warnings.append(f"{fit.skipped} steps of the refinement had no finite loss and were skipped.")
    info = {**solved.info, "refinement": facts, "warnings": warnings}
    return replace(solved, info=info, decoder=None if state is None else fit.decoder(state))
