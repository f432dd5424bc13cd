"""Files that are written whole or not at all: temporary name, flush, fsync, rename."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from pathlib import Path


def atomic_write(path: Path, data: bytes | Callable[[Path], None]) -> None:
    """Puts a file in place in one step, so that a power cut leaves the old file or the new one, never a part.

    Args:
        path: the file; its folder must exist.
        data: the content, or a function that writes it to the temporary path that it is given
            (same suffix as `path`).
    """
    path = Path(path)
    temporary = path.with_name(f".part-{os.getpid()}-{threading.get_ident()}-{path.name}")
    try:
        if callable(data):
            data(temporary)
        else:
            temporary.write_bytes(data)
        sync(temporary)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    sync(path.parent)


def sync(path: Path) -> None:
    """Waits until a file, or a folder's list of names, is on the disk."""
    if path.is_dir() and os.name == "nt":
        return  # Windows cannot open a folder; its renames are journalled
    descriptor = os.open(path, os.O_RDWR if os.name == "nt" else os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
