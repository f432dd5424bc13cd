"""The files of one capture, joined on one time axis.

Open Camera names a video after the local time at which its recording started, VID_yyyyMMdd_HHmmss.mp4, and
begins a new file when one reaches the size or length that the user has set. The header's creation time is
the END of the recording, in UTC.

Files given together are one capture. A file given alone is joined with those after it in its folder only
when they are clearly its continuation: same prefix and format, and

* its name says that it starts when the one before ends, within the resolution of the names, and
* it is not larger than the first, as the remainder of a split is not.

A part that starts when the one before ends follows it without a gap; otherwise the gap is the one that the
names tell. The time axis is that of the first file, its start offset included.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

from capture.errors import SourceError
from capture.video import VideoInfo, probe_video

_NAME = re.compile(
    r"(?P<prefix>.*?)(?P<date>\d{8})_(?P<time>\d{6})(?P<milliseconds>\d{3})?(?P<zone>Z?)(?:_\d{1,2})?"
)
# Names have whole seconds; starting and stopping the recorder takes a few tenths more.
_SAME_MOMENT_S = 1.5
_LARGER_SHARE = 1.05
_MOST_PARTS = 1000


@dataclass(frozen=True)
class RecordingPart:
    """One file of a capture.

    Attributes:
        video: what the file says of itself.
        shift_s: to be added to its time stamps to have them on the capture's time axis.
    """

    video: VideoInfo
    shift_s: float

    @property
    def end_s(self) -> float:
        """When the last frame ends, on the capture's time axis."""
        return self.shift_s + self.video.start_s + self.video.duration_s


@dataclass(frozen=True)
class Recording:
    """A whole capture.

    Attributes:
        parts: in order of time.
        started: local time by the first name, without a zone; None = the name does not say.
        ended: creation time of the last part, UTC; None = not in the file.
        warnings: what was decided about the parts, a sentence each.
    """

    parts: tuple[RecordingPart, ...]
    started: datetime | None
    ended: datetime | None
    warnings: tuple[str, ...]


def start_by_name(path: Path) -> datetime | None:
    """Start of the recording as Open Camera writes it into a name; None = the name holds no possible time."""
    match = _NAME.fullmatch(path.stem)
    if match is None:
        return None
    try:
        start = datetime.strptime(match["date"] + match["time"], "%Y%m%d%H%M%S")
    except ValueError:
        return None
    return start + timedelta(milliseconds=int(match["milliseconds"] or 0))


def open_recording(sources: list[Path], *, join_split: bool = True) -> Recording:
    """Opens the files of one capture.

    Args:
        sources: one or more video files, in any order if their names tell the time.
        join_split: whether to look for the continuation of a single file.

    Raises:
        SourceError: a file that cannot be used, is given twice, or differs from the first in size, rotation,
            codec or colour; or parts that overlap in time.
    """
    if not sources:
        raise SourceError("No video was given; name at least one file.")
    paths = [Path(source) for source in sources]
    doubles = {path for path in paths if sum(other.resolve() == path.resolve() for other in paths) > 1}
    if doubles:
        raise SourceError(f"{min(doubles)} is given more than once; name each part of the capture once.")
    warnings: list[str] = []
    starts = [start_by_name(path) for path in paths]
    if all(start is not None for start in starts):
        paths.sort(key=lambda path: (start_by_name(path), path.name))
    videos = [probe_video(path) for path in paths]
    for video in videos[1:]:
        if difference := _difference(videos[0], video):
            raise SourceError(
                f"{video.path.name} and {videos[0].path.name} are no parts of one capture: {difference}; "
                "import them apart."
            )
    if len(videos) == 1 and join_split:
        videos += _continuations(videos[0], warnings)
    parts = [RecordingPart(videos[0], 0.0)]
    for video in videos[1:]:
        parts.append(_placed_after(parts, video, warnings))
    return Recording(
        parts=tuple(parts),
        started=start_by_name(videos[0].path),
        ended=videos[-1].creation_time,
        warnings=tuple(warnings),
    )


def _difference(first: VideoInfo, other: VideoInfo) -> str | None:
    """What tells two files apart that cannot be one capture."""
    for name, one, two in (
        ("size", f"{first.width} x {first.height}", f"{other.width} x {other.height}"),
        ("rotation", first.rotation_deg, other.rotation_deg),
        ("codec", first.codec, other.codec),
        ("bit depth", first.bits, other.bits),
        ("colour matrix", first.colour.matrix, other.colour.matrix),
        ("colour range", first.colour.color_range, other.colour.color_range),
        ("transfer", first.colour.transfer, other.colour.transfer),
    ):
        if one != two:
            return f"their {name} differs ({one} and {two})"
    return None


def _continuations(first: VideoInfo, warnings: list[str]) -> list[VideoInfo]:
    """The files that carry on where a file ends."""
    found: list[VideoInfo] = []
    last = first
    while len(found) < _MOST_PARTS:
        following = _continuation(first, last, warnings)
        if following is None:
            break
        found.append(following)
        last = following
    if found:
        names = ", ".join(video.path.name for video in found)
        warnings.append(f"{first.path.name} goes on in {names}, which was joined to it.")
    return found


def _continuation(first: VideoInfo, last: VideoInfo, warnings: list[str]) -> VideoInfo | None:
    start = start_by_name(last.path)
    name = _NAME.fullmatch(last.path.stem)
    if start is None or name is None:
        return None
    end = start + timedelta(seconds=last.duration_s)
    for path in sorted(last.path.parent.glob(f"*{last.path.suffix}")):
        other, other_start = _NAME.fullmatch(path.stem), start_by_name(path)
        if path == last.path or other is None or other_start is None or other_start <= start:
            continue
        if (other["prefix"], other["zone"]) != (name["prefix"], name["zone"]):
            continue
        if abs((other_start - end).total_seconds()) > _SAME_MOMENT_S:
            continue
        if path.stat().st_size > _LARGER_SHARE * first.path.stat().st_size:
            continue
        try:
            video = probe_video(path)
        except SourceError as error:
            warnings.append(f"{path.name} looks like the continuation but was left out: {error}")
            continue
        if _difference(first, video) is None:
            return video
    return None


def _placed_after(parts: list[RecordingPart], video: VideoInfo, warnings: list[str]) -> RecordingPart:
    previous = parts[-1]
    start, previous_start = start_by_name(video.path), start_by_name(previous.video.path)
    if start is None or previous_start is None:
        warnings.append(
            f"{video.path.name} was put right behind {previous.video.path.name}; their names do not "
            "tell the time between them."
        )
        gap_s = 0.0
    else:
        gap_s = (start - previous_start).total_seconds() - previous.video.duration_s
        if gap_s < -_SAME_MOMENT_S:
            raise SourceError(
                f"{video.path.name} starts {-gap_s:.1f} s before {previous.video.path.name} ends, by their "
                "names; they are no consecutive parts of one capture."
            )
        if gap_s > _SAME_MOMENT_S:
            warnings.append(
                f"Between {previous.video.path.name} and {video.path.name} {gap_s:.1f} s are missing."
            )
        else:
            gap_s = 0.0
    return RecordingPart(video, previous.end_s + gap_s - video.start_s)
