"""A recording as a camera: `replay:FOLDER_OR_VIDEO;rate=fast;loop=0;fps=30`.

    rate=real   frames come when they are due by the bench's clock (default)
    rate=fast   they come as fast as they are asked for
    loop=N      the recording is played N times more, its stamps going on; loop=forever has no end
    fps=F       of a folder, whose pictures have no times (default 30)

A folder's PNG and JPEG pictures come in the natural order of their names. A video's frames keep the times,
the colour tags and the rotation of the file. What a recording does not model: nothing can be set, frames are
never dropped when they are read late (they come late), and a picture that cannot be read is a gap in the
sequence, as a lost frame is.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, Self

import cv2
import numpy as np
from av.video.reformatter import VideoReformatter
from numpy.typing import NDArray

from capture.devices.bench import Bench
from capture.devices.camera import (
    CameraInfo,
    CameraProfile,
    CapturedFrame,
    ControlReport,
    LockReport,
    StreamFormat,
)
from capture.devices.url_options import parse_options
from capture.errors import (
    CameraEndedError,
    CameraError,
    CameraGoneError,
    CameraTimeoutError,
    ImageError,
    SourceError,
)
from capture.images import image_size, natural_order, read_image
from capture.video import decode_video, probe_video
from capture.video.colour import rgb_from_frame

_LOG = logging.getLogger(__name__)
_SETTINGS = {"rate": str, "loop": str, "fps": float}
_PICTURES = frozenset({".png", ".jpg", ".jpeg"})
_DEFAULT_FPS = 30.0
_FOREVER = -1


@dataclass(frozen=True, eq=False)
class RecordedFrame:
    """A frame of a recording.

    Attributes:
        number: Its place in the recording, from 0.
        stamp_s: From the recording's own clock; increasing.
        rgb: [H, W, 3], uint8 or uint16.
        damaged: The decoder patched over missing data.
    """

    number: int
    stamp_s: float
    rgb: NDArray[Any]
    damaged: bool = False


class Recording(Protocol):
    """Frames with their times."""

    @property
    def format(self) -> StreamFormat:
        """Of every frame."""

    @property
    def notes(self) -> tuple[str, ...]:
        """What was assumed where the recording says nothing."""

    def frames(self) -> Iterator[RecordedFrame]:
        """From the beginning; a frame that cannot be read is left out, its number too."""


class PictureFolder:
    """The PNG and JPEG pictures of a folder, at even times."""

    def __init__(self, folder: Path, fps: float) -> None:
        """Looks at the first picture; all must have its size."""
        files = [file for file in folder.iterdir() if file.suffix.lower() in _PICTURES and file.is_file()]
        if not files:
            raise CameraError(f"{folder} has no PNG or JPEG pictures; give a folder of frames, or a video.")
        self._files = sorted(files, key=lambda file: natural_order(file.name))
        self._fps = fps
        try:
            width, height = image_size(self._files[0])
        except ImageError as error:
            raise CameraError(str(error)) from error
        self.format = StreamFormat(width=width, height=height, pixel_format="RGB3", fps=fps)
        self.notes = (f"The pictures of {folder.name} have no times; {fps:g} a second are assumed.",)

    def frames(self) -> Iterator[RecordedFrame]:
        """One picture is in memory at a time."""
        for number, file in enumerate(self._files):
            try:
                picture = read_image(file)
            except ImageError as error:
                _LOG.warning("%s", error)
                continue
            height, width = picture.shape[:2]
            if (width, height) != (self.format.width, self.format.height):
                raise CameraError(
                    f"{file} has {width} x {height} pixels, but {self._files[0].name} has "
                    f"{self.format.width} x {self.format.height}; put pictures of one size into the folder."
                )
            rgb = cv2.cvtColor(picture, cv2.COLOR_GRAY2RGB) if picture.ndim == 2 else picture
            yield RecordedFrame(number, number / self._fps, np.asarray(rgb))


class VideoFile:
    """A video file, by its own time stamps and colour tags."""

    def __init__(self, file: Path) -> None:
        """Reads the header and the first frame."""
        try:
            self._info = probe_video(file)
        except SourceError as error:
            raise CameraError(str(error)) from error
        self.format = StreamFormat(
            width=self._info.width,
            height=self._info.height,
            pixel_format="RGB3",
            fps=1.0 / self._info.frame_interval_s,
            transfer=self._info.colour.transfer,
            rotation_deg=self._info.rotation_deg,
        )
        self.notes = self._info.colour.warnings

    def frames(self) -> Iterator[RecordedFrame]:
        """One frame is in memory at a time."""
        reformatter = VideoReformatter()
        try:
            for frame in decode_video(self._info):
                rgb = rgb_from_frame(frame.picture, self._info.colour, reformatter)
                yield RecordedFrame(frame.number, frame.pts_s, rgb, frame.damaged)
        except SourceError as error:
            raise CameraError(str(error)) from error


class ReplayCamera:
    """Plays a recording frame by frame; see the module for what it does not model.

    Attributes:
        ended: Whether `read` has found no further frame, which it says with `CameraEndedError`.
    """

    def __init__(
        self, url: str, name: str, recording: Recording, bench: Bench, *, real_time: bool, loops: int
    ) -> None:
        """Nothing is played before `lock`; `loops` more times, negative = without end."""
        self.info = CameraInfo(
            url=url,
            name=name,
            back_end="replay",
            details={"rate": "real" if real_time else "fast"},
            clock="own",
            stamp_at="unknown",
        )
        self.ended = False
        self._recording = recording
        self._bench = bench
        self._real_time = real_time
        self._loops = loops
        self._frames: Iterator[RecordedFrame] | None = None
        self._waiting: RecordedFrame | None = None
        self._failure: CameraError | None = None
        self._due_offset_s: float | None = None
        self._closed = False

    @property
    def format(self) -> StreamFormat:
        """What the recording holds; the profile cannot change it."""
        return self._recording.format

    def lock(self, profile: CameraProfile) -> LockReport:
        """Starts to play; whatever the profile asks for is reported as what cannot be set.

        No frame is dropped to settle: the recording is played from its first on.
        """
        self._require_open()
        if self._frames is None:
            self._frames = _played(self._recording, self._loops)
        warnings = list(self._recording.notes)
        asked, has = (profile.width, profile.height), (self.format.width, self.format.height)
        if profile.width is not None and asked != has:
            warnings.append(
                f"{self.info.name} has {has[0]} x {has[1]} pixels, not {asked[0]} x {asked[1]}; a recording "
                "is played as it is."
            )
        reports = self._reports(profile)
        warnings += [f"{report.name}: {report.note}." for report in reports if report.note]
        return LockReport(controls=reports, warnings=tuple(warnings))

    def _reports(self, profile: CameraProfile) -> tuple[ControlReport, ...]:
        note = "a recording cannot be set"
        reports = [
            ControlReport(name=name, requested=value, read_back=None, note=note)
            for name in ("exposure_s", "gain", "white_balance_k", "focus", "mains_hz")
            if (value := getattr(profile, name)) is not None
        ]
        fps = self.format.fps
        different = profile.fps is not None and fps is not None and abs(profile.fps - fps) > 0.01 * fps
        reports.append(
            ControlReport(name="fps", requested=profile.fps, read_back=fps, note=note if different else "")
        )
        return tuple(reports)

    def read(self, timeout_s: float) -> CapturedFrame:
        """The next frame, when it is due.

        Raises:
            CameraTimeoutError: It is due later than that; it is not lost.
            CameraEndedError: The recording is over (`ended`).
            CameraGoneError: The camera is closed.
            CameraError: Not locked yet, or the recording cannot be read any further.
        """
        self._require_open()
        if self._frames is None:
            raise CameraError(f"{self.info.name} does not play yet; lock it first.")
        frame = self._waiting = self._waiting or self._next(self._frames)
        if self._real_time:
            self._wait_until_due(frame.stamp_s, timeout_s)
        self._waiting = None
        return CapturedFrame(
            stamp_s=frame.stamp_s,
            sequence=frame.number,
            data=frame.rgb,
            arrival_s=self._bench.clock.now_s(),
            damaged=frame.damaged,
        )

    def _next(self, frames: Iterator[RecordedFrame]) -> RecordedFrame:
        if self._failure is not None:
            raise self._failure
        try:
            frame = next(frames, None)
        except CameraError as failure:
            self._failure = failure
            raise
        if frame is None:
            self.ended = True
            raise CameraEndedError(f"The recording {self.info.name} has ended; its last frame has been read.")
        return frame

    def _wait_until_due(self, stamp_s: float, timeout_s: float) -> None:
        clock = self._bench.clock
        if self._due_offset_s is None:
            self._due_offset_s = clock.now_s() - stamp_s
        wait_s = stamp_s + self._due_offset_s - clock.now_s()
        clock.sleep(min(wait_s, timeout_s))
        if wait_s > timeout_s:
            raise CameraTimeoutError(
                f"No frame of {self.info.name} is due within {timeout_s:g} s: the next one comes "
                f"{wait_s:.3g} s after the one before; wait longer, or replay it with rate=fast."
            )

    def check(self) -> tuple[ControlReport, ...]:
        """Nothing drifts in a recording."""
        self._require_open()
        return ()

    def restore(self) -> tuple[str, ...]:
        """Nothing was changed."""
        return ()

    def close(self) -> None:
        """Lets go of the files."""
        self._closed = True
        self._frames = self._waiting = None

    def _require_open(self) -> None:
        if self._closed:
            raise CameraGoneError(f"The recording {self.info.name} is closed; open it again to play it.")

    def __enter__(self) -> Self:
        """Itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Closes it."""
        self.close()


def open_camera(rest: str, bench: Bench) -> ReplayCamera:
    """The recording of `PATH;rate=...;loop=...;fps=...`.

    Raises:
        CameraError: It cannot be read, or a setting is not understood.
    """
    url = f"replay:{rest}"
    target, _, text = rest.partition(";")
    settings = parse_options(text, _SETTINGS, CameraError, scheme="replay")
    rate = settings.get("rate", "real")
    if rate not in ("real", "fast"):
        raise CameraError(f"rate={rate} of {url} is not understood; it is real or fast.")
    path = Path(target).expanduser()
    if not target or not path.exists():
        raise CameraError(f"{target or url} does not exist; give a folder of pictures or a video file.")
    recording = _open_recording(path, url, settings.get("fps"))
    return ReplayCamera(
        url, path.name, recording, bench, real_time=rate == "real", loops=_loops(url, settings.get("loop"))
    )


def list_cameras() -> tuple[str, ...]:
    """None: recordings are not plugged in."""
    return ()


def _open_recording(path: Path, url: str, fps: float | None) -> Recording:
    if fps is not None and not (math.isfinite(fps) and fps > 0):
        raise CameraError(f"fps={fps} of {url} is not understood; it is a positive number.")
    if path.is_dir():
        return PictureFolder(path, fps or _DEFAULT_FPS)
    if fps is not None:
        raise CameraError(f"{url} gives fps, but {path.name} is a video and has its own times; leave it out.")
    return VideoFile(path)


def _loops(url: str, text: str | None) -> int:
    if text is None:
        return 0
    if text == "forever":
        return _FOREVER
    if not text.isdecimal():
        raise CameraError(f"loop={text} of {url} is not understood; it is a number of times, or forever.")
    return int(text)


def _played(recording: Recording, loops: int) -> Iterator[RecordedFrame]:
    """The recording once, and `loops` times more, stamps and numbers going on; negative = without end."""
    interval_s = 1.0 / (recording.format.fps or _DEFAULT_FPS)
    played = number = 0
    shift_s = 0.0
    while loops < 0 or played <= loops:
        first_s: float | None = None
        for frame in recording.frames():
            yield RecordedFrame(number + frame.number, shift_s + frame.stamp_s, frame.rgb, frame.damaged)
            first_s = frame.stamp_s if first_s is None else first_s
            last_s, count = frame.stamp_s, frame.number + 1
        if first_s is None:
            return
        number += count
        shift_s += last_s - first_s + interval_s
        played += 1
