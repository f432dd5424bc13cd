"""Frames on their way to the disk: pictures are written side by side, their lines one after the other.

A frame's line is written when its picture is whole on the disk, and in the order of the frames. What is not
yet written is bounded in bytes: a disk that is too slow makes `put` wait, so that the camera's driver drops
frames, which its sequence numbers tell, instead of the memory growing.
"""

from __future__ import annotations

import threading
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from capture.devices.camera import StreamFormat
from capture.devices.pixel_formats import FrameDataError, picture_file
from capture.session import FrameRecord, Session

_LARGEST_BACKLOG_BYTES = 256 << 20
_WRITERS = 2


class FrameSink:
    """Sees to it that frames get into the session; a context manager that waits for the last one.

    Attributes:
        waits: how often `put` had to wait for the disk.
    """

    def __init__(
        self, session: Session, stream_format: StreamFormat, backlog_bytes: int = _LARGEST_BACKLOG_BYTES
    ) -> None:
        """Into a session that is open for writing."""
        self._session, self._format = session, stream_format
        self._writers = ThreadPoolExecutor(_WRITERS, thread_name_prefix="picture")
        self._logger = ThreadPoolExecutor(1, thread_name_prefix="log")
        self._room = threading.Condition()
        self._largest, self._backlog = backlog_bytes, 0
        self._waiting = 0
        self._failure: BaseException | None = None
        self.waits = 0

    @property
    def waiting(self) -> int:
        """Frames that were taken and are not on the disk yet."""
        return self._waiting

    def put(self, record: FrameRecord, data: bytes | NDArray[Any]) -> None:
        """Takes a frame.

        Args:
            record: Its line, without the file's name.
            data: Its pixels as the camera gave them.

        Raises:
            SessionError: An earlier frame could not be written (the disk is full); nothing more is taken.
        """
        size = len(data) if isinstance(data, bytes) else int(np.asarray(data).nbytes)
        with self._room:
            if self._backlog and self._backlog + size > self._largest:
                self.waits += 1
                self._room.wait_for(
                    lambda: (
                        self._failure is not None
                        or not self._backlog
                        or self._backlog + size <= self._largest
                    )
                )
            if self._failure is not None:
                raise self._failure
            self._backlog += size
            self._waiting += 1
        picture = self._writers.submit(self._write_picture, record.index, data)
        self._logger.submit(self._write_line, record, picture, size)

    def drain(self) -> None:
        """Waits until all that was taken is on the disk.

        Raises:
            SessionError: A frame could not be written; those before it are safe.
        """
        self._writers.shutdown()
        self._logger.shutdown()
        if self._failure is not None:
            raise self._failure

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._writers.shutdown()
        self._logger.shutdown()

    def _write_picture(self, index: int, data: bytes | NDArray[Any]) -> str | None:
        try:
            content, suffix = picture_file(data, self._format)
        except FrameDataError:
            return None
        return self._session.write_frame(index, content, suffix)

    def _write_line(self, record: FrameRecord, picture: Future[str | None], size: int) -> None:
        try:
            if self._failure is None:
                self._session.append_frame(_with_file(record, picture.result()))
        except BaseException as failure:
            with self._room:
                self._failure = self._failure or failure
        finally:
            with self._room:
                self._backlog -= size
                self._waiting -= 1
                self._room.notify_all()


def _with_file(record: FrameRecord, file: str | None) -> FrameRecord:
    """The record with its picture; a frame whose bytes are no picture has none, and says so."""
    if file is None:
        return replace(record, reasons=tuple(dict.fromkeys((*record.reasons, "unreadable"))))
    return replace(record, file=file)
