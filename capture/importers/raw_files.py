"""The RAW files of a folder, and the pictures that lie beside them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from capture.errors import SourceError
from capture.images import IMAGE_SUFFIXES, natural_order

#: Suffixes of camera RAW files, as LibRaw knows them.
RAW_SUFFIXES = frozenset(
    {".3fr", ".arw", ".cr2", ".cr3", ".crw", ".dcr", ".dng", ".erf", ".fff", ".gpr", ".iiq", ".kdc", ".mef"}
    | {".mos", ".mrw", ".nef", ".nrw", ".orf", ".pef", ".raf", ".raw", ".rw2", ".rwl", ".sr2", ".srf", ".srw"}
    | {".x3f"}
)

_PICTURE_SUFFIXES = IMAGE_SUFFIXES | {".heic", ".heif", ".avif", ".jxl"}
_MOST_NAMED = 3


def find_raw_files(folder: Path) -> list[Path]:
    """The RAW files that lie in a folder itself, in the natural order of their names."""
    return _files(folder, RAW_SUFFIXES)


def refuse_doubles(files: Sequence[Path]) -> None:
    """Refuses two RAW files of one name.

    Raises:
        SourceError: there are such.
    """
    by_stem: dict[str, Path] = {}
    for file in files:
        other = by_stem.setdefault(file.stem.lower(), file)
        if other is not file:
            raise SourceError(f"{file.parent} has both {other.name} and {file.name}; leave one of the two.")


def say_left_out(folder: Path, files: Sequence[Path]) -> list[str]:
    """Sentences on the pictures beside the RAW files: their twins of the same name, and others."""
    stems = {file.stem.lower() for file in files}
    others = _files(folder, _PICTURE_SUFFIXES)
    twins = [file.name for file in others if file.stem.lower() in stems]
    strays = [file.name for file in others if file.stem.lower() not in stems]
    sentences = []
    if twins:
        sentences.append(f"The RAW files were taken, not their twins {some(twins)}.")
    if strays:
        sentences.append(f"Pictures without a RAW file were left out: {some(strays)}.")
    return sentences


def some(names: Sequence[str]) -> str:
    """The first names and how many more there are."""
    rest = len(names) - _MOST_NAMED
    return ", ".join(names[:_MOST_NAMED]) + (f" and {rest} more" if rest > 0 else "")


def _files(folder: Path, suffixes: frozenset[str]) -> list[Path]:
    files = (file for file in folder.iterdir() if file.is_file() and not file.name.startswith("."))
    return sorted(
        (file for file in files if file.suffix.lower() in suffixes), key=lambda file: natural_order(file.name)
    )
