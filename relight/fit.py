"""From a session to a portrait: plan, geometry, solve, refinement, report; each step in a module of its own.

portraits/NAME/portrait.safetensors, portrait.json   the portrait
               config.json                           the resolved configuration of solve and refinement
               checkpoint/                           where a refinement goes on when it is run again
               plan.json                             what ran, what was skipped, and why
               metrics.json                          seconds a stage, peak memory, versions
               previews/                             pictures
               report.html                           all of it, in one file
"""

from __future__ import annotations

import json
import re
import shutil
import time
from collections.abc import Mapping
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from capture.atomic import atomic_write
from capture.json_fields import parse_json
from capture.session import Session
from capture.transfer import to_display
from relight.derive import derive_scene
from relight.devices import choose_device, describe_device
from relight.errors import GeometryError, PlanError
from relight.face import FaceConfig, FacePrior, find_face, save_face
from relight.geometry_plan import GEOMETRY_STAGES, GeometryConfig, candidates
from relight.photometric import SolveConfig, solve
from relight.plan import Action, Decision, Plan
from relight.planning import make_plan
from relight.portrait import Portrait
from relight.presets import chosen_preset
from relight.previews import write_previews
from relight.report import write_report
from relight.scene import load_scene
from relight.self_check import SelfCheck, check_portrait
from relight.stage_cache import StageCache
from relight.stages import Progress, Stages, memory_summary, no_progress
from relight.version import installed_version

REFUSED_DB, REFUSED_COVER = 21.0, 0.7
"""A portrait under these shows something else than its frames (right ones have 30 dB and more, and 0.95)."""

DOUBTED_DB, DOUBTED_COVER = 25.0, 0.85

_AFTERWARDS = 6.0  # what follows a refinement takes this many times as long as the check of the solve
_KEY_FILE = "key.json"  # of a checkpoint

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,79}")


