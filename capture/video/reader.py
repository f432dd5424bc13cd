"""Streaming reader of video files, by the stream's own clock and tags; one frame is in memory at a time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from fractions import Fraction
from pathlib import Path

import av
from av.container import InputContainer
from av.stream import Disposition
from av.video.frame import VideoFrame
from av.video.stream import VideoStream

from capture.errors import SourceError
from capture.video.colour import VideoColour, bit_depth, colour_of_frame

# Only containers that phones write, and only the file itself: FFmpeg would otherwise follow playlists to
# other files and addresses, and take text for video.
_INPUT_OPTIONS = {
    "format_whitelist": "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpegts",
    "protocol_whitelist": "file",
}
_LARGEST_PIXELS = 1 << 26
_LOCATION_KEYS = ("location", "location-eng", "com.apple.quicktime.location.ISO6709")
_DEVICE_KEYS = {
    "com.android.manufacturer": "make",
    "com.android.model": "model",
    "com.android.version": "android_version",
    "com.android.capture.fps": "capture_fps",
    "make": "make",
    "model": "model",
}


@dataclass(frozen=True)
class VideoInfo:
    """What a video file says of itself.

    Attributes:
        path: the file.
        width: of the stored picture, pixels.
        height: of the stored picture, pixels.
        rotation_deg: clockwise turn to upright: 0, 90, 180 or 270.
        codec: FFmpeg's name of it, as "h264".
        bits: per sample.
        colour: matrix, range, transfer, primaries, and what was decided about them.
        time_base_s: one tick of the stream's clock.
        start_s: time of the first frame by the stream's clock.
        duration_s: by the header.
        header_frames: number of frames by the header, 0 = not said.
        creation_time: as written in the file; Android writes the END of the recording. None = absent or
            impossible.
        location: where it was recorded (ISO 6709), if the file says so. Private.
        device: make, model and such, where the file names them.
    """

    path: Path
    width: int
    height: int
    rotation_deg: int
    codec: str
    bits: int
    colour: VideoColour
    time_base_s: float
    start_s: float
    duration_s: float
    header_frames: int
    creation_time: datetime | None
    location: str | None = field(repr=False)
    device: dict[str, str]

    @property
    def frame_interval_s(self) -> float:
        """Mean time from one frame to the next by the header; 1/30 s where the header is silent."""
        if self.header_frames > 0 and self.duration_s > 0:
            return self.duration_s / self.header_frames
        return 1.0 / 30.0


@dataclass(frozen=True, eq=False)
class DecodedFrame:
    """One frame of a file.

    Attributes:
        number: its place in the file, from 0.
        pts_s: by the stream's clock; strictly increasing.
        picture: planar YUV; see `capture.video_colour`.
        damaged: the decoder patched over missing or broken data.
    """

    number: int
    pts_s: float
    picture: VideoFrame
    damaged: bool


def probe_video(path: Path) -> VideoInfo:
    """Reads the header and the first frame of a video file.

    Raises:
        SourceError: missing, no video, unfinished, damaged from the first frame on, HDR, or an exotic pixel
            format.
    """
    path = Path(path)
    with _open(path) as container:
        stream = _video_stream(container, path)
        for _, frames in _decoded_packets(container, stream):
            for frame in frames:
                return _info(path, container, stream, frame)
    raise SourceError(
        f"{path} has a video track of which no frame can be decoded; it is cut off or damaged, copy it again."
    )


def decode_video(info: VideoInfo, problems: list[str] | None = None) -> Iterator[DecodedFrame]:
    """All frames of a file in display order, one at a time.

    Args:
        info: from `probe_video`.
        problems: at the end, a sentence is appended for what was wrong: cut off, damaged, bad times.

    Raises:
        SourceError: the file is gone, or the picture changes its size on the way.
    """
    name = info.path.name
    number = broken_packets = damaged_frames = untimed = disordered = 0
    last_s: float | None = None
    with _open(info.path) as container:
        stream = _video_stream(container, info.path)
        stream.thread_type = "AUTO"
        for packet_broken, frames in _decoded_packets(container, stream):
            broken_packets += packet_broken
            for frame in frames:
                if (frame.width, frame.height) != (info.width, info.height):
                    raise SourceError(
                        f"{name} changes its size from {info.width} x {info.height} to {frame.width} x "
                        f"{frame.height} at frame {number}; cut it there into two files."
                    )
                ticks = frame.pts if frame.pts is not None else frame.dts
                untimed += ticks is None
                if ticks is not None:
                    pts_s = ticks * info.time_base_s
                else:
                    pts_s = info.start_s if last_s is None else last_s + info.frame_interval_s
                if last_s is not None and pts_s <= last_s:
                    disordered += 1
                    pts_s = last_s + info.time_base_s
                damaged = bool(frame.is_corrupt)
                damaged_frames += damaged
                yield DecodedFrame(number, pts_s, frame, damaged)
                last_s = pts_s
                number += 1
    if problems is None:
        return
    if number < info.header_frames:
        problems.append(
            f"{name} is cut off or damaged: {number} of its {info.header_frames} frames could be read, which "
            "are used."
        )
    if broken_packets or damaged_frames:
        problems.append(
            f"{name} is damaged: {damaged_frames} frames are partly broken and {broken_packets} packets of "
            "data could not be decoded; none of these is used."
        )
    if untimed:
        problems.append(
            f"{name} gives no time for {untimed} frames; the mean frame interval was used for them."
        )
    if disordered:
        problems.append(
            f"{name} has {disordered} frames that are not later than the one before; check its times."
        )


def _open(path: Path) -> InputContainer:
    if not path.is_file():
        raise SourceError(f"{path} does not exist or is no file; give the path of a video.")
    try:
        return av.open(str(path.absolute()), "r", options=_INPUT_OPTIONS, metadata_errors="replace")
    except (av.FFmpegError, OSError, UnicodeError) as error:
        raise SourceError(f"{path} cannot be read: {_why_unreadable(path)}.") from error


def _why_unreadable(path: Path) -> str:
    """What is wrong with a file that FFmpeg does not open."""
    with path.open("rb") as file:
        head = file.read(12)
    if not head:
        return "it is empty; copy it again from the phone"
    if head[4:8] == b"ftyp":
        return (
            "its index (moov) is missing or damaged, as when the recording or the copy was cut off; "
            "copy it again from the phone or repair it with an mp4 recovery tool"
        )
    return "it is no mp4, 3gp, webm, avi or ts video, or its beginning is damaged"


def _video_stream(container: InputContainer, path: Path) -> VideoStream:
    for stream in container.streams.video:
        if not stream.disposition & Disposition.attached_pic:
            if stream.codec_context is None:
                raise SourceError(f"{path} is coded in a way that is not known here; it may be damaged.")
            if stream.codec_context.width * stream.codec_context.height > _LARGEST_PIXELS:
                raise SourceError(
                    f"{path} claims pictures of more than {_LARGEST_PIXELS} pixels; it is damaged."
                )
            return stream
    kinds = ", ".join(sorted({stream.type for stream in container.streams})) or "none"
    raise SourceError(
        f"{path} has no video track (its tracks: {kinds}); give the file that the camera recorded."
    )


def _decoded_packets(
    container: InputContainer, stream: VideoStream
) -> Iterator[tuple[bool, list[VideoFrame]]]:
    """(packet was broken, its frames) until the data end, wherever that is."""
    packets = container.demux(stream)
    while True:
        try:
            packet = next(packets)
        except StopIteration:
            return
        except av.FFmpegError:
            yield True, []
            return
        if packet.is_corrupt:
            yield True, []
            continue
        try:
            yield False, packet.decode()
        except av.FFmpegError:
            yield True, []


def _info(path: Path, container: InputContainer, stream: VideoStream, frame: VideoFrame) -> VideoInfo:
    time_base_s = float(stream.time_base or Fraction(1, av.time_base))
    if stream.duration is not None:
        duration_s = stream.duration * time_base_s
    else:
        duration_s = (container.duration or 0) / av.time_base
    metadata = {**stream.metadata, **container.metadata}
    return VideoInfo(
        path=path,
        width=frame.width,
        height=frame.height,
        rotation_deg=-round(frame.rotation / 90) * 90 % 360,
        codec=stream.codec_context.name,
        bits=bit_depth(frame),
        colour=colour_of_frame(frame, path.name),
        time_base_s=time_base_s,
        start_s=(frame.pts or 0) * time_base_s,
        duration_s=max(duration_s, 0.0),
        header_frames=max(stream.frames, 0),
        creation_time=_creation_time(metadata.get("creation_time", "")),
        location=next((metadata[key] for key in _LOCATION_KEYS if key in metadata), None),
        device={name: metadata[key] for key, name in _DEVICE_KEYS.items() if key in metadata},
    )


def _creation_time(text: str) -> datetime | None:
    """The time of an mp4 header; None for none and for a clock that was never set (1904, 1970)."""
    try:
        time = datetime.fromisoformat(text)
    except ValueError:
        return None
    time = time if time.tzinfo else time.replace(tzinfo=UTC)
    return time if time.year >= 2000 else None
