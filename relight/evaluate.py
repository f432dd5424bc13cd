"""A session's portrait, measured against the truth: what `relight evaluate` does."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from capture.cameras import Camera
from capture.json_fields import read_json
from capture.session import Session
from relight.errors import PortraitError
from relight.lighting import Light
from relight.measure import Render, Rendering, measure
from relight.portrait import Portrait, load_portrait
from relight.render import PortraitRenderer
from relight.stage_cache import StageCache
from relight.stages import Progress, no_progress
from relight.truth import load_truth
from relight.truth_cameras import align_to_truth


def evaluate(
    session: Path, truth: Path, portrait: str = "solve", *, progress: Progress = no_progress
) -> dict[str, Any]:
    """Renders a session's portrait at the views of a truth and measures it.

    A session whose poses were found from its frames has a world of its own; it is brought into the truth's by
    the cameras of its frames first.

    Args:
        session: the session's folder.
        truth: a folder as `relight.truth` describes it; what it lacks is not measured.
        portrait: name of the portrait.
        progress: told (stage, fraction done).

    Returns:
        As `measure`, with "session", "portrait", "alignment" where the worlds differ and, where the fit left
        them, its times as "fit".

    Raises:
        RelightError: the session, the portrait or the truth cannot be read.
    """
    opened = Session.open(session)
    folder = opened.portraits_dir / portrait
    result: dict[str, Any] = {"session": opened.path.resolve().name, "portrait": portrait}
    fitted = load_portrait(folder)
    if StageCache(opened).record("poses") is not None:
        similarity, result["alignment"] = align_to_truth(opened, truth)
        fitted = fitted.transformed(similarity)
    result |= measure(load_truth(truth), portrait_renderer(fitted), progress)
    if (folder / "metrics.json").is_file():
        fit = read_json(folder / "metrics.json", PortraitError).values
        result["fit"] = {
            key: fit[key] for key in ("total_s", "seconds", "peak_memory_mb", "device") if key in fit
        }
    return result


def portrait_renderer(portrait: Portrait) -> Render:
    """Renders views of a portrait for `measure`."""
    renderer = PortraitRenderer(portrait)

    def render(camera: Camera, lights: dict[str, Light], flash: int | None) -> Rendering:
        maps, radiances = renderer.view(camera, lights, flash)
        return Rendering(
            albedo=maps.albedo.cpu().numpy(),
            normals_world=maps.normals_world.cpu().numpy(),
            mask=maps.mask.cpu().numpy(),
            radiance={name: radiance.cpu().numpy() for name, radiance in radiances.items()},
        )

    return render
