"""Each frame is looked at once, in small: for the tags, for what is shown, for what stops a capture."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from capture.devices.camera import CapturedFrame, StreamFormat
from capture.devices.flash import FlashEdge
from capture.devices.pixel_formats import (
    YUV_FORMATS,
    Chroma,
    FrameDataError,
    decode_rgb,
    luma_levels,
    small_planes,
    yuv_of_rgb,
)
from capture.frame_record import FrameRecord
from capture.selection import measure_sharpness
from capture.tagging import FrameTag, TaggingConfig
from capture.tagging.stream import StreamTagger
from capture.tagging.stream_summary import StreamResult
from capture.tagging.watch import PulseStatus
from capture.transfer import to_linear

#: Short side of the small picture, at least.
SMALL_SIDE = 480
_METER_STRIDE = 4  # of the small picture, for the meters


@dataclass(frozen=True, eq=False)
class LookedFrame:
    """A frame in small, for whoever watches the capture.

    Attributes:
        index: Of the frame.
        pts_s: On the frames' axis.
        sequence: The camera's count.
        luma: [h, w] uint8 or uint16, code values.
        level: Mean linear light, 1 = white.
        clipped: Share of the picture at white.
        sharpness: See `capture.selection`.
    """

    index: int
    pts_s: float
    sequence: int
    luma: NDArray[Any]
    level: float
    clipped: float
    sharpness: float
    small: NDArray[Any]
    chroma: Chroma | None
    stream_format: StreamFormat

    @cached_property
    def shown(self) -> NDArray[np.uint8]:
        """[h, w] display values of the luma, full range."""
        luma = self._eight_bits(self.luma)
        black, white = luma_levels(self.stream_format) or (0.0, 255.0)
        if (black, white) == (0.0, 255.0) or self.small.ndim == 3:
            return luma
        return np.asarray(cv2.LUT(luma, _stretch(black, white)), np.uint8)

    @cached_property
    def rgb(self) -> NDArray[np.uint8]:
        """[h, w, 3] R'G'B'; computed when it is asked for."""
        if self.small.ndim == 3:
            return self._eight_bits(self.small)
        if self.chroma is None:
            return np.asarray(cv2.cvtColor(self._eight_bits(self.small), cv2.COLOR_GRAY2RGB), np.uint8)
        height, width = self.small.shape
        height, width = height - height % 2, width - width % 2
        halved = self.chroma[0].shape[0] < self.small.shape[0]
        planes = [self.small[:height, :width]]
        planes += [plane[: height // (2 if halved else 1), : width // 2] for plane in self.chroma]
        name = "YU12" if halved else "422P"
        packed = b"".join(np.ascontiguousarray(plane).tobytes() for plane in planes)
        small_format = replace(
            self.stream_format, width=width, height=height, pixel_format=name, stride_bytes=0
        )
        return np.asarray(decode_rgb(packed, small_format), np.uint8)

    def _eight_bits(self, picture: NDArray[Any]) -> NDArray[np.uint8]:
        if picture.dtype == np.uint8:
            return picture
        shown = (
            np.sqrt(picture / np.float32(65535))
            if self.stream_format.transfer == "linear"
            else picture / 65535
        )
        return (255 * shown).astype(np.uint8)


def _stretch(black: float, white: float) -> NDArray[np.uint8]:
    """Table from code values to full range."""
    return np.clip(np.round((np.arange(256) - black) * 255.0 / (white - black)), 0, 255).astype(np.uint8)


class Watch(Protocol):
    """Who is shown the capture while it goes on: a panel in the terminal, a page in the browser."""

    def frame(self, frame: LookedFrame, waiting: int) -> None:
        """Each frame that could be read, and how many wait to be written."""

    def edges(self, edges: Sequence[FlashEdge]) -> None:
        """The flash's edges as they are reported, on the frames' axis."""

    def say(self, sentence: str) -> None:
        """A warning as soon as it is known, or what takes time now."""


class FrameLooker:
    """Looks at frames and knows their tags, some seconds later."""

    def __init__(self, stream_format: StreamFormat, tagging: TaggingConfig, schedule_source: str) -> None:
        """Of a stream.

        Args:
            stream_format: What the camera delivers.
            tagging: What is known beforehand.
            schedule_source: Name of the flash, for messages.
        """
        self._format, self._tagging, self._source = stream_format, tagging, schedule_source
        self._tagger: StreamTagger | None = None
        self._indices = array("L")  # of the frames that the tagger knows, by its own count
        self._linear_of_code = self._meter_table()

    def look(self, index: int, pts_s: float, frame: CapturedFrame) -> LookedFrame | None:
        """The frame in small; None = its bytes are no picture."""
        try:
            small, chroma = small_planes(frame.data, self._format, SMALL_SIDE)
        except FrameDataError:
            return None
        return self.look_at(index, pts_s, frame.sequence, small, chroma)

    def look_at(
        self, index: int, pts_s: float, sequence: int, small: NDArray[Any], chroma: Chroma | None
    ) -> LookedFrame:
        """The same of a frame whose small picture is at hand."""
        if self._tagger is None:
            self._tagger = StreamTagger(
                small.shape[1],
                small.shape[0],
                transfer=self._format.transfer,
                levels=luma_levels(self._format),
                matrix=self._format.matrix,
                config=self._tagging,
                schedule_source=self._source,
            )
        self._tagger.add(small, pts_s, chroma=chroma)
        self._indices.append(index)
        luma: NDArray[Any] = small if small.ndim == 2 else np.asarray(cv2.cvtColor(small, cv2.COLOR_RGB2GRAY))
        codes = luma[::_METER_STRIDE, ::_METER_STRIDE]
        if codes.dtype != np.uint8:
            codes = (codes >> 8).astype(np.uint8)
        return LookedFrame(
            index=index,
            pts_s=pts_s,
            sequence=sequence,
            luma=luma,
            level=float(self._linear_of_code[codes].mean(dtype=np.float64)),
            clipped=float(np.mean(codes >= self._white)),
            sharpness=float(f"{measure_sharpness(luma):.4g}"),
            small=small,
            chroma=chroma,
            stream_format=self._format,
        )

    def look_again(self, record: FrameRecord, rgb: NDArray[np.uint8]) -> None:
        """A frame that the session has already: [H, W, 3] or [H, W]."""
        factor = max(1, min(rgb.shape[:2]) // SMALL_SIDE)
        size = (rgb.shape[1] // factor, rgb.shape[0] // factor)
        small = np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), np.uint8)
        levels, chroma = luma_levels(self._format), None
        if small.ndim == 3 and self._format.pixel_format in YUV_FORMATS:
            small, chroma = yuv_of_rgb(small, self._format.matrix, levels or (0.0, 255.0))
        self.look_at(record.index, record.pts_s or 0.0, record.sequence or 0, small, chroma)

    def expect(self, edges: Sequence[FlashEdge], on_s: float) -> None:
        """Edges that the flash has reported, on the frames' axis; its pulses are `on_s` long."""
        if self._tagger is not None:
            self._tagger.expect([edge.time_s for edge in edges if edge.on], on_s)

    def pulses(self) -> PulseStatus | None:
        """Whether pulses are seen; None before the first frame."""
        return None if self._tagger is None else self._tagger.pulse_status()

    def ready(self) -> dict[int, FrameTag]:
        """Tags by index of the frames that have become final; takes seconds at times, from any thread."""
        if self._tagger is None:
            return {}
        return {self._indices[position]: tag for position, tag in self._tagger.ready()}

    def finish(self) -> tuple[dict[int, FrameTag], StreamResult] | None:
        """The remaining tags, and what was learnt; None = there was no frame."""
        if self._tagger is None:
            return None
        result = self._tagger.finish()
        return {self._indices[position]: tag for position, tag in result.frames}, result

    def _meter_table(self) -> NDArray[np.float32]:
        black, white = luma_levels(self._format) or (0.0, 255.0)
        self._white = black + (white - black) * self._tagging.clip_display
        display = np.clip((np.arange(256) - black) / (white - black), 0, 1)
        return to_linear(display.astype(np.float32), self._format.transfer)
