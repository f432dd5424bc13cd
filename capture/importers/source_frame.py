"""A picture of an image set and what its source says of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from capture.cameras import Camera


@dataclass(frozen=True, eq=False)
class SourceFrame:
    """A frame of an image set.

    Attributes:
        index: its number in the session.
        name: what the source calls it.
        picture: its file; None = the source has only a camera, and the frame is recorded without a picture.
        size: (width, height) that the picture must have, pixels.
        camera: intrinsics and pose; None = not known.
        flash: 1, 0 or None = unknown.
        split: "train", "val" or None.
        mask: 255 = subject; None = none.
        pts_s: time in seconds.
        confidence: of `flash`, where it was tagged from the pictures.
        remarks: reasons and remarks of the tagging.
    """

    index: int
    name: str
    picture: Path | None
    size: tuple[int, int]
    camera: Camera | None
    flash: int | None = None
    split: str | None = None
    mask: Path | None = None
    pts_s: float | None = None
    confidence: float | None = None
    remarks: tuple[str, ...] = ()
