"""Which importer a source is for."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from capture.errors import SourceError
from capture.importers.colmap import find_colmap_model, import_colmap
from capture.importers.given_calibration import read_given_calibration, save_given_calibration
from capture.importers.image_folder import find_pictures, import_image_folder
from capture.importers.nerfstudio import import_nerfstudio
from capture.importers.options import ImportOptions, Progress, no_progress
from capture.importers.posed import import_posed
from capture.importers.raw_files import find_raw_files
from capture.json_fields import read_json
from capture.session import Session

VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".m4v", ".mkv", ".webm", ".3gp", ".avi", ".ts"})


def import_source(
    source: Sequence[Path], out: Path, options: ImportOptions, progress: Progress | None = None
) -> Session:
    """Makes a session of a source.

    Args:
        source: one folder or file (a posed image set, a COLMAP model or project, a nerfstudio set), a folder
            of RAW files or plain pictures, or the videos of one capture.
        out: session folder to make; one that an interrupted import of the same source left is completed.
        options: what the source does not say.
        progress: is told what is done and how much of it.

    Raises:
        SourceError: the source is of no known kind, or malformed.
        CalibrationError: the calibration given with it is malformed.
        TaggingError: which frames are lit is not given and cannot be seen.
        SessionError: `out` is in use.
    """
    progress = progress or no_progress
    given = read_given_calibration(options.calibration) if options.calibration is not None else None
    session = _import(source, out, options, progress)
    if given is not None:
        save_given_calibration(given, session)
    return session


def _import(source: Sequence[Path], out: Path, options: ImportOptions, progress: Progress) -> Session:
    """The session, without the calibration that the user gives."""
    paths = [Path(path) for path in source]
    if not paths:
        raise SourceError("There is nothing to import: name a folder, a model, a transforms.json or videos.")
    for path in paths:
        if not path.exists():
            raise SourceError(f"{path} does not exist.")
    if all(path.is_file() and _is_video(path) for path in paths):
        return _import_videos(paths, out, options, progress)
    if len(paths) > 1:
        raise SourceError("Several sources can only be the videos of one capture; import others one by one.")
    path = paths[0]
    if (file := _posed_file(path)) is not None:
        _refuse_poses(options, file)
        import_file = import_nerfstudio if "transform_matrix" in _first_frame(file) else import_posed
        return import_file(file, out, options, progress)
    if path.is_dir() and (model := find_colmap_model(path)) is not None:
        _refuse_poses(options, model)
        return import_colmap(model, out, options, progress)
    if path.is_dir() and (videos := sorted(filter(_is_video, path.iterdir()))):
        return _import_videos(videos, out, options, progress)
    if path.is_dir() and ((raws := find_raw_files(path)) or find_pictures(path)):
        if options.poses is not None:
            raise SourceError(
                f"--poses is for videos; put {options.poses.name} beside the pictures of {path} as "
                "cameras.json and import the folder."
            )
        return (_import_raw if raws else import_image_folder)(path, out, options, progress)
    raise SourceError(
        f"{path} is no source that can be imported: a folder needs cameras.json, transforms.json, a COLMAP "
        "model (or sparse/0 and images/), videos, RAW files or pictures; a file must be a .json of these or "
        f"a video ({', '.join(sorted(VIDEO_SUFFIXES))})."
    )


def _import_videos(videos: Sequence[Path], out: Path, options: ImportOptions, progress: Progress) -> Session:
    from capture.importers.open_camera import import_videos  # loads the video libraries, for videos only

    if options.without:
        raise SourceError(
            "--without is for image sets; a video brings only its pictures: leave out --poses and --points."
        )
    return import_videos(videos, out, options, progress)


def _import_raw(folder: Path, out: Path, options: ImportOptions, progress: Progress) -> Session:
    from capture.importers.raw_stills import import_raw_stills  # loads LibRaw, for RAW files only

    return import_raw_stills(folder, out, options, progress)


def _is_video(path: Path) -> bool:
    return path.suffix.lower() in VIDEO_SUFFIXES


def _refuse_poses(options: ImportOptions, path: Path) -> None:
    if options.poses is not None:
        raise SourceError(f"--poses is for videos; {path} brings its own poses.")


def _posed_file(path: Path) -> Path | None:
    """The cameras.json or transforms.json that a path is or holds."""
    if path.is_file():
        return path if path.suffix.lower() == ".json" else None
    return next((path / n for n in ("cameras.json", "transforms.json") if (path / n).is_file()), None)


def _first_frame(file: Path) -> dict[str, object]:
    frames = read_json(file, SourceError).values.get("frames")
    first = frames[0] if isinstance(frames, list) and frames else None
    return first if isinstance(first, dict) else {}
