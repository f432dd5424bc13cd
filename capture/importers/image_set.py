"""Writing a session of pictures that lie on the disk: what all importers of image sets share."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from capture.atomic import atomic_write
from capture.calibration_file import Quantity, write_calibration_entries
from capture.cameras import Camera
from capture.errors import ImageError, SourceError
from capture.images import IMAGE_SUFFIXES, image_size, read_image, write_png
from capture.importers.options import Progress
from capture.ply import PointCloud, read_ply, write_ply
from capture.session import FrameRecord, Session

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class SourceFrame:
    """A frame of an image set.

    Attributes:
        index: its number in the session.
        name: what the source calls it.
        picture: its file; None = the source has only a camera, and the frame is recorded without a picture.
        camera: intrinsics and pose.
        flash: 1, 0 or None = unknown.
        split: "train", "val" or None.
        mask: 255 = subject; None = none.
        pts_s: time in seconds.
    """

    index: int
    name: str
    picture: Path | None
    camera: Camera
    flash: int | None = None
    split: str | None = None
    mask: Path | None = None
    pts_s: float | None = None


def write_image_set(
    out: Path,
    frames: Sequence[SourceFrame],
    *,
    source: Mapping[str, Any],
    transfer: str,
    cloud: Path | PointCloud | None,
    progress: Progress,
    calibration: Mapping[str, Quantity] | None = None,
) -> Session:
    """Makes a complete session of frames, a cloud and what is known of the flash.

    Pictures are copied byte for byte. Everything is checked before the first file is written. An interrupted
    session of the same source is completed.

    Raises:
        SourceError: a picture or mask is missing, of another size than its camera, or of no known format.
    """
    with_pictures = [frame for frame in frames if frame.picture is not None]
    if not with_pictures:
        raise SourceError(
            "None of the frames names a picture: these are cameras only. Import the video with --poses."
        )
    for done, frame in enumerate(with_pictures):
        _check_picture(frame)
        progress("checking pictures", (done + 1) / len(with_pictures))
    points = read_ply(cloud) if isinstance(cloud, Path) else cloud
    masks = _existing_masks(with_pictures)

    first = with_pictures[0].camera
    with _open_or_create(out, source, first.width, first.height, transfer) as session:
        present = {record.index for record in session.frames}
        for done, frame in enumerate(frames):
            if frame.index not in present:
                session.append_frame(_copy(frame, session))
            if (mask := masks.get(frame.index)) is not None:
                _copy_mask(mask, frame, session)
            progress("copying pictures", (done + 1) / len(frames))
        session.save_scene_cameras({frame.index: frame.camera for frame in with_pictures})
        if isinstance(cloud, Path):
            atomic_write(session.points_path, cloud.read_bytes())
        elif points is not None:
            write_ply(session.points_path, points)
        if calibration:
            entries = {name: quantity.to_json() for name, quantity in calibration.items()}
            write_calibration_entries(session.calibration_path, entries)
        session.finish()
    return session


def natural_order(name: str) -> list[tuple[int, str]]:
    """Sorting key by which frame_2 comes before frame_10."""
    parts = re.split(r"(\d+)", name)
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]


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
    picture, camera = frame.picture, frame.camera
    assert picture is not None
    if picture.suffix.lower() not in IMAGE_SUFFIXES:
        raise SourceError(
            f"Frame {frame.index}: {picture} is of a kind that is not read here; convert it to PNG or JPEG."
        )
    try:
        width, height = image_size(picture)
    except ImageError as cause:
        raise SourceError(f"Frame {frame.index}: {cause}") from cause
    if (width, height) != (camera.width, camera.height):
        raise SourceError(
            f"Frame {frame.index} ({picture}) is {width} x {height} pixels, its camera says "
            f"{camera.width} x {camera.height}; use the pictures that the cameras were "
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


def _open_or_create(out: Path, source: Mapping[str, Any], width: int, height: int, transfer: str) -> Session:
    if (out / "session.json").is_file():
        session = Session.open(out)
        if session.status == "interrupted" and session.info["source"] == source:
            return session
    return Session.create(out, source=source, width=width, height=height, transfer=transfer)


def _copy(frame: SourceFrame, session: Session) -> FrameRecord:
    """Copies a frame's picture and gives its record."""
    reasons = () if frame.flash is not None else ("untagged",)
    file = None
    if frame.picture is not None:
        suffix = {".jpeg": ".jpg", ".tiff": ".tif"}.get(suffix := frame.picture.suffix.lower(), suffix)
        file = session.write_frame(frame.index, frame.picture.read_bytes(), suffix)
    return FrameRecord(
        index=frame.index,
        file=file,
        width=frame.camera.width,
        height=frame.camera.height,
        pts_s=frame.pts_s,
        flash=frame.flash,
        split=frame.split,
        reasons=reasons if file else (*reasons, "no_picture"),
        source=frame.name,
    )


def _copy_mask(mask: Path, frame: SourceFrame, session: Session) -> None:
    """Copies an 8-bit grey PNG as it is and converts any other picture to one."""
    try:
        pixels = read_image(mask)
    except ImageError as cause:
        raise SourceError(f"Frame {frame.index}: {cause}") from cause
    if pixels.shape[:2] != (frame.camera.height, frame.camera.width):
        raise SourceError(
            f"Frame {frame.index}: the mask {mask} is {pixels.shape[1]} x {pixels.shape[0]} pixels, the "
            f"picture {frame.camera.width} x {frame.camera.height}."
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
