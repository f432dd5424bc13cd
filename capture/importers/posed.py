"""Posed image sets: a cameras.json beside pictures, and points.ply and masks where there are any.

Inputs only: light colours, linear pictures, albedo and normals that such a folder may hold are truth for
measuring, and nothing of them enters the session. Of the flash only its position is taken, which a person can
measure with a ruler.
"""

from __future__ import annotations

from pathlib import Path

from capture.calibration_file import Quantity
from capture.cameras import PosedSet, load_posed_set
from capture.errors import SourceError
from capture.importers.image_set import write_image_set
from capture.importers.options import ImportOptions, Progress
from capture.importers.source_frame import SourceFrame
from capture.session import Session


def import_posed(path: Path, out: Path, options: ImportOptions, progress: Progress) -> Session:
    """Makes a session of a cameras.json (or its folder).

    Raises:
        SourceError: the file is malformed, or a picture, mask or cloud is missing or does not fit.
    """
    posed_set = load_posed_set(path)
    frames = [
        SourceFrame(
            index=frame.index,
            name=_name(frame.file, posed_set.root, frame.camera.name),
            picture=frame.file,
            size=(frame.camera.width, frame.camera.height),
            camera=frame.camera,
            flash=frame.flash,
            split=frame.split,
            mask=frame.mask,
            pts_s=frame.pts_s,
        )
        for frame in posed_set.frames
    ]
    own_cloud = posed_set.root / "points.ply"
    return write_image_set(
        out,
        frames,
        source={"kind": "posed", "path": str(path), "name": posed_set.name, "units": posed_set.units},
        transfer=posed_set.transfer,
        cloud=own_cloud if own_cloud.is_file() else None,
        options=options,
        progress=progress,
        calibration=_calibration(posed_set),
    )


def _name(file: Path | None, root: Path, camera_name: str) -> str:
    if file is None:
        return camera_name
    return (file.relative_to(root) if file.is_relative_to(root) else file).as_posix()


def _calibration(posed_set: PosedSet) -> dict[str, Quantity]:
    """The position of the flash, where the set states it."""
    offset = posed_set.flash_offset_cam_m
    if offset is None:
        return {}
    if posed_set.units != "metres":
        raise SourceError(
            f"{posed_set.root}: a flash position needs poses in metres, not in arbitrary units."
        )
    return {
        "flash_offset_cam_m": Quantity.of(offset, "m", f"stated by the cameras.json of {posed_set.name!r}")
    }
