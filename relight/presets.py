"""How a portrait can be fitted: the photometric solve, and what refines it afterwards.

Every preset begins with the solve, for each needs its surface, its carving by the masks and its first guess
of the lights. The module of a refinement is imported when it is asked for.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from importlib import import_module
from typing import Any

from relight.errors import PlanError
from relight.portrait import Portrait
from relight.shape_from_flash import ShapeConfig

Refine = Callable[..., Portrait]
"""refine(scene: Scene, solved: Portrait, *, config, seconds: float | None, face: FacePrior | None,
checkpoint: Path | None, seed: int, progress: Progress) -> Portrait

`config` is what the preset's `make_config` gives. `seconds` is wall-clock time that it may take: it gives the
best it has by then. `checkpoint` is a folder of its own, which may hold what an earlier run of it left from
the same scene and seed; whether that was of the same configuration is for the refinement to tell. The same
seed on the same device gives the same portrait. Sentences for the user go into the portrait's info under
"warnings"."""


@dataclass(frozen=True)
class Preset:
    """Where a preset's parts are, as "module:name".

    Attributes:
        refine: A `Refine`; None = the solve alone.
        make_config: Without arguments gives its configuration, a frozen dataclass whose fields are its
            arguments; None = it has none.
        solve: What its solve does beyond the plain one, arguments of `SolveConfig`.
    """

    refine: str | None = None
    make_config: str | None = None
    solve: Mapping[str, Any] = field(default_factory=dict)

    def load_refine(self) -> Refine | None:
        """The refinement, if there is one."""
        return None if self.refine is None else _loaded(self.refine)

    def config(self, settings: Mapping[str, Any]) -> Any:
        """The configuration with some settings other than usual; None where there is nothing to set.

        Raises:
            PlanError: There is no such setting, and the message lists those that there are; or it is of
                another kind than the usual one.
        """
        usual = None if self.make_config is None else _loaded(self.make_config)()
        known = [] if usual is None else [field.name for field in fields(usual)]
        if unknown := sorted(settings.keys() - set(known)):
            listed = f"it has {', '.join(sorted(known))}" if known else "it has none"
            raise PlanError(f"The preset has no setting {unknown[0]!r}; {listed}.")
        for name, value in settings.items():
            if not _is_like(value, own := getattr(usual, name)):
                raise PlanError(f"The preset's setting {name!r} cannot be {value!r}; usual is {own!r}.")
        return usual if self.make_config is None else _loaded(self.make_config)(**settings)


_REFINED = "relight.neural.refined.refine:refine_solved"
_SHAPED = {"shape": ShapeConfig(), "room_gloss": True, "sharpening": 1}
_CONVERGED = {"shape": ShapeConfig(rounds=4, iterations=30), "room_gloss": True, "sharpening": 2}

PRESETS: dict[str, Preset] = {
    "solve": Preset(),
    "fast": Preset(_REFINED, "relight.neural.refined.config:fast_config", _SHAPED),
    "balanced": Preset(_REFINED, "relight.neural.refined.config:balanced_config", _CONVERGED),
    "paper": Preset("relight.neural.paper.refine:refine_paper", "relight.neural.paper.config:PaperConfig"),
}


def chosen_preset(name: str) -> Preset:
    """The preset of a name.

    Raises:
        PlanError: There is none.
    """
    if name in PRESETS:
        return PRESETS[name]
    raise PlanError(f"There is no preset {name!r}; known are {', '.join(PRESETS)}.")


def _is_like(value: Any, usual: Any) -> bool:
    """Whether a setting is of the kind of the usual one; lists, as JSON has them, are for tuples."""
    if isinstance(usual, tuple):
        return isinstance(value, list | tuple) and all(_is_like(each, usual[0]) for each in value)
    if isinstance(usual, float):
        return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    return type(value) is type(usual)


def _loaded(place: str) -> Any:
    module, _, name = place.partition(":")
    return getattr(import_module(module), name)
