"""Which frames are lit, in a file beside a source that does not say it.

Text or CSV, one frame a line, `#` starts a comment:

    0010.jpg          a name alone: these frames are lit, all others are not
    0010.jpg, 1       a name and 1 or 0: frames that are not listed are unknown

JSON: a list of names (lit, all others not), or an object {name: 1 | 0}. Instead of its name, with or without
suffix and folder, a frame may be given by its number, counted from 0 in the order of the import.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from capture.errors import SourceError
from capture.json_fields import parse_json

_LARGEST_FILE = 1 << 24


def read_flash_list(path: Path, names: Sequence[str]) -> list[int | None]:
    """The flag of each frame: 1, 0, or None = not listed.

    Args:
        path: the file.
        names: of the frames' pictures, in the order of the import.

    Raises:
        SourceError: malformed, or an entry that names no frame, several, or one twice.
    """
    try:
        if path.stat().st_size > _LARGEST_FILE:
            raise SourceError(
                f"{path} is larger than {_LARGEST_FILE >> 20} MiB; a flash list has one line a frame."
            )
        text = path.read_text(encoding="utf-8-sig")
    except OSError as cause:
        raise SourceError(f"The flash list {path} cannot be read: {cause.strerror or cause}.") from cause
    except UnicodeDecodeError as cause:
        raise SourceError(f"The flash list {path} is no text file.") from cause
    entries = _json_entries(text, path) if path.suffix.lower() == ".json" else _text_entries(text, path)
    if not entries:
        raise SourceError(f"The flash list {path} is empty.")
    with_flag = {flag is not None for _, flag in entries}
    if len(with_flag) > 1:
        raise SourceError(
            f"The flash list {path} has entries with and without a flag; give one to all or to none."
        )
    places = _places(names)
    flags: list[int | None] = [None if with_flag == {True} else 0] * len(names)
    listed: set[int] = set()
    for entry, flag in entries:
        found = places.get(entry.strip().replace("\\", "/").removeprefix("./"), ())
        if len(found) != 1:
            raise SourceError(
                f"The flash list {path} names {entry!r}, which {len(found) or 'no'} frames are called."
            )
        if found[0] in listed:
            raise SourceError(f"The flash list {path} names {entry!r} twice.")
        listed.add(found[0])
        flags[found[0]] = 1 if flag is None else flag
    return flags


def _text_entries(text: str, path: Path) -> list[tuple[str, int | None]]:
    entries: list[tuple[str, int | None]] = []
    for number, line in enumerate(text.splitlines(), start=1):
        cells = [cell.strip().strip('"') for cell in line.split("#", 1)[0].split(",")]
        if cells == [""]:
            continue
        if len(cells) == 1:
            entries.append((cells[0], None))
        elif len(cells) == 2 and cells[1] in ("0", "1"):
            entries.append((cells[0], int(cells[1])))
        elif number > 1:  # the first line may be a header
            raise SourceError(
                f"{path}, line {number}: a line is a frame's name, or name,1 or name,0; not {line[:60]!r}."
            )
    return entries


def _json_entries(text: str, path: Path) -> list[tuple[str, int | None]]:
    try:
        value = parse_json(text)
    except ValueError as cause:
        raise SourceError(f"The flash list {path} is not valid JSON: {cause}.") from cause
    if isinstance(value, list) and all(isinstance(item, str | int) for item in value):
        return [(str(item), None) for item in value]
    if isinstance(value, dict) and all(flag in (0, 1) for flag in value.values()):
        return [(name, int(flag)) for name, flag in value.items()]
    raise SourceError(f"The flash list {path} must be a list of frames, or an object of frames with 1 or 0.")


def _places(names: Sequence[str]) -> dict[str, list[int]]:
    """Frames by all that they may be called; a full name hides a shorter one, and any name a number."""
    places: dict[str, list[int]] = {}
    for call in (str, lambda name: PurePosixPath(name).name, lambda name: PurePosixPath(name).stem):
        called: dict[str, list[int]] = {}
        for index, name in enumerate(names):
            called.setdefault(call(name), []).append(index)
        places = called | places
    return {str(index): [index] for index in range(len(names))} | places
