"""Some steps of the paper's fit of captures that go wrong: what is learned stays finite, or the fit says why.

The captures are those of the solve; the cloud is the subject's own. Few steps show it: what overflows or
divides by zero does so at once, and a rate that is too high within a few steps of Adam.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from relight.neural.paper.config import PaperConfig
from relight.neural.paper.fitting import PaperFit
from relight.neural.perceptual import laplacian_perceptual
from relight.scene import Scene
from relight.stress import captures
from relight.stress.captures import film
from relight.stress.case import Case, Measured, Stage, at_most, dtype_name
from relight.stress.subject import Subject, arc, portrait

PAPER = Stage(
    "paper's fit", (torch.float32, torch.bfloat16), "weights and losses are float32, or no network learns"
)

_STEPS = 3
_ALL = at_most(0.0)
_CONFIG = PaperConfig(crop=32)


def cases() -> Iterator[Case]:
    """All cases of this module."""
    for stressed, scene in SCENES.items():
        yield Case(PAPER, stressed, partial(_fitted, scene, 600, _CONFIG, _STEPS), _ALL)
    yield Case(PAPER, "one point", partial(_fitted, film, 1, _CONFIG, _STEPS), _ALL)
    for times in (10.0, 1000.0):
        rates = ("rate", "rate_room", "rate_flash", "rate_texture")
        hasty = replace(_CONFIG, **{name: times * getattr(_CONFIG, name) for name in rates})
        fitted = partial(_fitted, film, 600, hasty, 3 * _STEPS)
        yield Case(PAPER, f"rates {times:g} times too high", fitted, _ALL)


SCENES: dict[str, Callable[[], Scene]] = {
    "usual capture": film,
    "black": partial(film, Subject(albedo=0.0)),
    "black jacket": partial(film, Subject(jacket=0.0)),
    "dark room": partial(film, Subject(room=0.0)),
    "flash that clips every pixel": partial(film, Subject(flash=1000.0)),
    "flash a tenth of the room": partial(film, Subject(room=0.5, flash=0.0125)),
    "light times 1e-6": partial(film, Subject(room=2.5e-7, flash=1.1e-7)),
    "light times 1e+4, without a clip": partial(film, Subject(room=2.5e3, flash=1.1e3), clip=np.inf),
    "constant images": partial(captures.of_constant_images, 0.25),
    "NaN, Inf and 1e38 in every frame": partial(captures.with_broken_pixels, (np.nan, np.inf, -np.inf, 1e38)),
    "every pixel NaN": partial(captures.of_constant_images, np.nan),
    "empty masks": captures.with_empty_masks,
    "every frame twice": captures.filmed_twice,
    "one frame with and one without the flash": partial(film, cameras=arc(10)[4:6]),
    "a camera a millimetre from the surface": captures.from_the_skin,
    "a camera that looks away": captures.looking_away,
}
"""What a neural fit has to live through, by name."""


def _fitted(
    scene: Callable[[], Scene], count: int, config: PaperConfig, steps: int, dtype: torch.dtype
) -> Measured:
    """All that was learned, the last terms of the loss, and a view by it.

    The error is the share of steps that were skipped, for they had no finite loss.
    """
    filmed, solved = scene(), portrait(count)
    precise = replace(config, precision=dtype_name(dtype))
    fit = PaperFit(filmed, solved, precise, laplacian_perceptual, None, 0)
    for _ in range(steps):
        terms = fit.advance()
    learned = {name: value for name, value in fit.model.state_dict().items() if value.is_floating_point()}
    maps = fit.decoder().decode(solved, filmed.views[0].camera)
    seen = {name: value for name, value in vars(maps).items() if isinstance(value, Tensor)}
    losses = {f"loss {name}": torch.tensor(value) for name, value in terms.items()}
    return Measured(learned | seen | losses, error=fit.skipped / fit.step)
