"""A USB camera in Python, as the kernel's uvcvideo meets one: controls with a memory, frames over the bus.

Descriptors, requests and payloads are those of the USB Video Class 1.0 (usb.org, "Universal Serial Bus
Device Class Definition for Video Devices", chapters 3 and 4, with its payload documents). The picture is a
grey wedge in linear light that becomes brighter with exposure time and gain, and with a lamp; row after row,
as a rolling shutter has it. What it does not model: colour (white balance changes nothing), lost packets,
the loss of settings between streams.
"""

import struct
import time
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from usbip import In, Interface, USBDevice, core
from usbip.core import Stall
from usbip.function import Function

CAMERA, PROCESSING, OUTPUT = 1, 2, 3  # terminals and units
AE_MODE, AE_PRIORITY, EXPOSURE, FOCUS, AUTO_FOCUS = (
    (CAMERA, 2),
    (CAMERA, 3),
    (CAMERA, 4),
    (CAMERA, 6),
    (CAMERA, 8),
)
BACKLIGHT, BRIGHTNESS, CONTRAST, GAIN = (PROCESSING, 1), (PROCESSING, 2), (PROCESSING, 3), (PROCESSING, 4)
POWER_LINE, SHARPNESS, WHITE_BALANCE = (PROCESSING, 5), (PROCESSING, 8), (PROCESSING, 10)
AUTO_WHITE_BALANCE = (PROCESSING, 11)
MANUAL, APERTURE_PRIORITY = 1, 8  # of AE_MODE
#: After a lock with 5 ms, gain 16, 5000 K, focus 50 and mains of 50 Hz.
LOCKED = {
    AE_MODE: MANUAL,
    AE_PRIORITY: 0,
    EXPOSURE: 50,
    GAIN: 16,
    AUTO_WHITE_BALANCE: 0,
    WHITE_BALANCE: 5000,
    AUTO_FOCUS: 0,
    FOCUS: 50,
    POWER_LINE: 1,
}

SET_CUR, GET_CUR, GET_MIN, GET_MAX, GET_RES, GET_LEN, GET_INFO, GET_DEF = 1, *range(0x81, 0x88)
_PROBE, _COMMIT = 1, 2
_PROBE_BYTES = 26
_SIZE = (160, 120)
_INTERVALS_100NS = (333_333, 666_666, 1_000_000)
_PACKET_BYTES = 3072  # three of 1024 in a microframe, of which every eighth is ours: one packet a millisecond
_END_OF_FRAME, _ERROR = 0x02, 0x40
#: Frames between a new exposure time and the first picture that has it.
LATENCY_FRAMES = 2
#: Between the exposure of a frame's first row and its way over the bus: what the lamp did is known by then.
AGE_S = 0.1
#: Standard deviation, codes; the same eight pictures of it over and over.
NOISE = 1.2


@dataclass
class Control:
    """A control with its range; `length` in bytes, signed ones are all 16 bits."""

    value: int
    low: int
    high: int
    step: int
    length: int
    default: int = field(init=False)

    def __post_init__(self):
        self.default = self.value

    def packed(self, value):
        return value.to_bytes(self.length, "little", signed=value < 0)


def _controls():
    return {
        AE_MODE: Control(APERTURE_PRIORITY, 0, MANUAL | APERTURE_PRIORITY, MANUAL | APERTURE_PRIORITY, 1),
        AE_PRIORITY: Control(1, 0, 1, 1, 1),
        EXPOSURE: Control(157, 3, 2047, 1, 4),
        FOCUS: Control(30, 0, 250, 5, 2),
        AUTO_FOCUS: Control(1, 0, 1, 1, 1),
        BACKLIGHT: Control(1, 0, 2, 1, 2),
        BRIGHTNESS: Control(0, -64, 64, 1, 2),
        CONTRAST: Control(32, 0, 64, 1, 2),
        GAIN: Control(16, 0, 100, 1, 2),
        POWER_LINE: Control(2, 0, 2, 1, 1),
        SHARPNESS: Control(3, 0, 6, 1, 2),
        WHITE_BALANCE: Control(4600, 2800, 6500, 10, 2),
        AUTO_WHITE_BALANCE: Control(1, 0, 1, 1, 1),
    }


