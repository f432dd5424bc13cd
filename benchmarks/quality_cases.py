"""The fits that `benchmarks.quality_fit` runs and measures."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from relight.cloud import CloudConfig
from relight.photometric import SolveConfig
from relight.presets import chosen_preset

MARKS_S = (10.0, 30.0, 60.0, 120.0, 300.0, 600.0)
PAPER_MARKS_S = (60.0, 300.0, 600.0, 1500.0, 2400.0, 3600.0)
SKIP_STEPS = 100


@dataclass(frozen=True)
class Case:
    """One fit.

    Attributes:
        name: In the record.
        preset: What it is a variant of.
        solve: Arguments of `SolveConfig` that are not the preset's.
        settings: Of the refinement; None = the solve alone.
        marks_s: When portraits are kept on the way, of the whole fit.
        limit_s: When it ends, of the whole fit.
        budget_s: What the plan is told that the fit may take.
        every: Of the lit frames and of the unlit ones, one of so many.
        smaller: By how much the pictures' sides are.
        skip: Of the fit, which is turned off.
    """

    name: str
    preset: str = "fast"
    solve: Mapping[str, Any] = field(default_factory=dict)
    settings: Mapping[str, Any] | None = field(default_factory=dict)
    marks_s: tuple[float, ...] = ()
    limit_s: float | None = None
    budget_s: float | None = None
    every: int = 1
    smaller: int = 1
    skip: str = ""

    @property
    def solve_config(self) -> SolveConfig:
        return SolveConfig(**{**chosen_preset(self.preset).solve, **self.solve})

    @property
    def solved(self) -> str:
        """Name of its solve, the same for cases that share one."""
        said = repr((self.solve_config, self.budget_s, self.every, self.smaller))
        return hashlib.sha256(said.encode()).hexdigest()[:12]


CASES: dict[str, tuple[Case, ...]] = {
    "curve": (
        Case("solve", "solve", settings=None),
        Case("solve in 10 s", "solve", settings=None, budget_s=10.0),
        Case("fast", marks_s=MARKS_S),
        Case("balanced", "balanced", marks_s=MARKS_S, limit_s=610.0),
    ),
    "paper": (
        Case(
            "paper",
            "paper",
            settings={"crop": 256, "precision": "bfloat16", "validate_every": 500},
            marks_s=PAPER_MARKS_S,
            limit_s=3600.0,
        ),
    ),
    "ablations": (
        Case("fast"),
        Case("without the network", settings=None),
        Case("without the shape from the flash", solve={"shape": None}),
        Case("without bounces", solve={"bounces": False}),
        Case("without the room's gloss", solve={"room_gloss": False}),
        Case("without sharpening", solve={"sharpening": 0}),
        Case("without descriptors", settings={"descriptors": 0}),
        Case("float32", settings={"precision": "float32"}),
        Case("half of the frames", every=2),
        Case("half the resolution", smaller=2),
        Case("a quarter of the points", solve={"cloud": CloudConfig(max_points=100_000)}),
        Case("without exposures", settings={"exposures": False}),
        Case("patches of 192 pixels", settings={"patch": 192}),
    ),
    "skips": (
        Case("as it is", settings={"steps": SKIP_STEPS}),
        Case("maps splatted at every step", settings={"steps": SKIP_STEPS}, skip="kept maps"),
        Case(
            "ids of every scale rasterised at every step", settings={"steps": SKIP_STEPS}, skip="strided ids"
        ),
        Case("frames chosen evenly", settings={"steps": SKIP_STEPS}, skip="choice by error"),
    ),
}
