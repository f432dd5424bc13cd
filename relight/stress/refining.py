"""Some steps of the refinement (`fast`, `balanced`) of captures that go wrong, as of the paper's fit."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from relight.neural.refined.config import RefinedConfig
from relight.neural.refined.fitting import RefinedFit
from relight.scene import Scene
from relight.stress.captures import film
from relight.stress.case import Case, Measured, Stage, at_most, dtype_name
from relight.stress.subject import portrait
from relight.stress.training import PAPER, SCENES

REFINED = Stage("refined fit", PAPER.dtypes, PAPER.note)

_STEPS = 3
_ALL = at_most(0.0)
_CONFIG = RefinedConfig(patch=32)


def cases() -> Iterator[Case]:
    """All cases of this module."""
    for stressed, scene in SCENES.items():
        yield Case(REFINED, stressed, partial(_fitted, scene, 600, _CONFIG, _STEPS), _ALL)
    yield Case(REFINED, "one point", partial(_fitted, film, 1, _CONFIG, _STEPS), _ALL)
    # At a thousandfold the changes themselves overflow: such steps are skipped, what is learned stays finite.
    for times, bound in ((10.0, _ALL), (1000.0, None)):
        hasty = replace(_CONFIG, rate=times * _CONFIG.rate, descriptor_rate=times * _CONFIG.descriptor_rate)
        fitted = partial(_fitted, film, 600, hasty, 3 * _STEPS)
        yield Case(REFINED, f"rates {times:g} times too high", fitted, bound)


def _fitted(
    scene: Callable[[], Scene], count: int, config: RefinedConfig, steps: int, dtype: torch.dtype
) -> Measured:
    """All that was learned, and a view by it.

    The error is the share of steps that were skipped, for they had no finite loss.
    """
    filmed, solved = scene(), portrait(count)
    fit = RefinedFit(filmed, solved, replace(config, precision=dtype_name(dtype)), 0)
    for _ in range(steps):
        fit.advance()
    learned = fit.state()
    maps = fit.decoder(learned).decode(solved, filmed.views[0].camera)
    seen = {name: value for name, value in vars(maps).items() if isinstance(value, Tensor)}
    return Measured(learned | seen, error=fit.skipped / fit.step)