class _VideoControl(Interface):
    bInterfaceClass, bInterfaceSubClass = 0x0E, 1

    def __init__(self):
        super().__init__()
        self.controls = _controls()
        self.received, self.refused = [], []

    def extra_descriptors(self):
        # bmControls: the positions of the controls above in tables 3-6 and 3-8.
        camera = struct.pack("<BBBBHBBHHHB3s", 18, 0x24, 2, CAMERA, 0x0201, 0, 0, 0, 0, 0, 3, b"\x2e\x00\x02")
        unit = struct.pack("<BBBBBHBHB", 11, 0x24, 5, PROCESSING, CAMERA, 0, 2, 0x1753, 0)
        output = struct.pack("<BBBBHBBB", 9, 0x24, 3, OUTPUT, 0x0101, 0, PROCESSING, 0)
        total = 13 + len(camera) + len(unit) + len(output)
        header = struct.pack(
            "<BBBHHIBB", 13, 0x24, 1, 0x0100, total, 48_000_000, 1, self.interface_number + 1
        )
        return header + camera + unit + output

    def on_control(self, setup, data=b""):
        key = (setup.wIndex >> 8, setup.wValue >> 8)
        control = self.controls.get(key)
        if control is None:
            raise Stall
        if setup.bRequest == SET_CUR:
            value = int.from_bytes(data, "little", signed=control.low < 0)
            self.received.append((key, value, len(data)))
            allowed = (
                value in (MANUAL, APERTURE_PRIORITY)
                if key == AE_MODE
                else control.low <= value <= control.high
            )
            if len(data) != control.length or not allowed or self._by_itself(key):
                self.refused.append((key, value, len(data)))
                raise Stall
            control.value = value
            return b""
        if setup.bRequest == GET_LEN:
            return control.length.to_bytes(2, "little")
        if setup.bRequest == GET_INFO:
            return bytes([0x03 | (0x04 if self._by_itself(key) else 0)])
        values = {GET_CUR: control.value, GET_MIN: control.low, GET_MAX: control.high}
        values |= {GET_RES: control.step, GET_DEF: control.default}
        if setup.bRequest not in values:
            raise Stall
        return control.packed(values[setup.bRequest])

    def _by_itself(self, key):
        """Whether an automatic has the control now."""
        return (
            (key == EXPOSURE and self.controls[AE_MODE].value != MANUAL)
            or (key == FOCUS and self.controls[AUTO_FOCUS].value == 1)
            or (key == WHITE_BALANCE and self.controls[AUTO_WHITE_BALANCE].value == 1)
        )


class _VideoStreaming(Interface):
    bInterfaceClass, bInterfaceSubClass = 0x0E, 2
    video = In(0x81, "iso", mps=_PACKET_BYTES, interval=4)

    def __init__(self, picture):
        super().__init__()
        self.broken = set()
        self.number = 0
        self._picture = picture
        self._negotiated = {_PROBE: (1, _INTERVALS_100NS[0]), _COMMIT: (1, _INTERVALS_100NS[0])}
        self._streaming = False

    def descriptor_block(self):
        formats = struct.pack("<BBBBB16sBBBBBB", 27, 0x24, 4, 1, 1, _YUY2, 16, 1, 0, 0, 0, 0) + self._frame(5)
        formats += struct.pack("<BBBBBBBBBBB", 11, 0x24, 6, 2, 1, 0, 1, 0, 0, 0, 0) + self._frame(7)
        colour = struct.pack("<BBBBBB", 6, 0x24, 0x0D, 1, 1, 4)
        formats += colour
        header = struct.pack(
            "<BBBBHBBBBBBBBB", 15, 0x24, 1, 2, 15 + len(formats), 0x81, 0, OUTPUT, 0, 0, 0, 1, 0, 0
        )
        endpoint = struct.pack("<BBBBHB", 7, 5, 0x81, 5, 1024 | 2 << 11, 4)
        number = self.interface_number
        idle = struct.pack("<BBBBBBBBB", 9, 4, number, 0, 0, 0x0E, 2, 0, 0)
        busy = struct.pack("<BBBBBBBBB", 9, 4, number, 1, 1, 0x0E, 2, 0, 0)
        return idle + header + formats + busy + endpoint

    @staticmethod
    def _frame(subtype):
        width, height = _SIZE
        size = 2 * width * height
        rate = size * 8 * 30
        n = len(_INTERVALS_100NS)
        fields = (
            26 + 4 * n,
            0x24,
            subtype,
            1,
            0,
            width,
            height,
            rate // 3,
            rate,
            size,
            _INTERVALS_100NS[0],
            n,
        )
        return struct.pack("<BBBBBHHIIIIB", *fields) + struct.pack(f"<{n}I", *_INTERVALS_100NS)

    def on_control(self, setup, data=b""):
        selector = setup.wValue >> 8
        if selector not in self._negotiated:
            raise Stall
        if setup.bRequest == SET_CUR:
            wanted = struct.unpack_from("<I", data, 4)[0]
            interval = min(_INTERVALS_100NS, key=lambda known: abs(known - wanted))
            self._negotiated[selector] = (data[2] if data[2] in (1, 2) else 1, interval)
            return b""
        if setup.bRequest == GET_LEN:
            return _PROBE_BYTES.to_bytes(2, "little")
        if setup.bRequest == GET_INFO:
            return b"\x03"
        kind, interval = self._negotiated[selector]
        size = 2 * _SIZE[0] * _SIZE[1]
        return struct.pack("<HBBIHHHHHII", 1, kind, 1, interval, 0, 0, 0, 0, 0, size, _PACKET_BYTES)

    def set_alt(self, alt):
        self._streaming = alt == 1
        self._slot_s = self._next_frame_s = time.monotonic()
        self._rest, self._mark = b"", 0

    def on_iso(self, endpoint, lengths):
        """One packet a millisecond: part of a frame, or nothing while the next one is not due."""
        packets = []
        for _ in lengths if self._streaming else ():
            self._slot_s += 0.001
            if not self._rest and self._slot_s >= self._next_frame_s:
                self._begin_frame()
            packets.append(self._packet())
        ahead_s = self._slot_s - time.monotonic()
        if ahead_s > 0:
            time.sleep(ahead_s)
        elif ahead_s < -0.1:  # an emulated machine that cannot keep up loses time, not order
            self._slot_s -= ahead_s
            self._next_frame_s = max(self._next_frame_s, self._slot_s)
        return packets

    def _begin_frame(self):
        kind, interval = self._negotiated[_COMMIT]
        self.number += 1
        rgb = self._picture(self._next_frame_s)
        self._rest = _yuyv(rgb) if kind == 1 else cv2.imencode(".jpg", rgb[..., ::-1])[1].tobytes()
        self._mark ^= 1
        self._next_frame_s += interval * 1e-7

    def _packet(self):
        if not self._rest:
            return b""
        part, self._rest = self._rest[: _PACKET_BYTES - 2], self._rest[_PACKET_BYTES - 2 :]
        flags = self._mark | (0 if self._rest else _END_OF_FRAME)
        return bytes([2, flags | (_ERROR if self.number in self.broken else 0)]) + part


