"""From a session to a portrait: plan, scene, solve, pictures, report; each step a function of its own module.

portraits/NAME/portrait.safetensors, portrait.json   the portrait
               config.json                           the resolved configuration of the solve
               plan.json                             what ran, what was skipped, and why
               metrics.json                          seconds a stage, peak memory, versions
               previews/                             pictures
               report.html                           all of it, in one file
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch

from capture.atomic import atomic_write
from capture.session import Session
from relight.devices import choose_device, describe_device
from relight.errors import PlanError
from relight.photometric import SolveConfig, solve
from relight.plan import Action, Plan
from relight.planning import make_plan
from relight.portrait import Portrait
from relight.previews import write_previews
from relight.report import write_report
from relight.scene import load_scene
from relight.stages import Progress, Stages, memory_summary, no_progress
from relight.version import installed_version

PRESETS = ("solve",)
PRESETS_TO_COME = ("fast", "balanced", "paper")

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,79}")


def fit(
    session: Path,
    preset: str = "solve",
    *,
    device: str | None = None,
    max_seconds: float | None = None,
    name: str | None = None,
    forced: Mapping[str, Action] | None = None,
    progress: Progress = no_progress,
) -> Path:
    """Fits a portrait and writes everything that belongs to it.

    Args:
        session: The session's folder.
        preset: One of `PRESETS`.
        device: "cpu" or "cuda"; by default the card where there is one.
        max_seconds: Time that the fit should end within; the plan leaves frames out until it does.
        name: What to call the portrait; its preset's name by default. One of that name is replaced.
        forced: Decisions of the plan to turn round.
        progress: Told (stage, fraction).

    Returns:
        The portrait's folder.

    Raises:
        PlanError: The session cannot be fitted, or an argument is not one of those known.
    """
    _check_preset(preset)
    torch_device = choose_device(device)
    name = preset if name is None else name
    if not _NAME.fullmatch(name):
        raise PlanError(f"A portrait cannot be called {name!r}; use letters, digits, '_', '-' and '.'.")
    opened = Session.open(session)
    stages = Stages()
    with stages.stage("plan"):
        plan = make_plan(opened, forced, max_seconds)
    plan.check()
    config = SolveConfig()
    with stages.follow(progress) as told:
        scene = load_scene(
            opened,
            frames=plan.frames,
            undistort=plan.runs("undistortion"),
            device=torch_device,
            progress=told,
        )
        portrait = solve(scene, config, told)

    folder = opened.portraits_dir / name
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "evaluation.json").unlink(missing_ok=True)  # it measured the portrait that is replaced now
    with stages.stage("save"):
        portrait.save(folder)
        _write_json(folder / "config.json", {"preset": preset, "solve": asdict(config)})
        _write_json(folder / "plan.json", plan.as_json())
    with stages.stage("previews"):
        write_previews(portrait, opened, folder / "previews", progress)
    _write_json(folder / "metrics.json", _metrics(plan, portrait, stages, torch_device))
    write_report(session, name)
    return folder


def _check_preset(preset: str) -> None:
    if preset in PRESETS_TO_COME:
        raise PlanError(
            f"The preset {preset!r} is a neural refinement, which is still to come; use --preset solve, "
            "the photometric solve that it will start from."
        )
    if preset not in PRESETS:
        known = ", ".join((*PRESETS, *PRESETS_TO_COME))
        raise PlanError(f"There is no preset {preset!r}; known are {known}, and solve is there today.")


def _metrics(plan: Plan, portrait: Portrait, stages: Stages, device: torch.device) -> dict[str, Any]:
    return {
        "finished": datetime.now(UTC).isoformat(timespec="seconds"),
        "device": describe_device(device),
        "points": len(portrait.points),
        "frames": len(plan.frames),
        "estimated_s": round(plan.estimated_s, 1),
        "seconds": {stage: round(seconds, 3) for stage, seconds in stages.seconds.items()},
        "total_s": round(stages.total_s, 3),
        **memory_summary(stages, device),
        "solve": dict(portrait.info),
        "versions": {
            "relightable-portrait-rig": installed_version(),
            "torch": torch.__version__,
        },
    }


def _write_json(path: Path, content: Mapping[str, Any]) -> None:
    atomic_write(path, (json.dumps(content, indent=2) + "\n").encode())
