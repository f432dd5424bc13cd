"""A camera on a USB bus, as pyusb's back end layer shows it, and a stream of what it would see.

Built after a Logitech C920 (descriptors and ranges as it gives them). It does not model: timing of transfers,
the status interrupt, streaming over USB, more than one configuration.
"""

from __future__ import annotations

import errno
from collections.abc import Iterable
from dataclasses import dataclass, field
from types import SimpleNamespace, TracebackType
from typing import Any, Self
from uuid import UUID

import numpy as np
import usb.core

from capture.devices.bench import Bench
from capture.devices.camera import (
    CameraInfo,
    CameraProfile,
    CapturedFrame,
    ControlReport,
    LockReport,
    StreamFormat,
)
from capture.errors import CameraError, CameraGoneError
from capture.transfer import to_display

CAMERA_TERMINAL, PROCESSING_UNIT = 1, 3
EXTENSIONS = ("49d16a2c-b832-4485-3ea8-643a152362f2", "a94c5d1f-de11-8744-840d-50933c8ec8d1")


def u(value: int, size: int) -> bytes:
    return value.to_bytes(size, "little", signed=value < 0)


def video_control(
    camera_controls: int = 0x020A2E, processing_controls: int = 0x175B, version: int = 0x0100
) -> bytes:
    """The class-specific VideoControl descriptors of a C920: header, units, extension units, output."""
    body = b"".join(
        [
            u(0x12, 1)
            + b"\x24\x02"
            + u(CAMERA_TERMINAL, 1)
            + u(0x0201, 2)
            + bytes(2)
            + bytes(6)
            + u(3, 1)
            + u(camera_controls, 3),
            *(
                b"\x1b\x24\x06" + u(6 + index, 1) + UUID(guid).bytes_le + b"\x0a\x01\x03\x02\xff\x03\x00"
                for index, guid in enumerate(EXTENSIONS)
            ),
            _processing_unit(processing_controls, version),
            b"\x09\x24\x03\x04\x01\x01\x00\x03\x00",
        ]
    )
    header = b"\x0d\x24\x01" + u(version, 2) + u(13 + len(body), 2) + u(30_000_000, 4) + b"\x01\x01"
    return header + body


def _processing_unit(controls: int, version: int) -> bytes:
    size = 2 if version < 0x0110 else 3  # UVC 1.0 has no bmVideoStandards, and two bytes of controls
    tail = b"\x00" if version < 0x0110 else b"\x00\x00"
    head = b"\x24\x05" + u(PROCESSING_UNIT, 1) + b"\x01\x00\x40" + u(size, 1) + u(controls, size)
    return u(1 + len(head) + len(tail), 1) + head + tail


@dataclass
class FakeControl:
    """A control's value and what it says of itself; ranges of None stall."""

    size: int
    cur: int
    low: int | None = None
    high: int | None = None
    step: int | None = None
    default: int | None = None
    info: int = 0b00011
    signed: bool = False
    clamps: bool = False
    follows: tuple[int, int] | None = None  # (unit, selector) of the automatic
    automatic_values: tuple[int, ...] = (1,)


def c920_controls() -> dict[tuple[int, int], FakeControl]:
    """By (unit, selector); values as plugged in: everything automatic."""
    ct, pu = CAMERA_TERMINAL, PROCESSING_UNIT
    return {
        (ct, 0x02): FakeControl(1, 8, step=0b1001, default=8),
        (ct, 0x03): FakeControl(1, 1),
        (ct, 0x04): FakeControl(
            4, 333, 3, 2047, 1, 250, info=0b01011, follows=(ct, 0x02), automatic_values=(2, 8)
        ),
        (ct, 0x06): FakeControl(2, 30, 0, 250, 5, 0, info=0b11011, follows=(ct, 0x08)),
        (ct, 0x08): FakeControl(1, 1, default=1),
        (ct, 0x0B): FakeControl(2, 100, 100, 500, 1, 100),
        (ct, 0x0D): FakeControl(8, 0, -36000, 36000, 3600, 0),
        (pu, 0x01): FakeControl(2, 1, 0, 1, 1, 0),
        (pu, 0x02): FakeControl(2, -5, -128, 127, 1, 0, signed=True),
        (pu, 0x03): FakeControl(2, 128, 0, 255, 1, 128),
        (pu, 0x04): FakeControl(2, 64, 0, 255, 1, 0),
        (pu, 0x05): FakeControl(1, 2, default=2),
        (pu, 0x07): FakeControl(2, 128, 0, 255, 1, 128),
        (pu, 0x08): FakeControl(2, 128, 0, 255, 1, 128),
        (pu, 0x0A): FakeControl(2, 4600, 2000, 6500, 1, 4000, info=0b01011, follows=(pu, 0x0B)),
        (pu, 0x0B): FakeControl(1, 1, default=1),
    }


