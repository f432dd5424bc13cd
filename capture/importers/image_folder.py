"""A folder of plain pictures, in the natural order of their names, without poses.

Which of them the flash lit says a flash list, or the pictures themselves.
"""

from __future__ import annotations

from pathlib import Path

from capture.errors import ImageError, SourceError
from capture.images import IMAGE_SUFFIXES, image_size, natural_order
from capture.importers.image_set import write_image_set
from capture.importers.options import ImportOptions, Progress
from capture.importers.source_frame import SourceFrame
from capture.session import Session


def find_pictures(folder: Path) -> list[Path]:
    """The pictures that lie in a folder itself, in the natural order of their names."""
    files = (file for file in folder.iterdir() if file.is_file() and not file.name.startswith("."))
    pictures = [file for file in files if file.suffix.lower() in IMAGE_SUFFIXES]
    return sorted(pictures, key=lambda file: natural_order(file.name))


def import_image_folder(folder: Path, out: Path, options: ImportOptions, progress: Progress) -> Session:
    """Makes a session of the pictures in a folder: of one size, copied byte for byte.

    Raises:
        SourceError: a picture that cannot be read or is of another size, or two of one name.
        TaggingError: without a flash list, where the pictures do not show which of them are lit.
    """
    pictures = find_pictures(folder)
    _refuse_doubles(pictures)
    size = _size(pictures[0])
    for picture in pictures[1:]:
        if (other := _size(picture)) != size:
            raise SourceError(
                f"{picture} is {other[0]} x {other[1]} pixels, {pictures[0].name} {size[0]} x {size[1]}; "
                "leave only the pictures of one capture in the folder, all of one size and unrotated."
            )
    frames = [
        SourceFrame(index, picture.name, picture, size, camera=None) for index, picture in enumerate(pictures)
    ]
    source = {"kind": "pictures", "path": str(folder)}
    return write_image_set(
        out, frames, source=source, transfer="srgb", cloud=None, options=options, progress=progress
    )


def _refuse_doubles(pictures: list[Path]) -> None:
    by_stem: dict[str, Path] = {}
    for picture in pictures:
        other = by_stem.setdefault(picture.stem, picture)
        if other is not picture:
            raise SourceError(
                f"{picture.parent} has both {other.name} and {picture.name}; leave one of the two."
            )


def _size(picture: Path) -> tuple[int, int]:
    try:
        return image_size(picture)
    except ImageError as cause:
        raise SourceError(str(cause)) from cause
