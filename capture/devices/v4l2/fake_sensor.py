"""The sensor of the fake V4L2 driver: a small scene, exposed row by row, in the bytes of a format."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from capture.devices.motion_jpeg import strip_huffman_tables
from capture.devices.raw_mosaic import MOSAICS
from capture.transfer import to_display

#: The scene is computed with about this many rows and enlarged to the size of the stream.
_ROWS = 90
#: Exposure and gain that give the scene its radiance of 1.
_UNIT_EXPOSURE_S, _UNIT_GAIN = 0.010, 32
#: Electrons at white, and of the dark signal's noise.
_FULL_WELL_E, _READ_NOISE_E = 6000.0, 3.0
#: Of the room's light; another white balance turns the picture blue or red.
_ROOM_K = 4000.0
_STEPS = 4095


@dataclass(frozen=True)
class SensorState:
    """What the sensor does in one frame.

    Attributes:
        exposure_s: Of each row.
        gain: In the control's units.
        white_balance_k: Kelvin.
    """

    exposure_s: float
    gain: float
    white_balance_k: float


class FakeSensor:
    """A head before a wall, in the light of a room and of a lamp."""

    def __init__(self, width: int, height: int, seed: int, readout_s: float) -> None:
        """Makes the scene.

        Args:
            width: Of the stream, pixels.
            height: Likewise.
            seed: Of scene and noise.
            readout_s: From the first row's start to the last one's.
        """
        self.width, self.height = width, height
        self._seed, self._readout_s = seed, readout_s
        rows = min(height, _ROWS)
        columns = max(2, round(width * rows / height))
        self._room, self._lamp = _scene(columns, rows, seed)
        # Frames take their noise from places of one large field: as good, and a tenth of the time.
        shape = (2 * rows, 2 * columns, 3)
        self._noise = np.random.default_rng([seed, 13]).standard_normal(shape, dtype=np.float32)
        self._table = np.rint(255 * to_display(np.arange(_STEPS + 1) / _STEPS, "srgb")).astype(np.uint8)

    def light(
        self, index: int, start_s: float, state: SensorState, pulses: list[tuple[float, float]]
    ) -> NDArray[np.float32]:
        """Linear picture [h, w, 3], reduced, noisy, clipped to 0..1.

        Args:
            index: Of the frame; its noise depends on that and the seed alone.
            start_s: When the first row begins to expose.
            state: Of the sensor.
            pulses: Of the lamp, [on_s, off_s).
        """
        rows = self._room.shape[0]
        begin = start_s + (np.arange(rows) + 0.5) / rows * self._readout_s
        end = begin + state.exposure_s
        lit_s = np.zeros(rows)
        for on_s, off_s in pulses:
            if on_s < end[-1] and off_s > begin[0]:
                lit_s += np.clip(np.minimum(end, off_s) - np.maximum(begin, on_s), 0.0, None)
        gain = gain_factor(state.gain) / _UNIT_EXPOSURE_S
        signal = self._room * np.float32(state.exposure_s * gain)
        if lit_s.any():
            signal = signal + self._lamp * (lit_s * gain).astype(np.float32)[:, None, None]
        red = (state.white_balance_k / _ROOM_K) ** 0.5
        signal = signal * np.array([red, 1.0, 1.0 / red], np.float32)
        rng = np.random.default_rng([self._seed, 11, index])
        y, x = (int(rng.integers(0, side + 1)) for side in self._room.shape[:2])
        noise = self._noise[y : y + self._room.shape[0], x : x + self._room.shape[1]]
        variance = signal * np.float32(1 / _FULL_WELL_E) + np.float32((_READ_NOISE_E / _FULL_WELL_E) ** 2)
        noisy = signal + np.sqrt(variance) * noise
        return np.asarray(np.clip(noisy, 0.0, 1.0, out=noisy), dtype=np.float32)

    def encode(self, light: NDArray[np.float32], pixel_format: str) -> bytes:
        """The frame in a format's bytes: sRGB, BT.601, limited range; raw formats linear."""
        size = (self.width, self.height)
        if pixel_format in MOSAICS:
            return _mosaic(_enlarged(light, size), pixel_format)
        rgb = self._table[np.rint(light * _STEPS).astype(np.uint16)]
        if pixel_format == "MJPG":
            bgr = _enlarged(rgb[:, :, ::-1].copy(), size)
            data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes()
            return strip_huffman_tables(data)
        luma, blue, red = _yuv(rgb)
        luma = _enlarged(luma, size)
        if pixel_format == "GREY":
            return bytes(luma.tobytes())
        half = (self.width // 2, self.height // (2 if pixel_format == "NV12" else 1))
        chroma = _enlarged(np.dstack([blue, red]), half)
        if pixel_format == "NV12":
            return luma.tobytes() + chroma.tobytes()
        packed = np.empty((self.height, half[0], 4), np.uint8)
        packed[:, :, 0::2] = luma.reshape(self.height, half[0], 2)
        packed[:, :, 1::2] = chroma
        return packed.tobytes()


def gain_factor(gain: float) -> float:
    """How much brighter than at the unit gain."""
    return (1.0 + gain / 64.0) / (1.0 + _UNIT_GAIN / 64.0)


def _scene(columns: int, rows: int, seed: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(light of the room, light of the lamp) [h, w, 3] that a white-clipping exposure would call 1."""
    rng = np.random.default_rng([seed, 7])
    y, x = np.mgrid[0:rows, 0:columns].astype(np.float32) / rows
    x -= columns / rows / 2
    y -= 0.5
    texture = rng.normal(0.0, 1.0, (9, 16)).astype(np.float32)
    wall = 0.16 * (1.0 + 0.3 * cv2.resize(texture, (columns, rows), interpolation=cv2.INTER_CUBIC))
    room = np.clip(wall, 0.03, None)[:, :, None] * np.array([1.0, 0.95, 0.85], np.float32)
    lamp = 0.15 * room
    distance = (x / 0.28) ** 2 + ((y + 0.02) / 0.38) ** 2
    height = np.sqrt(np.clip(1.0 - distance, 0.0, None))[:, :, None]
    skin = np.array([0.42, 0.28, 0.20], np.float32)
    inside = distance < 1.0
    room[inside] = (skin * (0.35 + 0.65 * height))[inside]
    lamp[inside] = (1.2 * skin * height)[inside]
    return room.astype(np.float32), lamp.astype(np.float32)


def _yuv(rgb: NDArray[np.uint8]) -> list[NDArray[np.uint8]]:
    """Limited-range BT.601 planes (ITU-R BT.601-7)."""
    luma = np.array([0.299, 0.587, 0.114])
    blue, red = (np.eye(3)[2] - luma) / 1.772, (np.eye(3)[0] - luma) / 1.402
    matrix = np.hstack([np.stack([219 * luma, 224 * blue, 224 * red]) / 255, [[16.0], [128.0], [128.0]]])
    planes = np.rint(cv2.transform(rgb.astype(np.float32), matrix.astype(np.float32))).astype(np.uint8)
    return [np.ascontiguousarray(planes[:, :, index]) for index in range(3)]


def _enlarged(picture: NDArray[Any], size: tuple[int, int]) -> NDArray[Any]:
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_LINEAR))


def _mosaic(light: NDArray[np.float32], pixel_format: str) -> bytes:
    mosaic = MOSAICS[pixel_format]
    samples = np.empty(light.shape[:2], np.float32)
    for place, colour in enumerate(mosaic.pattern):
        y, x = divmod(place, 2)
        samples[y::2, x::2] = light[y::2, x::2, "RGB".index(colour)]
    codes = np.rint(samples * ((1 << mosaic.bits) - 1))
    return codes.astype(np.uint8 if mosaic.bits == 8 else "<u2").tobytes()
