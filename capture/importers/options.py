"""What a user may say about a source that it does not say itself."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

#: What a source may bring along with its pictures and a user may leave out.
PARTS = ("poses", "points", "masks", "flash")

#: Called with what is being done and the share of it that is done, 0..1.
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class ImportOptions:
    """Choices of an import; None = as the source says.

    Attributes:
        flash_list: file that says which frames are lit (`capture.importers.flash_list`).
        poses: cameras.json with the poses of a video.
        points: PLY point cloud, instead of the source's own.
        masks: folder of masks, named like the pictures.
        transfer: name of the pictures' transfer function.
        keep_location: keep where a video was filmed.
        kept_rate_hz: frames kept of each second of a video, beside the lit ones.
        max_frames: of a video; None = all of it.
        calibration: calibration.json of the camera and its flash; goes before what the source says of them.
        without: those of `PARTS` that the source brings and the session shall not have, so that they are
            found from the pictures instead; the flash at once, the others by the fit.
    """

    flash_list: Path | None = None
    poses: Path | None = None
    points: Path | None = None
    masks: Path | None = None
    transfer: str | None = None
    keep_location: bool = False
    kept_rate_hz: float = 6.0
    max_frames: int | None = None
    calibration: Path | None = None
    without: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        """Checks the names.

        Raises:
            ValueError: a part that no source brings.
        """
        if unknown := sorted(self.without - set(PARTS)):
            raise ValueError(f"without names {unknown[0]!r}; known are {', '.join(PARTS)}")


def no_progress(stage: str, share: float) -> None:
    """Takes progress and shows none."""