@dataclass
class FakeCamera:
    """A device on the bus.

    Attributes:
        refusals: (unit, selector) of announced controls that stall whatever is asked.
        open_errno: raised when it is opened; `claim_errno` when its interface is claimed.
        unplugged: every transfer fails as after an unplug.
        writes: (unit, selector, data) of every SET_CUR, in order.
    """

    vendor: int = 0x046D
    product: int = 0x082D
    strings: tuple[str, ...] = ("HD Pro Webcam C920", "5D3A9F2E")
    specific: bytes = field(default_factory=video_control)
    controls: dict[tuple[int, int], FakeControl] = field(default_factory=c920_controls)
    refusals: set[tuple[int, int]] = field(default_factory=set)
    open_errno: int | None = None
    claim_errno: int | None = None
    unplugged: bool = False
    claimed: bool = False
    opened: int = 0
    writes: list[tuple[int, int, bytes]] = field(default_factory=list)
    error_code: int = 0

    def cur(self, unit: int, selector: int) -> int:
        return self.controls[unit, selector].cur

    def governed(self, control: FakeControl) -> bool:
        return control.follows is not None and self.cur(*control.follows) in control.automatic_values


def stall() -> usb.core.USBError:
    return usb.core.USBError("Pipe error", -9, errno.EPIPE)


class FakeUsb:
    """`usb.backend.IBackend` over fake cameras, and a hub that is none."""

    def __init__(self, cameras: Iterable[FakeCamera] = ()) -> None:
        self.cameras = list(cameras)

    def enumerate_devices(self) -> Iterable[Any]:
        return iter(["hub", *self.cameras])

    def get_device_descriptor(self, dev: Any) -> Any:
        if dev == "hub":
            return SimpleNamespace(
                idVendor=0x1D6B, idProduct=2, iProduct=2, iSerialNumber=1, bus=1, address=1
            )
        return SimpleNamespace(
            idVendor=dev.vendor, idProduct=dev.product, iProduct=1, iSerialNumber=2, bus=1, address=5
        )

    def get_configuration_descriptor(self, dev: Any, config: int) -> Any:
        return SimpleNamespace(bNumInterfaces=1 if dev == "hub" else 3)

    def get_interface_descriptor(self, dev: Any, intf: int, alt: int, config: int) -> Any:
        kinds = [(9, 0, b"")] if dev == "hub" else [(1, 1, b""), (0x0E, 1, dev.specific), (0x0E, 2, b"")]
        kind, subclass, extra = kinds[intf]
        return SimpleNamespace(
            bInterfaceNumber=intf,
            bInterfaceClass=kind,
            bInterfaceSubClass=subclass,
            extra_descriptors=list(extra),
        )

    def open_device(self, dev: FakeCamera) -> FakeCamera:
        if dev.open_errno is not None:
            raise usb.core.USBError("failed", -3, dev.open_errno)
        dev.opened += 1
        return dev

    def close_device(self, dev_handle: FakeCamera) -> None:
        dev_handle.opened -= 1

    def claim_interface(self, dev_handle: FakeCamera, intf: int) -> None:
        assert intf == 1
        if dev_handle.claim_errno is not None:
            raise usb.core.USBError("failed", -6, dev_handle.claim_errno)
        dev_handle.claimed = True

    def release_interface(self, dev_handle: FakeCamera, intf: int) -> None:
        if dev_handle.unplugged:
            raise usb.core.USBError("No such device", -4, errno.ENODEV)
        dev_handle.claimed = False

    def ctrl_transfer(
        self,
        dev_handle: FakeCamera,
        bmRequestType: int,
        bRequest: int,
        wValue: int,
        wIndex: int,
        data: Any,
        timeout: int,
    ) -> int:
        camera = dev_handle
        assert camera.opened > 0
        assert timeout > 0
        if camera.unplugged:
            raise usb.core.USBError("No such device", -4, errno.ENODEV)
        if (bmRequestType, bRequest, wValue >> 8) == (0x80, 0x06, 0x03):
            text = camera.strings[(wValue & 0xFF) - 1].encode("utf-16-le")
            return _fill(data, bytes([len(text) + 2, 3]) + text)
        unit, interface, selector = wIndex >> 8, wIndex & 0xFF, wValue >> 8
        assert interface == 1
        if unit == 0 and selector == 2 and bRequest == 0x81:
            return _fill(data, bytes([camera.error_code]))
        control = camera.controls.get((unit, selector))
        if control is None or (unit, selector) in camera.refusals:
            camera.error_code = 6
            raise stall()
        if bmRequestType == 0x21 and bRequest == 0x01:
            return self._set(camera, (unit, selector), control, bytes(data))
        assert bmRequestType == 0xA1
        return _fill(data, self._get(camera, control, bRequest))

    def _get(self, camera: FakeCamera, control: FakeControl, request: int) -> bytes:
        if request == 0x86:
            return bytes([control.info | (0b100 if camera.governed(control) else 0)])
        fields = {0x81: "cur", 0x82: "low", 0x83: "high", 0x84: "step", 0x87: "default"}
        value = getattr(control, fields[request])
        if value is None:
            camera.error_code = 7
            raise stall()
        if control.size == 8:  # pan and tilt, alike but for their present values
            return u(value & 0xFFFFFFFF, 4) + u(value & 0xFFFFFFFF, 4) if request != 0x81 else u(value, 8)
        return u(value, control.size)

    def _set(self, camera: FakeCamera, place: tuple[int, int], control: FakeControl, data: bytes) -> int:
        camera.writes.append((*place, data))
        if len(data) != control.size:
            camera.error_code = 4
            raise stall()
        if camera.governed(control):
            camera.error_code = 2
            raise stall()
        value = int.from_bytes(data, "little", signed=control.signed)
        if control.low is not None and control.high is not None and not control.low <= value <= control.high:
            if not control.clamps:
                camera.error_code = 4
                raise stall()
            value = min(max(value, control.low), control.high)
        if place == (CAMERA_TERMINAL, 0x02) and not value & (control.step or 0):
            camera.error_code = 8
            raise stall()
        control.cur = value
        return len(data)


