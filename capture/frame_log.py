"""frames.jsonl: one line a frame, appended and on the disk before `append` returns, for one writer at a time.

A power cut can leave the last line torn. It is left out on reading, and moved aside, never deleted, before
the next line is appended.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import BinaryIO

from capture.atomic import atomic_write, sync
from capture.errors import SessionError
from capture.frame_record import FrameRecord

try:
    import fcntl
except ImportError:  # Windows: a second writer goes unnoticed there
    fcntl = None  # type: ignore[assignment]

_LONGEST_LINE = 1 << 20


class FrameLog:
    """The log of a session.

    Attributes:
        path: the file.
        torn_line: number of the torn last line that `read` left out, None = the log is whole.
    """

    def __init__(self, path: Path) -> None:
        """Of a file that need not exist yet; `read` it before appending to one that does."""
        self.path = path
        self.torn_line: int | None = None
        self._file: BinaryIO | None = None
        self._size = 0  # bytes that are understood
        self._lacks_newline = False  # the last line is whole but for its newline

    @property
    def is_open(self) -> bool:
        """Whether this object is the log's writer."""
        return self._file is not None

    def read(self) -> Iterator[tuple[int, FrameRecord]]:
        """Line number, from 1, and record of every whole line.

        Raises:
            SessionError: the file is missing or unreadable, or a line before the last is malformed.
        """
        self.torn_line, self._size, self._lacks_newline = None, 0, False
        try:
            with self.path.open("rb") as file:
                number = 0
                while line := file.readline(_LONGEST_LINE):
                    number += 1
                    has_newline = line.endswith(b"\n")
                    try:
                        record = FrameRecord.from_json(line)
                    except ValueError as cause:
                        if not has_newline and len(line) < _LONGEST_LINE:
                            self.torn_line = number
                            return
                        raise SessionError(f"{self.path}, line {number}: {cause}.") from cause
                    self._size += len(line)
                    self._lacks_newline = not has_newline
                    yield number, record
        except OSError as cause:
            raise SessionError(f"{self.path} cannot be read: {cause.strerror or cause}.") from cause

    def open(self) -> None:
        """Becomes the writer: locks the log and moves a torn line to frames.torn.

        Raises:
            SessionError: another process writes, or has written since `read`.
        """
        if self._file is not None:
            return
        file = self.path.open("r+b", buffering=0)
        try:
            if not _lock(file):
                raise SessionError(
                    f"{self.path.parent} is being recorded by another process; wait for it to finish."
                )
            if file.seek(0, os.SEEK_END) != self._size:
                self._move_torn_line_aside(file)
            self._file = file
            if self._lacks_newline:
                self._write(b"\n")
                self._lacks_newline = False
        except BaseException:
            self._file = None
            file.close()
            raise

    def append(self, record: FrameRecord) -> None:
        """Adds a line; after a failure (disk full) the log is as it was before."""
        self.open()
        self._write(record.to_json().encode() + b"\n")

    def replace(self, records: Iterable[FrameRecord]) -> None:
        """Exchanges all lines in one step."""
        content = b"".join(record.to_json().encode() + b"\n" for record in records)
        was_open = self.is_open
        self.open()
        self.close()
        atomic_write(self.path, content)
        self._size = len(content)
        if was_open:
            self.open()

    def close(self) -> None:
        """Stops being the writer."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def is_being_written(self) -> bool:
        """Whether some writer has the log open now."""
        with self.path.open("rb") as file:
            return not _lock(file)

    def _write(self, data: bytes) -> None:
        assert self._file is not None
        self._file.seek(self._size)
        try:
            if self._file.write(data) != len(data):
                raise OSError("the disk is full")
            os.fsync(self._file.fileno())
        except OSError:
            self._file.truncate(self._size)
            raise
        self._size += len(data)

    def _move_torn_line_aside(self, file: BinaryIO) -> None:
        file.seek(self._size)
        torn = file.read(_LONGEST_LINE)
        if self.torn_line is None or b"\n" in torn:
            raise SessionError(
                f"{self.path.parent} was written to since it was opened; open it again to go on."
            )
        aside = self.path.with_suffix(".torn")
        with aside.open("ab") as kept:
            kept.write(torn + b"\n")
        sync(aside)
        file.truncate(self._size)
        self.torn_line = None


def _lock(file: BinaryIO) -> bool:
    """Takes the file for one writer, until it is closed; False = another one has it."""
    if fcntl is None:
        return True
    try:
        fcntl.flock(file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
