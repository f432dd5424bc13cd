"""Writing a session of pictures that lie on the disk: what all importers of image sets share."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from capture.atomic import atomic_write
from capture.calibration_file import Quantity, write_calibration_entries
from capture.errors import ImageError, SourceError
from capture.images import IMAGE_SUFFIXES, image_size, read_image, write_png
from capture.importers.flash_list import read_flash_list
from capture.importers.options import ImportOptions, Progress
from capture.importers.source_frame import SourceFrame
from capture.importers.still_flash import tag_source_frames
from capture.ply import PointCloud, read_ply, write_ply
from capture.session import FrameRecord, Session

logger = logging.getLogger(__name__)


def write_image_set(
    out: Path,
    frames: Sequence[SourceFrame],
    *,
    source: Mapping[str, Any],
    transfer: str,
    cloud: Path | PointCloud | None,
    options: ImportOptions,
    progress: Progress,
    calibration: Mapping[str, Quantity] | None = None,
) -> Session:
    """Makes a complete session of frames, a cloud and what is known of the flash.

    Pictures are copied byte for byte. Everything is checked before the first file is written. An interrupted
    session of the same source is completed.

    Args:
        out: session folder to make.
        frames: with what the source says of them.
        source: for session.json.
        transfer: of the pictures, as the source says or as is usual.
        cloud: the source's own.
        options: what the user says instead, and wants left out.
        progress: is told what is done.
        calibration: what the source says of the flash.

    Raises:
        SourceError: a picture or mask is missing, of another size than its camera, or of no known format.
        TaggingError: the flash was to be told from the pictures, and cannot be.
    """
    if all(frame.picture is None for frame in frames):
        raise SourceError(
            "None of the frames names a picture: these are cameras only. Import the video with --poses."
        )
    frames = apply_options(frames, options)
    with_pictures = [frame for frame in frames if frame.picture is not None]
    for done, frame in enumerate(with_pictures):
        _check_picture(frame)
        progress("checking pictures", (done + 1) / len(with_pictures))
    posed = {frame.index: frame.camera for frame in with_pictures if frame.camera is not None}
    warnings: list[str] = []
    cloud = choose_cloud(cloud, options, bool(posed), warnings)
    points = read_ply(cloud) if isinstance(cloud, Path) else cloud
    masks = _existing_masks(with_pictures)
    transfer = options.transfer or transfer
    info: dict[str, Any] = {}
    unsaid = not posed and all(frame.flash is None for frame in frames)
    if options.flash_list is None and ("flash" in options.without or unsaid):
        frames, tags = tag_source_frames(frames, transfer, progress)
        warnings += tags.warnings
        info["tagging"] = {"log_gain": tags.log_gain, "separation": tags.separation}

    width, height = with_pictures[0].size
    source = describe_source(source, options, bool(posed))
    with open_or_create(out, source, width, height, transfer) as session:
        if warnings or info:
            session.update_info(warnings=warnings, **info)
        present = {record.index for record in session.frames}
        for done, frame in enumerate(frames):
            if frame.index not in present:
                session.append_frame(_copy(frame, session))
            if (mask := masks.get(frame.index)) is not None:
                copy_mask(mask, frame, session)
            progress("copying pictures", (done + 1) / len(frames))
        if posed:
            session.save_scene_cameras(posed)
        if isinstance(cloud, Path):
            atomic_write(session.points_path, cloud.read_bytes())
        elif points is not None:
            write_ply(session.points_path, points)
        if calibration:
            entries = {name: quantity.to_json() for name, quantity in calibration.items()}
            write_calibration_entries(session.calibration_path, entries)
        session.finish()
    return session


def apply_options(frames: Sequence[SourceFrame], options: ImportOptions) -> list[SourceFrame]:
    """The frames without what the user wants left out, and with what the user gives instead.

    Raises:
        SourceError: a flash list or masks that do not fit.
    """
    names = [frame.name for frame in frames]
    left_out: dict[str, Any] = {}
    for part, field in (("poses", "camera"), ("masks", "mask"), ("flash", "flash")):
        if part in options.without:
            left_out[field] = None
    frames = [replace(frame, **left_out) for frame in frames]
    if options.flash_list is not None:
        flags = read_flash_list(options.flash_list, names)
        frames = [replace(frame, flash=flag) for frame, flag in zip(frames, flags, strict=True)]
    masks = named_masks(options.masks, names)
    return [replace(frame, mask=masks.get(frame.name, frame.mask)) for frame in frames]


def choose_cloud(
    own: Path | PointCloud | None, options: ImportOptions, posed: bool, warnings: list[str]
) -> Path | PointCloud | None:
    """The user's cloud, else the source's own; none without poses, in whose world it would have to be.

    Raises:
        SourceError: the user gives a cloud and there are no poses.
    """
    if options.points is not None:
        if not posed:
            raise SourceError(
                f"{options.points} cannot be placed: the pictures come without poses, and those found later "
                "have a world of their own. Leave --points out, or give the poses too."
            )
        return options.points
    if own is None or "points" in options.without:
        return None
    if not posed:
        warnings.append("The source's points were left out with its poses, in whose world they are.")
        return None
    return own


def describe_source(source: Mapping[str, Any], options: ImportOptions, posed: bool) -> dict[str, Any]:
    """What session.json says of the source: without a unit of length where there are no poses."""
    said = {key: value for key, value in source.items() if posed or key != "units"}
    return said | ({"without": sorted(options.without)} if options.without else {})


def named_masks(folder: Path | None, names: Iterable[str]) -> dict[str, Path]:
    """Masks by picture name, from a folder that the user named.

    A picture a/b.jpg may have its mask in a/b.jpg.png (COLMAP's way), a/b.png or any other picture a/b.*, and
    the same without the folder a.

    Raises:
        SourceError: there is no such folder, or no mask in it for a picture.
    """
    if folder is None:
        return {}
    if not folder.is_dir():
        raise SourceError(f"{folder} is no folder of masks.")
    files = {
        file.relative_to(folder).as_posix(): file for file in sorted(folder.rglob("*")) if file.is_file()
    }
    by_stem = {PurePosixPath(name).with_suffix("").as_posix(): file for name, file in files.items()}
    masks = {}
    for name in names:
        path = PurePosixPath(name)
        calls = (path.as_posix(), path.with_suffix("").as_posix(), path.name, path.stem)
        mask = next((by_stem[call] for call in calls if call in by_stem), None)
        if mask is None:
            raise SourceError(
                f"{folder} has no mask for {name} (as {path.stem}.png); add it or leave --masks out."
            )
        masks[name] = mask
    return masks


def _check_picture(frame: SourceFrame) -> None:
    picture = frame.picture
    assert picture is not None
    if picture.suffix.lower() not in IMAGE_SUFFIXES:
        raise SourceError(
            f"Frame {frame.index}: {picture} is of a kind that is not read here; convert it to PNG or JPEG."
        )
    try:
        width, height = image_size(picture)
    except ImageError as cause:
        raise SourceError(f"Frame {frame.index}: {cause}") from cause
    if (width, height) != frame.size:
        raise SourceError(
            f"Frame {frame.index} ({picture}) is {width} x {height} pixels, its camera says "
            f"{frame.size[0]} x {frame.size[1]}; use the pictures that the cameras were "
            "computed from, unrotated and in full size."
        )


def _existing_masks(frames: Sequence[SourceFrame]) -> dict[int, Path]:
    """Masks by frame; none at all when the source names masks but has none of them."""
    named = {frame.index: frame.mask for frame in frames if frame.mask is not None}
    missing = [index for index, mask in named.items() if not mask.is_file()]
    if named and len(missing) == len(named):
        logger.warning("The source names masks, but none of them is there; it is imported without masks.")
        return {}
    if missing:
        raise SourceError(f"Frame {missing[0]}: the mask {named[missing[0]]} does not exist.")
    return named


def open_or_create(
    out: Path, source: Mapping[str, Any], width: int, height: int, transfer: str, rotation_deg: int = 0
) -> Session:
    """A new session, or the one of the same source that an interrupted import left."""
    if (out / "session.json").is_file():
        session = Session.open(out)
        if session.status == "interrupted" and session.info["source"] == source:
            return session
    return Session.create(
        out, source=source, width=width, height=height, transfer=transfer, rotation_deg=rotation_deg
    )


def _copy(frame: SourceFrame, session: Session) -> FrameRecord:
    """Copies a frame's picture and gives its record."""
    reasons = frame.remarks or (() if frame.flash is not None else ("untagged",))
    file = None
    if frame.picture is not None:
        suffix = {".jpeg": ".jpg", ".tiff": ".tif"}.get(suffix := frame.picture.suffix.lower(), suffix)
        file = session.write_frame(frame.index, frame.picture.read_bytes(), suffix)
    return FrameRecord(
        index=frame.index,
        file=file,
        width=frame.size[0],
        height=frame.size[1],
        pts_s=frame.pts_s,
        flash=frame.flash,
        confidence=frame.confidence,
        split=frame.split,
        reasons=reasons if file else (*reasons, "no_picture"),
        source=frame.name,
    )


def copy_mask(mask: Path, frame: SourceFrame, session: Session) -> None:
    """Copies an 8-bit grey PNG as it is and converts any other picture to one."""
    try:
        pixels = read_image(mask)
    except ImageError as cause:
        raise SourceError(f"Frame {frame.index}: {cause}") from cause
    if pixels.shape[1::-1] != frame.size:
        raise SourceError(
            f"Frame {frame.index}: the mask {mask} is {pixels.shape[1]} x {pixels.shape[0]} pixels, the "
            f"picture {frame.size[0]} x {frame.size[1]}."
        )
    target = session.mask_path(frame.index)
    target.parent.mkdir(parents=True, exist_ok=True)
    if mask.suffix.lower() == ".png" and pixels.ndim == 2 and pixels.dtype == np.uint8:
        atomic_write(target, mask.read_bytes())
        return
    grey = pixels[..., 0] if pixels.ndim == 3 else pixels
    scale = {np.dtype(np.uint8): 1.0, np.dtype(np.uint16): 255 / 65535, np.dtype(np.float32): 255.0}[
        grey.dtype
    ]
    write_png(target, np.clip(np.round(grey * scale), 0, 255).astype(np.uint8))