def fit(
    session: Path,
    preset: str = "solve",
    *,
    device: str | None = None,
    max_seconds: float | None = None,
    name: str | None = None,
    forced: Mapping[str, Action] | None = None,
    geometry: GeometryConfig | None = None,
    settings: Mapping[str, Any] | None = None,
    seed: int = 0,
    fresh: bool = False,
    progress: Progress = no_progress,
) -> Path:
    """Fits a portrait and writes everything that belongs to it.

    Args:
        session: The session's folder.
        preset: One of `relight.presets.PRESETS`.
        device: "cpu" or "cuda"; by default the card where there is one.
        max_seconds: Time that the fit should end within; the plan leaves frames out until the solve does, and
            a refinement gives the best it has when what is left is spent.
        name: What to call the portrait; its preset's name by default. One of that name is replaced.
        forced: Decisions of the plan to turn round.
        geometry: How poses, cloud and masks are found where the session does not bring them.
        settings: Of the preset's refinement, those that shall not be as usual.
        seed: Of all that a refinement draws by chance.
        fresh: Whether to do again what an earlier run left, though nothing that it depends on has changed.
        progress: Told (stage, fraction).

    Returns:
        The portrait's folder.

    Raises:
        GeometryError: Poses, cloud or masks cannot be found in the frames.
        PlanError: The session cannot be fitted, or an argument is not one of those known.
    """
    started_s = time.perf_counter()
    chosen = chosen_preset(preset)
    refine, refinement = chosen.load_refine(), chosen.config(settings or {})
    geometry = geometry or GeometryConfig()
    torch_device = choose_device(device)
    name = preset if name is None else name
    if not _NAME.fullmatch(name):
        raise PlanError(f"A portrait cannot be called {name!r}; use letters, digits, '_', '-' and '.'.")
    opened = Session.open(session)
    if fresh:
        StageCache(opened).forget_all()
    stages = Stages()
    with stages.stage("plan"):
        plan = make_plan(opened, forced, max_seconds, geometry)
    plan.check()
    if any(plan.runs(stage) for stage in GEOMETRY_STAGES):
        derive_scene(opened, plan, geometry, torch_device, stages, progress)
        with stages.stage("plan"):
            plan = make_plan(opened, forced, max_seconds, geometry).after(plan)
        plan.check()
    config = SolveConfig(mirror=plan.runs("face_prior"), **chosen.solve)
    folder = opened.portraits_dir / name
    cache = StageCache(opened)
    solve_key = _solve_key(opened, cache, plan, config, geometry.face, torch_device)
    key = solve_key
    if refine is not None:
        limit = {"preset": preset, "config": asdict(refinement), "seed": seed, "max_seconds": max_seconds}
        key = f"{solve_key} {json.dumps(limit, sort_keys=True, default=str)}"
    if not fresh and _is_current(folder, key):
        return folder
    with stages.follow(progress) as told:
        scene = load_scene(
            opened,
            frames=plan.frames,
            undistort=plan.runs("undistortion"),
            device=torch_device,
            progress=told,
        )
        portrait = solve(scene, config, told)

    with stages.stage("check"):
        check = check_portrait(portrait, scene)
        warnings = _judged(check, found=cache.record("poses") is not None)
    face = None
    if plan.runs("face_prior"):
        with stages.stage("face"):
            face, decision = _find_face(opened, portrait, geometry.face, progress)
            plan = plan.with_decision(decision)
    if refine is not None:
        with stages.follow(progress) as told:
            portrait = refine(
                scene,
                portrait,
                config=refinement,
                seconds=_seconds_left(max_seconds, started_s, stages),
                face=None if face is None else face.to(torch_device),
                checkpoint=_checkpoint(folder, f"{solve_key} {preset} {seed}", fresh),
                seed=seed,
                progress=told,
            )
        with stages.stage("check"):
            solve_check, check = check, check_portrait(portrait, scene)
        warnings += _compared(check, solve_check)

    folder.mkdir(parents=True, exist_ok=True)
    for outdated in ("evaluation.json", "config.json"):  # they belong to the portrait that is replaced now
        (folder / outdated).unlink(missing_ok=True)
    with stages.stage("save"):
        portrait.save(folder)
        _write_json(folder / "plan.json", plan.as_json())
    with stages.stage("previews"):
        write_previews(portrait, opened, folder / "previews", progress)
    metrics = _metrics(plan, portrait, stages, torch_device)
    metrics |= {
        "check": asdict(check),
        "geometry": cache.reports(),
        "warnings": [
            *scene.calibration_warnings,
            *cache.warnings(),
            *warnings,
            *portrait.info.get("warnings", ()),
        ],
    }
    _write_json(folder / "metrics.json", metrics)
    # Last, because its key says that all of the portrait is there.
    resolved: dict[str, Any] = {
        "key": key,
        "preset": preset,
        "solve": asdict(config),
        "geometry": asdict(geometry),
    }
    if refine is not None:
        resolved |= {"refinement": asdict(refinement), "seed": seed, "max_seconds": max_seconds}
    _write_json(folder / "config.json", resolved)
    write_report(session, name)
    return folder


def _judged(check: SelfCheck, *, found: bool) -> list[str]:
    """Sentences about a portrait that does not show its own frames well.

    Raises:
        GeometryError: It does not show them at all, and rests on poses that were found: they are wrong.
    """
    said = (
        f"the portrait gives its own frames back at {check.psnr_db:.1f} dB and covers "
        f"{check.covered:.0%} of what was taken for the subject"
    )
    if found and not (check.psnr_db >= REFUSED_DB and check.covered >= REFUSED_COVER):
        raise GeometryError(
            f"What was found in these frames does not hold: {said} (needed: {REFUSED_DB:g} dB and "
            f"{REFUSED_COVER:.0%}). The head moved, or the background shows too little: film again with a "
            "still head before a background with things in it, put printed markers about the head, or give "
            "poses."
        )
    if not (check.psnr_db >= DOUBTED_DB and check.covered >= DOUBTED_COVER):
        return [f"Look twice: {said}; a head that moved, poses that are off or blur would show like that."]
    return []