def _fill(data: Any, answer: bytes) -> int:
    answer = answer[: len(data)]
    data[: len(answer)] = type(data)("B", answer)
    return len(answer)


class SeeingStream:
    """The stream half: a grey wall as bright as exposure and gain make it, 30 fps in the bench's time.

    A new exposure shows two frames later, as on real cameras. With `forgets` the camera goes back to
    automatic when the stream starts, though it says that it is in manual mode.
    """

    def __init__(self, bench: Bench, camera: FakeCamera | None = None, *, forgets: bool = False) -> None:
        self.info = CameraInfo(
            url="wall:", name="wall", back_end="wall", details={}, clock="monotonic", stamp_at="arrival"
        )
        self.profile: CameraProfile | None = None
        self.closed = False
        self.restored = 0
        self._bench = bench
        self._camera = camera
        self._forgets = forgets
        self._pipeline: list[float] = []
        self._sequence = -1
        self._lost_mode = False

    @property
    def format(self) -> StreamFormat:
        if self.profile is None:
            raise CameraError("The wall is not locked.")
        return StreamFormat(width=32, height=24, pixel_format="RGB3", fps=30.0)

    def lock(self, profile: CameraProfile) -> LockReport:
        if self.profile is None:
            self._lost_mode = self._forgets
            if self._camera is not None:
                self._camera.writes.append((0, 0, b"stream"))
        self.profile = profile
        for _ in range(profile.settle_frames):
            self.read(1.0)
        fps = ControlReport(name="fps", requested=profile.fps, read_back=30.0)
        other = ControlReport(name="exposure_s", requested=None, read_back=99.0)
        return LockReport(controls=(fps, other), warnings=())

    def _exposure_s(self) -> float:
        if self._camera is None:
            return 0.005
        if self._lost_mode:
            modes = [data for unit, selector, data in self._camera.writes if (unit, selector) == (1, 2)]
            self._lost_mode = b"\x08" not in modes[-2:]
        if self._lost_mode or self._camera.cur(1, 0x02) != 1:
            return 0.0333
        return self._camera.cur(1, 0x04) / 1e4

    def read(self, timeout_s: float) -> CapturedFrame:
        if self.closed or (self._camera is not None and self._camera.unplugged):
            raise CameraGoneError("The wall is gone.")
        if self.profile is None:
            raise CameraError("The wall is not locked.")
        self._bench.clock.sleep(1 / 30)
        self._sequence += 1
        self._pipeline.append(self._exposure_s())
        exposure_s = self._pipeline[max(0, len(self._pipeline) - 3)]
        code = np.rint(255 * to_display(min(1.0, 20 * exposure_s), "srgb"))
        now_s = self._bench.clock.now_s()
        return CapturedFrame(
            stamp_s=now_s,
            sequence=self._sequence,
            data=np.full((24, 32, 3), code, np.uint8),
            arrival_s=now_s,
        )

    def check(self) -> tuple[ControlReport, ...]:
        return ()

    def restore(self) -> tuple[str, ...]:
        self.restored += 1
        return ()

    def close(self) -> None:
        self.closed = True

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
