"""Streaming into mapped buffers: frames are copied out and their buffers given back at once."""

from __future__ import annotations

import contextlib
import ctypes
import errno
from dataclasses import dataclass
from typing import cast

from capture.devices.bench import Clock
from capture.devices.v4l2 import structs as v4l2
from capture.devices.v4l2.kernel import Mapping
from capture.devices.v4l2.node import VideoNode, translated
from capture.errors import CameraError, CameraTimeoutError

#: At 30 frames a second a quarter of a second's work of another program or the disk costs no frame.
_BUFFERS = 8
#: After an empty answer, before the driver is asked again.
_PAUSE_S = 0.001


@dataclass(frozen=True)
class RawFrame:
    """A buffer's content.

    Attributes:
        data: Bytes that the driver filled.
        stamp_s: The driver's time stamp; 0 where it gives none.
        flags: BUF_FLAG_...
        sequence: The driver's count.
        arrival_s: By the bench's clock.
    """

    data: bytes
    stamp_s: float
    flags: int
    sequence: int
    arrival_s: float

    @property
    def monotonic(self) -> bool:
        """Whether the stamp is of CLOCK_MONOTONIC."""
        return self.flags & v4l2.BUF_FLAG_TIMESTAMP_MASK == v4l2.BUF_FLAG_TIMESTAMP_MONOTONIC

    @property
    def stamped_at_start(self) -> bool:
        """Whether the stamp is of the start of the frame, not of its end."""
        return self.flags & v4l2.BUF_FLAG_TSTAMP_SRC_MASK == v4l2.BUF_FLAG_TSTAMP_SRC_SOE

    @property
    def damaged(self) -> bool:
        """Whether the driver says that the content is incomplete."""
        return bool(self.flags & v4l2.BUF_FLAG_ERROR) or not self.data


class Stream:
    """The buffers of a node. Every method may raise `CameraError`."""

    def __init__(self, node: VideoNode, clock: Clock) -> None:
        """Does not start yet."""
        self._node = node
        self._clock = clock
        self._maps: list[Mapping] = []
        self.running = False

    def start(self) -> None:
        """Requests buffers, queues them, starts; on failure everything is released and the node reopened."""
        try:
            self._allocate()
            self._node.ask(v4l2.STREAMON, ctypes.c_int32(v4l2.BUF_TYPE_VIDEO_CAPTURE), "start to stream")
        except CameraError:
            # Buffers that stay allocated make the next change of format fail with EBUSY.
            self._release()
            self._node.reopen()
            raise
        self.running = True

    def stop(self) -> None:
        """Stops and releases the buffers; never raises: the device may be gone."""
        if self.running:
            self.running = False
            with contextlib.suppress(OSError, CameraError):
                self._node.call(v4l2.STREAMOFF, ctypes.c_int32(v4l2.BUF_TYPE_VIDEO_CAPTURE))
        self._release()

    def read(self, timeout_s: float) -> RawFrame:
        """The next frame.

        Raises:
            CameraTimeoutError: None in time.
            CameraError: The driver has given up the stream.
        """
        if not self.running:
            raise CameraError(f"{self._node.path} does not stream; lock the camera first.")
        deadline_s = self._clock.now_s() + timeout_s
        while True:
            left_s = deadline_s - self._clock.now_s()
            if self._node.wait(max(0.0, left_s)):
                frame = self._take()
                if frame is not None:
                    return frame
                self._clock.sleep(_PAUSE_S)
            if self._clock.now_s() >= deadline_s:
                raise CameraTimeoutError(
                    f"{self._node.path} gave no frame within {timeout_s:g} s; plug the camera in again, or "
                    "take MJPG or a smaller picture if it shares its USB bus."
                )

    def _allocate(self) -> None:
        request = v4l2.RequestBuffers(
            count=_BUFFERS, type=v4l2.BUF_TYPE_VIDEO_CAPTURE, memory=v4l2.MEMORY_MMAP
        )
        self._node.ask(v4l2.REQBUFS, request, "share buffers")
        if request.count < 2:
            raise CameraError(
                f"{self._node.path} gives {request.count} buffers; streaming needs two at least."
            )
        for index in range(request.count):
            buffer = _buffer(index)
            self._node.ask(v4l2.QUERYBUF, buffer, "share buffers")
            try:
                self._maps.append(cast(Mapping, self._node.map(buffer.length, buffer.m.offset)))
            except OSError as error:
                raise translated(error, self._node.path, "share buffers") from error
        for index in range(len(self._maps)):
            self._node.ask(v4l2.QBUF, _buffer(index), "take a buffer")

    def _take(self) -> RawFrame | None:
        """Copies a filled buffer out and queues it again; None = there is none after all."""
        buffer = _buffer(0)
        try:
            self._node.call(v4l2.DQBUF, buffer)
        except OSError as error:
            if error.errno == errno.EAGAIN:
                return None
            raise translated(error, self._node.path, "deliver frames") from error
        arrival_s = self._clock.now_s()
        data = bytes(self._maps[buffer.index][: buffer.bytesused])
        frame = RawFrame(
            data=data,
            stamp_s=buffer.timestamp.tv_sec + buffer.timestamp.tv_usec * 1e-6,
            flags=buffer.flags,
            sequence=buffer.sequence,
            arrival_s=arrival_s,
        )
        with contextlib.suppress(OSError):  # the frame is whole; what is wrong the next read will say
            self._node.call(v4l2.QBUF, _buffer(buffer.index))
        return frame

    def _release(self) -> None:
        for mapping in self._maps:
            with contextlib.suppress(OSError, BufferError):
                mapping.close()
        self._maps.clear()
        request = v4l2.RequestBuffers(count=0, type=v4l2.BUF_TYPE_VIDEO_CAPTURE, memory=v4l2.MEMORY_MMAP)
        with contextlib.suppress(OSError, CameraError):
            self._node.call(v4l2.REQBUFS, request)


def _buffer(index: int) -> v4l2.Buffer:
    return v4l2.Buffer(index=index, type=v4l2.BUF_TYPE_VIDEO_CAPTURE, memory=v4l2.MEMORY_MMAP)