def _compared(refined: SelfCheck, solved: SelfCheck) -> list[str]:
    """A sentence where a refinement shows the frames less well than what it began with."""
    if refined.psnr_db >= solved.psnr_db:
        return []
    return [
        f"The refinement gives its own frames back at {refined.psnr_db:.1f} dB, the photometric solve at "
        f"{solved.psnr_db:.1f} dB: give it more time, or take --preset solve."
    ]


def _seconds_left(max_seconds: float | None, started_s: float, stages: Stages) -> float | None:
    """What a refinement may take, so that pictures and report are there in time too; None = all it wants."""
    if max_seconds is None:
        return None
    reserved_s = _AFTERWARDS * stages.seconds["check"]
    return max(0.0, max_seconds - (time.perf_counter() - started_s) - reserved_s)


def _checkpoint(folder: Path, key: str, fresh: bool) -> Path:
    """The folder in which a refinement keeps its state: emptied if what lies there is of another solve."""
    checkpoint = folder / "checkpoint"
    written = json.dumps({"key": key}).encode()
    own = checkpoint / _KEY_FILE
    if fresh or not own.is_file() or own.read_bytes() != written:
        shutil.rmtree(checkpoint, ignore_errors=True)
        checkpoint.mkdir(parents=True)
        atomic_write(own, written)
    return checkpoint


def _find_face(
    session: Session, portrait: Portrait, config: FaceConfig, progress: Progress
) -> tuple[FacePrior | None, Decision]:
    """Finds the face of a solved portrait and keeps it in the session's scene folder."""
    progress("face", 0.0)
    cameras = session.load_scene_cameras()
    records = {record.index: record for record in session.frames}

    def load_srgb(index: int) -> NDArray[np.uint8]:
        """A frame as a landmark model is used to: 8-bit sRGB."""
        display = to_display(np.clip(session.load_radiance(records[index]), 0.0, 1.0))
        return np.rint(255.0 * display).astype(np.uint8)

    result = find_face(
        portrait.points.cpu().double().numpy(),
        portrait.normals_world.cpu().double().numpy(),
        portrait.albedo.cpu().double().numpy(),
        {
            record.index: cameras[record.index]
            for record in candidates(session.frames)
            if record.index in cameras
        },
        config=config,
        confidence=portrait.confidence.cpu().double().numpy(),
        load_srgb=load_srgb,
        rotation_deg=session.info["image"]["rotation_deg"],
        progress=progress,
    )
    folder = session.scene_dir / "face"
    if result.prior is None:
        shutil.rmtree(folder, ignore_errors=True)
        return None, Decision("face_prior", Action.SKIP, result.decision.reason)
    save_face(result.prior, folder)
    return result.prior, Decision("face_prior", Action.RUN, result.decision.reason)


def _solve_key(
    session: Session,
    cache: StageCache,
    plan: Plan,
    config: SolveConfig,
    face: FaceConfig,
    device: torch.device,
) -> str:
    """Of all that a portrait depends on."""
    fitted = frozenset(plan.frames)
    frames = [record for record in session.frames if record.index in fitted]
    settings = {
        **asdict(config),
        "face": asdict(face),
        "undistort": plan.runs("undistortion"),
        "device": describe_device(device),
    }
    inputs = [*(cache.identity(stage) for stage in ("poses", "cloud", "masks")), installed_version()]
    return cache.key("solve", settings, frames, inputs)


def _is_current(folder: Path, key: str) -> bool:
    """Whether the portrait there is whole and is what the fit would give."""
    whole = all(
        (folder / file).is_file() for file in ("portrait.json", "portrait.safetensors", "report.html")
    )
    if not whole or not (folder / "config.json").is_file():
        return False
    try:
        return bool(parse_json((folder / "config.json").read_bytes()).get("key") == key)
    except (OSError, ValueError, AttributeError):
        return False


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
