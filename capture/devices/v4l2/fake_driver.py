"""The fake V4L2 driver: a `Kernel` with one camera in it, whose frames pass as the bench's clock does."""

from __future__ import annotations

import ctypes
import errno
import os
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from capture.devices.bench import Bench
from capture.devices.camera import StreamFormat
from capture.devices.pixel_formats import JPEG_FORMATS, frame_bytes, line_bytes
from capture.devices.v4l2 import structs as v4l2
from capture.devices.v4l2.fake_controls import FakeControls, Spec
from capture.devices.v4l2.fake_quirks import Quirks
from capture.devices.v4l2.fake_sensor import FakeSensor

#: The only node there is.
FAKE_PATH = "/dev/fake-video0"
_READOUT_S = 0.020
#: From the end of the readout to the buffer, for the bus.
_TRANSFER_S = 0.003
#: What `meddled_at` sets the exposure to, 100 us.
_MEDDLED = 300
_OWN_CLOCK_S = 12.5


@dataclass
class _Open:
    """What the driver keeps for an open descriptor."""

    subscribed: set[int]
    events: deque[tuple[int, int]]


class FakeKernel:
    """Open, ioctl, mmap and wait of a machine with one camera. See `capture.devices.v4l2.fake`."""

    def __init__(self, quirks: Quirks, bench: Bench, seed: int = 0) -> None:
        """Plugs the camera in.

        Args:
            quirks: What it offers and does wrong.
            bench: Its clock and the lamp's light.
            seed: Of scene and noise.
        """
        self._quirks = quirks
        self._bench = bench
        self._seed = seed
        self.controls = FakeControls(quirks)
        self._modes = dict(quirks.modes)
        name = next(iter(self._modes))
        (self._width, self._height), rates = self._modes[name][0]
        self._pixel_format = name
        self._fps = rates[0]
        self._opened: dict[int, _Open] = {}
        self._next_descriptor = 1000
        self._sensor: FakeSensor | None = None
        self._buffers: list[bytearray] = []
        self._about: dict[int, tuple[int, float, int, int]] = {}
        self._queued: deque[int] = deque()
        self._done: deque[int] = deque()
        self._streaming = False
        self._failed_starts = quirks.fails_to_start
        self._wedged_by: int | None = None
        self._frame = 0
        self._begins_s = 0.0
        self._gone = False
        self._broken = False
        self.delivered = 0
        self.lost = 0

    # ----------------------------------------------------------------------------- calls of a program

    def open(self, path: str) -> int:
        """A descriptor."""
        if path != FAKE_PATH:
            raise _error(errno.ENOENT)
        if self._gone:
            raise _error(errno.ENODEV)
        self._next_descriptor += 1
        self._opened[self._next_descriptor] = _Open(set(), deque())
        return self._next_descriptor

    def close(self, descriptor: int) -> None:
        """Ends the stream of this descriptor."""
        if self._opened.pop(descriptor, None) is None:
            raise _error(errno.EBADF)
        if not self._opened:
            self._stop()
            self._buffers.clear()
            self._wedged_by = None

    def mmap(self, descriptor: int, length: int, offset: int) -> FakeMapping:
        """A buffer; its offset is its number in pages."""
        index = offset // 4096
        if self._gone or not index < len(self._buffers) or length != len(self._buffers[index]):
            raise _error(errno.ENODEV if self._gone else errno.EINVAL)
        return FakeMapping(self._buffers[index])

    def wait(self, descriptor: int, timeout_s: float) -> bool:
        """Lets time pass until a frame is there."""
        clock = self._bench.clock
        deadline_s = clock.now_s() + timeout_s
        while True:
            self._pass_time()
            if self._gone or self._broken or self._done or not self._streaming:
                return True
            due_s = self._due_s() if self._queued else deadline_s + 1.0
            if due_s > deadline_s:
                clock.sleep(deadline_s - clock.now_s())
                self._pass_time()
                return bool(self._done) or self._gone or self._broken
            clock.sleep(due_s - clock.now_s())

    def describe(self, path: str) -> dict[str, str]:
        """As sysfs would."""
        return {"usb_id": "0000:0000", "serial": f"fake-{self._seed}"}

    def ioctl(self, descriptor: int, request: int, argument: ctypes._CData) -> None:
        """Reads and writes `argument` as the kernel would."""
        if descriptor not in self._opened:
            raise _error(errno.EBADF)
        self._pass_time()
        if self._gone:
            raise _error(errno.ENODEV)
        handlers: dict[int, Callable[[Any, int], None]] = {
            v4l2.QUERYCAP: self._query_capability,
            v4l2.ENUM_FMT: self._enumerate_format,
            v4l2.ENUM_FRAMESIZES: self._enumerate_size,
            v4l2.ENUM_FRAMEINTERVALS: self._enumerate_interval,
            v4l2.G_FMT: self._get_format,
            v4l2.S_FMT: self._set_format,
            v4l2.G_PARM: self._get_parameters,
            v4l2.S_PARM: self._set_parameters,
            v4l2.QUERY_EXT_CTRL: self._query_control,
            v4l2.QUERYMENU: self._query_menu,
            v4l2.G_EXT_CTRLS: self._get_controls,
            v4l2.S_EXT_CTRLS: self._set_controls,
            v4l2.REQBUFS: self._request_buffers,
            v4l2.QUERYBUF: self._query_buffer,
            v4l2.QBUF: self._queue_buffer,
            v4l2.DQBUF: self._dequeue_buffer,
            v4l2.STREAMON: self._stream_on,
            v4l2.STREAMOFF: self._stream_off,
            v4l2.SUBSCRIBE_EVENT: self._subscribe,
            v4l2.DQEVENT: self._dequeue_event,
        }
        if request not in handlers:
            raise _error(errno.ENOTTY)
        handlers[request](argument, descriptor)

    # ----------------------------------------------------------------------------------------- frames

    def _pass_time(self) -> None:
        """Delivers or loses the frames that are over by now."""
        while self._streaming and not self._gone and not self._broken:
            now_s = self._bench.clock.now_s()
            if self._due_s() > now_s:
                return
            self._deliver()

    def _due_s(self) -> float:
        """When the frame in work will be in its buffer."""
        return self._begins_s + max(1.0 / self._fps, _READOUT_S) + _TRANSFER_S

    def _deliver(self) -> None:
        quirks, frame = self._quirks, self._frame
        self._frame += 1
        if quirks.unplugged_at and frame >= quirks.unplugged_at:
            self._gone = True
            return
        if quirks.broken_at and frame >= quirks.broken_at:
            self._broken = True
            return
        if quirks.meddled_at and frame == quirks.meddled_at:
            self._meddle()
        state, interval_s = self.controls.frame_begins(frame, 1.0 / self._fps)
        begins_s, self._begins_s = self._begins_s, self._begins_s + interval_s
        if self._sensor is None:
            return
        light = self._sensor.light(frame, begins_s, state, self._bench.light.pulses)
        self.controls.frame_ends(float(light.mean()), interval_s)
        if not self._queued or (quirks.lost_every and frame % quirks.lost_every == quirks.lost_every - 1):
            self.lost += 1
            return
        data = self._sensor.encode(light, self._pixel_format)
        flags = v4l2.BUF_FLAG_TSTAMP_SRC_SOE
        flags |= v4l2.BUF_FLAG_TIMESTAMP_MONOTONIC if quirks.monotonic else v4l2.BUF_FLAG_TIMESTAMP_COPY
        if quirks.damaged_every and frame % quirks.damaged_every == quirks.damaged_every - 1:
            flags |= v4l2.BUF_FLAG_ERROR
            data = data[: len(data) // 3]
        stamp_s = begins_s if quirks.monotonic else begins_s * 1.0001 - _OWN_CLOCK_S
        if quirks.bad_stamp_every and frame % quirks.bad_stamp_every == quirks.bad_stamp_every - 1:
            # In turn back before the frame before, and into the future.
            stamp_s += 0.4 if frame // quirks.bad_stamp_every % 2 else -0.4
        index = self._queued.popleft()
        self._buffers[index][: len(data)] = data
        self._about[index] = (len(data), stamp_s, flags, frame)
        self._done.append(index)

    def _meddle(self) -> None:
        self.controls.meddle(v4l2.CID_EXPOSURE_ABSOLUTE, _MEDDLED)
        for opened in self._opened.values():
            if v4l2.CID_EXPOSURE_ABSOLUTE in opened.subscribed:
                opened.events.append((v4l2.CID_EXPOSURE_ABSOLUTE, _MEDDLED))

    def _stop(self) -> None:
        self._streaming = False
        self._queued.clear()
        self._done.clear()

    # ------------------------------------------------------------------------------ formats and rates

    def _query_capability(self, argument: v4l2.Capability, descriptor: int) -> None:
        argument.driver, argument.card, argument.bus_info = b"fake", b"Fake camera", b"platform:fake"
        argument.version = 6 << 16 | 1 << 8
        argument.device_caps = v4l2.CAP_VIDEO_CAPTURE | v4l2.CAP_STREAMING
        argument.capabilities = argument.device_caps | v4l2.CAP_DEVICE_CAPS

    def _enumerate_format(self, argument: v4l2.FormatDescription, descriptor: int) -> None:
        name = _entry(list(self._modes), argument.index)
        argument.pixelformat, argument.description = v4l2.fourcc(name), name.encode()

    def _enumerate_size(self, argument: v4l2.FrameSize, descriptor: int) -> None:
        (width, height), _ = _entry(self._sizes(argument.pixel_format), argument.index)
        argument.type = v4l2.FRMSIZE_DISCRETE
        argument.size.min_width, argument.size.max_width = width, height

    def _enumerate_interval(self, argument: v4l2.FrameInterval, descriptor: int) -> None:
        size = (argument.width, argument.height)
        rates = [rate for one, rates in self._sizes(argument.pixel_format) if one == size for rate in rates]
        rate = _entry(rates, argument.index)
        argument.type = v4l2.FRMIVAL_DISCRETE
        argument.interval.min = v4l2.Fraction(1000, round(1000 * rate))

    def _get_format(self, argument: v4l2.Format, descriptor: int) -> None:
        pix = argument.fmt.pix
        format = self._stream_format()
        pix.width, pix.height, pix.pixelformat = self._width, self._height, v4l2.fourcc(self._pixel_format)
        pix.field = v4l2.FIELD_NONE
        pix.bytesperline = 0 if self._pixel_format in JPEG_FORMATS else line_bytes(format)
        pix.sizeimage = frame_bytes(format) or 2 * self._width * self._height
        pix.colorspace = v4l2.COLORSPACE_SRGB

    def _set_format(self, argument: v4l2.Format, descriptor: int) -> None:
        if self._buffers or self._wedged_by == descriptor:
            raise _error(errno.EBUSY)
        name = v4l2.fourcc_name(argument.fmt.pix.pixelformat)
        if name not in self._modes:
            name = next(iter(self._modes))
        wished = (argument.fmt.pix.width, argument.fmt.pix.height)
        (width, height), rates = min(
            self._modes[name], key=lambda mode: abs(mode[0][0] - wished[0]) + abs(mode[0][1] - wished[1])
        )
        self._pixel_format, self._width, self._height, self._fps = name, width, height, rates[0]
        self._get_format(argument, descriptor)

    def _get_parameters(self, argument: v4l2.StreamParameters, descriptor: int) -> None:
        argument.parm.capture.capability = v4l2.CAP_TIMEPERFRAME
        argument.parm.capture.timeperframe = v4l2.Fraction(1000, round(1000 * self._fps))

    def _set_parameters(self, argument: v4l2.StreamParameters, descriptor: int) -> None:
        if self._streaming:
            raise _error(errno.EBUSY)
        asked = argument.parm.capture.timeperframe
        fps = asked.denominator / asked.numerator if asked.numerator else self._fps
        rates = next(
            rates for size, rates in self._modes[self._pixel_format] if size == (self._width, self._height)
        )
        self._fps = min(rates, key=lambda rate: abs(1 / rate - 1 / fps))
        self._get_parameters(argument, descriptor)

    def _sizes(self, pixel_format: int) -> tuple[tuple[tuple[int, int], tuple[float, ...]], ...]:
        return self._modes.get(v4l2.fourcc_name(pixel_format), ())

    def _stream_format(self) -> StreamFormat:
        return StreamFormat(
            width=self._width, height=self._height, pixel_format=self._pixel_format, fps=self._fps
        )

    # --------------------------------------------------------------------------------------- controls

    def _query_control(self, argument: v4l2.QueryExtControl, descriptor: int) -> None:
        identity = argument.id
        if identity & v4l2.CTRL_FLAG_NEXT_CTRL:
            after = identity & ~v4l2.CTRL_FLAG_NEXT_CTRL
            identity = _entry([one for one in self.controls.specs if one > after], 0)
        spec = self._spec(identity)
        argument.id, argument.type = spec.id, spec.kind
        argument.name = self.controls.name(spec).encode()
        argument.minimum, argument.maximum = spec.minimum, spec.maximum
        argument.step, argument.default_value = spec.step, spec.default
        argument.flags = self.controls.flags(identity)
        argument.elem_size, argument.elems, argument.nr_of_dims = 4, 1, 0

    def _query_menu(self, argument: v4l2.QueryMenu, descriptor: int) -> None:
        entries = dict(self._spec(argument.id).menu)
        if argument.index not in entries:
            raise _error(errno.EINVAL)
        argument.name = entries[argument.index].encode()

    def _get_controls(self, argument: v4l2.ExtControls, descriptor: int) -> None:
        for index in range(argument.count):
            control = argument.controls[index]
            control.value = self.controls.get(control.id)

    def _set_controls(self, argument: v4l2.ExtControls, descriptor: int) -> None:
        for index in range(argument.count):
            control = argument.controls[index]
            # Before the stream, the frame that counts is the first of it.
            control.value = self.controls.set(control.id, control.value, self._frame)
            for other, opened in self._opened.items():
                if other != descriptor and control.id in opened.subscribed:
                    opened.events.append((control.id, control.value))

    def _subscribe(self, argument: v4l2.EventSubscription, descriptor: int) -> None:
        if argument.type != v4l2.EVENT_CTRL:
            raise _error(errno.EINVAL)
        self._opened[descriptor].subscribed.add(self._spec(argument.id).id)

    def _dequeue_event(self, argument: v4l2.Event, descriptor: int) -> None:
        events = self._opened[descriptor].events
        if not events:
            raise _error(errno.ENOENT)
        argument.id, value = events.popleft()
        argument.type, argument.pending = v4l2.EVENT_CTRL, len(events)
        argument.u.ctrl.changes = v4l2.EVENT_CTRL_CH_VALUE
        argument.u.ctrl.type = self._spec(argument.id).kind
        argument.u.ctrl.value = value

    def _spec(self, identity: int) -> Spec:
        if identity not in self.controls.specs:
            raise _error(errno.EINVAL)
        return self.controls.specs[identity]

    # ---------------------------------------------------------------------------------------- buffers

    def _request_buffers(self, argument: v4l2.RequestBuffers, descriptor: int) -> None:
        if argument.count == 0:
            self._stop()
        elif self._streaming or self._wedged_by == descriptor:
            raise _error(errno.EBUSY)
        argument.count = min(argument.count, 32)
        size = frame_bytes(self._stream_format()) or 2 * self._width * self._height
        self._buffers = [bytearray(size) for _ in range(argument.count)]
        self._queued.clear()
        self._done.clear()

    def _query_buffer(self, argument: v4l2.Buffer, descriptor: int) -> None:
        self._require_buffer(argument.index)
        argument.length = len(self._buffers[argument.index])
        argument.m.offset = 4096 * argument.index

    def _queue_buffer(self, argument: v4l2.Buffer, descriptor: int) -> None:
        self._require_buffer(argument.index)
        if argument.index in self._queued or argument.index in self._done:
            raise _error(errno.EINVAL)
        self._queued.append(argument.index)

    def _dequeue_buffer(self, argument: v4l2.Buffer, descriptor: int) -> None:
        if not self._streaming:
            raise _error(errno.EINVAL)
        if self._broken:
            raise _error(errno.EIO)
        if not self._done:
            raise _error(errno.EAGAIN)
        index = self._done.popleft()
        argument.index = index
        used, stamp_s, flags, frame = self._about[index]
        argument.bytesused, argument.flags, argument.sequence = used, flags, frame
        argument.timestamp.tv_sec, microseconds = divmod(round(stamp_s * 1e6), 1_000_000)
        argument.timestamp.tv_usec = microseconds
        argument.field, argument.length = v4l2.FIELD_NONE, len(self._buffers[index])
        self.delivered += 1

    def _stream_on(self, argument: ctypes.c_int32, descriptor: int) -> None:
        if not self._buffers:
            raise _error(errno.EINVAL)
        if self._failed_starts:
            self._failed_starts -= 1
            self._wedged_by = descriptor
            raise _error(errno.EIO)
        large = self._width * self._height >= 1280 * 720 and self._pixel_format not in JPEG_FORMATS
        if self._quirks.no_bandwidth and large:
            raise _error(errno.ENOSPC)
        self._sensor = FakeSensor(self._width, self._height, self._seed, _READOUT_S)
        self.controls.stream_starts()
        self._frame = 0
        self._begins_s = self._bench.clock.now_s() + 0.1
        self._streaming = True

    def _stream_off(self, argument: ctypes.c_int32, descriptor: int) -> None:
        self._stop()

    def _require_buffer(self, index: int) -> None:
        if not index < len(self._buffers):
            raise _error(errno.EINVAL)


class FakeMapping:
    """A buffer of the fake driver, mapped."""

    def __init__(self, memory: bytearray) -> None:
        """Shares it."""
        self._memory: bytearray | None = memory

    def __getitem__(self, part: slice) -> bytes:
        """A copy of some of it."""
        if self._memory is None:
            raise ValueError("The mapping is closed.")
        return bytes(self._memory[part])

    def close(self) -> None:
        """Unmaps it."""
        self._memory = None


def _entry(entries: Any, index: int) -> Any:
    """An entry of an enumeration; EINVAL ends it."""
    if not index < len(entries):
        raise _error(errno.EINVAL)
    return entries[index]


def _error(number: int) -> OSError:
    return OSError(number, os.strerror(number))
