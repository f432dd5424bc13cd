"""Writer of video files as phones write them, for simulators and tests."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import UTC, datetime
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Self, cast

import av
import numpy as np
from av.video.frame import VideoFrame
from av.video.stream import VideoStream
from numpy.typing import NDArray

from capture.errors import SourceError
from capture.video.colour import (
    MATRIX_CODES,
    PRIMARIES_CODES,
    RANGE_CODES,
    TRANSFER_CODES,
    default_matrix,
    fill_frame,
)

_ENCODERS = {"h264": "libx264", "hevc": "libx265"}
_TIME_BASE = Fraction(1, 90_000)  # what Android's MPEG4Writer uses for video
_ENCODER_THREADS = 2  # fixed, because the bytes depend on it
_CONTAINER_OPTIONS = {
    "video_track_timescale": "90000",
    "movie_timescale": "90000",  # of the start offset; phones write 1000, which rounds it to 1 ms
    "fflags": "+bitexact",
}


class VideoWriter:
    """Writes an mp4 as a phone does: H.264 or HEVC, frames at their own times, colour tags, rotation.

    The same calls give the same bytes. Use it as a context manager; when the body fails the unfinished file
    is removed.
    """

    def __init__(
        self,
        path: Path,
        width: int,
        height: int,
        *,
        codec: str = "h264",
        crf: float = 18.0,
        bit_rate: int | None = None,
        bits: int = 8,
        color_range: str | None = "limited",
        matrix: str | None = "bt709",
        transfer: str | None = "rec709",
        rotation_deg: int = 0,
        creation_time: datetime | None = None,
        location: str | None = None,
        preset: str = "veryfast",
        keyframe_interval: int = 30,
    ) -> None:
        """Open the file.

        Args:
            path: the mp4 to write; its folder must exist.
            width: of the stored picture, even.
            height: of the stored picture, even.
            codec: "h264" or "hevc".
            crf: constant quality, 0 (best) to 51; not used when `bit_rate` is given.
            bit_rate: bits per second.
            bits: 8 or 10 bits a sample.
            color_range: "limited" or "full"; None writes limited range without a tag.
            matrix: "bt601", "bt709" or "bt2020"; None writes without a tag, with the matrix that readers
                choose by size.
            transfer: tag only, the pixels are stored as given: "rec709", "srgb", "gamma:2.2", "gamma:2.8",
                "linear", "pq", "hlg", or None for no tag.
            rotation_deg: clockwise turn to upright: 0, 90, 180 or 270.
            creation_time: as Android writes it: the end of the recording, in UTC.
            location: ISO 6709 text as Android writes it into ©xyz ("+52.5200+013.4050/").
            preset: of x264 and x265: "ultrafast" to "veryslow".
            keyframe_interval: frames between two key frames; phones use one second.

        Raises:
            ValueError: an argument outside the values above.
            SourceError: the file cannot be created.
        """
        _require("codec", codec, _ENCODERS)
        _require("color_range", color_range, (None, *RANGE_CODES))
        _require("matrix", matrix, (None, *MATRIX_CODES))
        _require("transfer", transfer, (None, *TRANSFER_CODES))
        _require("rotation_deg", rotation_deg, (0, 90, 180, 270))
        _require("bits", bits, (8, 10))
        if min(width, height) < 16 or width % 2 or height % 2:
            raise ValueError(
                f"A video of {width} x {height} cannot be coded; both sides must be even and at least 16."
            )
        if creation_time is not None and creation_time.tzinfo is None:
            raise ValueError("creation_time needs a time zone, as datetime(..., tzinfo=UTC).")
        self.path = Path(path)
        self._size = (width, height)
        self._pixel_format = "yuv420p" if bits == 8 else "yuv420p10le"
        self._matrix = matrix or default_matrix(width, height)
        self._range = color_range or "limited"
        self._last_ticks: int | None = None
        self._last_duration = round(1 / 30 / float(_TIME_BASE))
        self._held: av.Packet[VideoStream] | None = None  # the last packet, until its duration is known
        options = {"preset": preset}
        if bit_rate is None:
            options["crf"] = f"{crf:g}"
        if codec == "h264":
            options["bf"] = "0"
        else:
            options["x265-params"] = f"log-level=none:bframes=0:pools={_ENCODER_THREADS}:frame-threads=1"
        try:
            self._container = av.open(str(self.path), "w", format="mp4", options=_CONTAINER_OPTIONS)
            if creation_time is not None:
                self._container.metadata["creation_time"] = (
                    f"{creation_time.astimezone(UTC):%Y-%m-%dT%H:%M:%SZ}"
                )
            if location is not None:
                self._container.metadata["location"] = location
            encoder = _ENCODERS[codec]
            self._stream = cast(VideoStream, self._container.add_stream(encoder, rate=30, options=options))
            self._stream.width, self._stream.height = width, height
            self._stream.pix_fmt = self._pixel_format
            if rotation_deg:
                self._stream.set_display_rotation(-rotation_deg)
            context = self._stream.codec_context
            context.time_base = _TIME_BASE
            context.gop_size = keyframe_interval
            context.thread_count = _ENCODER_THREADS
            if bit_rate is not None:
                context.bit_rate = bit_rate
            if codec == "hevc":
                context.codec_tag = "hvc1"
            context.color_range = RANGE_CODES[color_range] if color_range else 0
            context.colorspace = MATRIX_CODES[matrix] if matrix else 2
            context.color_primaries = PRIMARIES_CODES[matrix] if matrix else 2
            context.color_trc = TRANSFER_CODES[transfer] if transfer else 2
            self._container.start_encoding()
        except (av.FFmpegError, OSError) as error:
            raise SourceError(f"{self.path} cannot be written: {error}.") from error

    def write(self, rgb: NDArray[np.uint8], pts_s: float) -> None:
        """Append one frame.

        Args:
            rgb: [H, W, 3] uint8 display-referred.
            pts_s: its time; must be later than the frame before. Stored in 1/90000 s.
        """
        width, height = self._size
        if rgb.shape != (height, width, 3) or rgb.dtype != np.uint8:
            raise ValueError(
                f"A frame of {rgb.dtype} {list(rgb.shape)} does not fit the video; it must be uint8 "
                f"[{height}, {width}, 3]."
            )
        ticks = round(pts_s / float(_TIME_BASE))
        if ticks < 0 or (self._last_ticks is not None and ticks <= self._last_ticks):
            raise ValueError(f"The frame time {pts_s} s is negative or not later than the frame before.")
        if self._last_ticks is not None:
            self._last_duration = ticks - self._last_ticks
        self._last_ticks = ticks
        frame = VideoFrame(width, height, self._pixel_format)
        fill_frame(frame, rgb, self._matrix, self._range)
        frame.pts, frame.time_base = ticks, _TIME_BASE
        self._mux(frame)

    def close(self) -> None:
        """Finish the file; afterwards it can be read. The last frame lasts as long as the one before it."""
        self._mux(None)
        self._container.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            self.close()
        else:
            self._container.close()
            self.path.unlink(missing_ok=True)

    def _mux(self, frame: VideoFrame | None) -> None:
        try:
            for packet in self._stream.encode(frame):
                if self._held is not None:
                    self._container.mux(self._held)
                self._held = packet
            if frame is None and self._held is not None:
                self._held.duration = self._last_duration
                self._container.mux(self._held)
        except (av.FFmpegError, OSError) as error:
            raise SourceError(f"{self.path} cannot be written: {error}.") from error


def _require(name: str, value: object, choices: Iterable[object]) -> None:
    allowed = list(choices)
    if value not in allowed:
        raise ValueError(f"{name} is {value!r}; it must be one of {', '.join(map(repr, allowed))}.")