_YUY2 = bytes.fromhex("5955593200001000800000aa00389b71")


class _Video(Function):
    iad, iad_class, iad_subclass = True, 0x0E, 3
    device_triple = (0xEF, 2, 1)

    def __init__(self, control, streaming):
        self.interfaces = (control, streaming)
        super().__init__()


class UvcCamera:
    """The camera.

    Attributes:
        device: To be plugged in.
        received: ((entity, selector), value, bytes) of each SET_CUR so far.
        refused: Those among them that the camera stalled.
        lamp: Gives [(on_s, off_s)] of a lamp's pulses by CLOCK_MONOTONIC.
    """

    def __init__(self, serial="0001", readout_s=0.02):
        self._control = _VideoControl()
        self._streaming = _VideoStreaming(self._picture)
        self.received, self.refused = self._control.received, self._control.refused
        self.lamp = list
        self._readout_s = readout_s
        self._settings = []
        self.device = USBDevice(0x1209, 0x0002, product="Grey Wedge", manufacturer="Tests", serial=serial)
        self.device.set_speed(core.SPEED_HIGH)
        self.device.add(_Video(self._control, self._streaming))
        self._noise = np.random.default_rng(5).normal(0, NOISE, (8, *_SIZE[::-1])).astype(np.float32)
        column = np.linspace(0.05, 0.6, _SIZE[0], dtype=np.float32)
        self._scene = np.broadcast_to(column, _SIZE[::-1])

    def value(self, key):
        """What the camera has now."""
        return self._control.controls[key].value

    def settings(self):
        """What it has of what a lock sets."""
        return {key: self.value(key) for key in LOCKED}

    def break_frames(self, *ahead):
        """The camera marks frames to come as damaged; 1 = the next but one."""
        self._streaming.broken.update(self._streaming.number + one for one in ahead)

    def turn(self, key, value):
        """Somebody else changes a control at the camera."""
        self._control.controls[key].value = value

    def _picture(self, start_s):
        automatic = self.value(AE_MODE) != MANUAL
        self._settings.append(
            (300.0 if automatic else self.value(EXPOSURE), 16 if automatic else self.value(GAIN))
        )
        exposure, gain = self._settings[-1 - LATENCY_FRAMES :][0]
        exposure_s = exposure * 1e-4
        rows_s = start_s - AGE_S + np.arange(_SIZE[1], dtype=np.float64) / _SIZE[1] * self._readout_s
        lit_s = np.zeros(_SIZE[1])
        for on_s, off_s in self.lamp():
            lit_s += np.clip(np.minimum(rows_s + exposure_s, off_s) - np.maximum(rows_s, on_s), 0, None)
        light = self._scene * ((exposure_s + 2.0 * lit_s)[:, None] / 0.01) * (gain / 16)
        linear = np.clip(light, 0, 1)
        grey = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
        noise = self._noise[self._streaming.number % len(self._noise)]
        code = np.rint(np.clip(grey * 255 + noise, 0, 255)).astype(np.uint8)
        return np.repeat(code[..., None], 3, axis=-1)


def video_node():
    """The camera's node; the driver makes another one, for metadata. None = not yet."""
    for entry in Path("/sys/class/video4linux").glob("video*"):
        if "Grey Wedge" in (entry / "name").read_text() and (entry / "index").read_text() == "0\n":
            return f"/dev/{entry.name}"
    return None


def _yuyv(rgb):
    """YUYV by BT.601, 16..235, of a grey picture."""
    luma = np.rint(16 + rgb[..., 0] * (219 / 255)).astype(np.uint8)
    return np.stack([luma, np.full_like(luma, 128)], axis=-1).tobytes()
