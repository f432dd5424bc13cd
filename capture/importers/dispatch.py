"""Which importer a source is for."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from capture.errors import SourceError
from capture.importers.colmap import find_colmap_model, import_colmap
from capture.importers.nerfstudio import import_nerfstudio
from capture.importers.options import ImportOptions, Progress, no_progress
from capture.importers.posed import import_posed
from capture.json_fields import read_json
from capture.session import Session

VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".m4v", ".mkv", ".webm", ".3gp", ".avi", ".ts"})


def import_source(
    source: Sequence[Path], out: Path, options: ImportOptions, progress: Progress | None = None
) -> Session:
    """Makes a session of a source.

    Args:
        source: one folder or file (a posed image set, a COLMAP model or project, a nerfstudio set), or the
            videos of one capture.
        out: session folder to make; one that an interrupted import of the same source left is completed.
        options: what the source does not say.
        progress: is told what is done and how much of it.

    Raises:
        SourceError: the source is of no known kind, or malformed.
        SessionError: `out` is in use.
    """
    progress = progress or no_progress
    paths = [Path(path) for path in source]
    if not paths:
        raise SourceError("There is nothing to import: name a folder, a model, a transforms.json or videos.")
    for path in paths:
        if not path.exists():
            raise SourceError(f"{path} does not exist.")
    videos = _videos(paths)
    if videos:
        from capture.importers.open_camera import import_videos  # imports the video libraries

        return import_videos(videos, out, options, progress)
    if len(paths) > 1:
        raise SourceError(
            "Several sources can only be the videos of one capture; import other sources one by one."
        )
    if options.poses is not None:
        raise SourceError(f"--poses is for videos; {paths[0]} brings its own poses.")
    path = paths[0]
    if (file := _posed_file(path)) is not None:
        is_nerfstudio = "transform_matrix" in _first_frame(file)
        return (import_nerfstudio if is_nerfstudio else import_posed)(file, out, options, progress)
    if path.is_dir() and (model := find_colmap_model(path)) is not None:
        return import_colmap(model, out, options, progress)
    raise SourceError(
        f"{path} is no source that can be imported: a folder needs cameras.json, transforms.json, a COLMAP "
        "model (or sparse/0 and images/) or videos; a file must be a .json of these or a video "
        f"({', '.join(sorted(VIDEO_SUFFIXES))})."
    )


def _videos(paths: Sequence[Path]) -> list[Path]:
    """The videos that the paths name, or that a folder without any other source holds."""
    if all(path.is_file() and path.suffix.lower() in VIDEO_SUFFIXES for path in paths):
        return list(paths)
    if (
        len(paths) == 1
        and paths[0].is_dir()
        and _posed_file(paths[0]) is None
        and find_colmap_model(paths[0]) is None
    ):
        return sorted(path for path in paths[0].iterdir() if path.suffix.lower() in VIDEO_SUFFIXES)
    return []


def _posed_file(path: Path) -> Path | None:
    """The cameras.json or transforms.json that a path is or holds."""
    if path.is_file():
        return path if path.suffix.lower() == ".json" else None
    return next((path / n for n in ("cameras.json", "transforms.json") if (path / n).is_file()), None)


def _first_frame(file: Path) -> dict[str, object]:
    frames = read_json(file, SourceError).values.get("frames")
    first = frames[0] if isinstance(frames, list) and frames else None
    return first if isinstance(first, dict) else {}
