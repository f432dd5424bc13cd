"""The files that Open Camera and its fork OpenCamera-Sensors leave beside a video.

    VID_20261102_101530.mp4
    VID_20261102_101530.srt                                  date, time and perhaps place, every second
    20261102_101530/VID_20261102_101530_flash.csv            clock of each torch-on command, ns, one a line
    20261102_101530/VID_20261102_101530_imu_timestamps.csv   clock of each frame, ns, one a line
                                   (or ..._timestamps.csv)
    BACKUP_OC_*.xml                                          the app's settings

Both csv files count the same clock, so together they say in which frames the flash was asked to be on.
Exposure and gain are in none of these files.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from capture.errors import SourceError

_LARGEST_FILE = 1 << 26  # 64 MiB: frame times of more than a day
_CUE_TIMES = re.compile(
    r"(\d{1,3}):([0-5]\d):([0-5]\d)[,.](\d{3})\s*-->\s*(\d{1,3}):([0-5]\d):([0-5]\d)[,.](\d{3})"
)
_CLOCK = re.compile(r"\d{1,2}:\d{2}")
_DATE = re.compile(r"\d{1,4}[./-]\d{1,2}[./-]\d{1,4}")
_COORDINATES = re.compile(r"°|\d[.,]\d{3}")
_NANOSECONDS = re.compile(rb"\d{1,19}")
_LARGEST_LAG = 32  # frames that a log may start before or after the video
_AGREEMENT = 0.2
_CLOCK_JITTER_S = 2e-4  # a shift must agree better than another by more than the jitter of the time stamps


@dataclass(frozen=True)
class SidecarFiles:
    """Where the sidecars of one video are; None = there is none."""

    subtitles: Path | None
    flash_times: Path | None
    frame_times: Path | None
    settings: Path | None


@dataclass(frozen=True)
class Subtitles:
    """What an .srt says.

    Attributes:
        cues: their number.
        end_s: end of the last cue but one, which every video reaches; 0 with a single cue.
        clock_text: date and time of the first cue, as the phone's language writes it.
        place_text: the first cue's other lines, as coordinates. Private.
    """

    cues: int
    end_s: float
    clock_text: str | None
    place_text: str | None = field(repr=False)


@dataclass(frozen=True, eq=False)
class FrameClock:
    """The camera's clock tied to a video's time stamps.

    Attributes:
        origin_ns: clock at pts 0: pts_s = (clock_ns - origin_ns) / 1e9.
        frame_ns: clock of each frame; None where the log has no line for it.
        residual_s: median distance between the two times of a frame.
    """

    origin_ns: int
    frame_ns: tuple[int | None, ...]
    residual_s: float

    def pts_of(self, clock_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """Seconds on the video's time axis."""
        return np.asarray((clock_ns - self.origin_ns) * 1e-9, dtype=np.float64)


def find_sidecars(video: Path) -> SidecarFiles:
    """Looks beside a video, and in the folder that OpenCamera-Sensors names by its date and time.

    Of several settings files, the newest by name (they carry their date) is taken.
    """
    folders = [video.parent]
    if date := re.search(r"\d{8}_\d{6}", video.stem):
        folders.append(video.parent / date.group())

    def first(*endings: str) -> Path | None:
        places = (folder / (video.stem + ending) for ending in endings for folder in folders)
        return next((place for place in places if place.is_file()), None)

    return SidecarFiles(
        subtitles=first(".srt"),
        flash_times=first("_flash.csv"),
        frame_times=first("_imu_timestamps.csv", "_timestamps.csv"),
        settings=max(video.parent.glob("BACKUP_OC_*.xml"), key=lambda path: path.name, default=None),
    )


def read_subtitles(path: Path) -> Subtitles:
    """Reads an .srt file.

    Raises:
        SourceError: unreadable, or without a single cue.
    """
    text = _read(path).decode("utf-8-sig", errors="replace")
    ends_s: list[float] = []
    first_lines: list[str] = []
    for block in re.split(r"\n\s*\n", text.replace("\r\n", "\n").replace("\r", "\n")):
        match = _CUE_TIMES.search(block)
        if match is None:
            continue
        hours, minutes, seconds, milliseconds = map(int, match.groups()[4:])
        ends_s.append(3600.0 * hours + 60.0 * minutes + seconds + 1e-3 * milliseconds)
        if len(ends_s) == 1:
            first_lines = [line.strip() for line in block[match.end() :].split("\n") if line.strip()]
    if not ends_s:
        raise SourceError(f"{path} has no subtitle with a time; it is damaged or no .srt file.")
    is_clock = [_is_clock(line) for line in first_lines]
    clock = [line for line, clock_line in zip(first_lines, is_clock, strict=True) if clock_line]
    place = [line for line, clock_line in zip(first_lines, is_clock, strict=True) if not clock_line]
    return Subtitles(
        cues=len(ends_s),
        end_s=ends_s[-2] if len(ends_s) > 1 else 0.0,
        clock_text=clock[0][:100] if clock else None,
        place_text=" ".join(place)[:200] or None,
    )


def _is_clock(line: str) -> bool:
    """Whether a line holds a time of day and nothing that could tell a place."""
    return bool(_CLOCK.search(line)) and not _COORDINATES.search(_DATE.sub("", line))


def read_clock_log(path: Path) -> NDArray[np.int64]:
    """Reads one integer of nanoseconds a line.

    Returns:
        [n] int64, n >= 1, strictly increasing.

    Raises:
        SourceError: unreadable, empty, something else than integers, or a clock that goes backwards.
    """
    values: list[int] = []
    for number, line in enumerate(_read(path).splitlines(), start=1):
        entry = line.strip()
        if not entry:
            continue
        if not _NANOSECONDS.fullmatch(entry) or int(entry) >= 1 << 63:
            raise SourceError(
                f"{path}, line {number}: {entry[:40].decode('ascii', 'replace')!r} is no time in nanoseconds."
            )
        values.append(int(entry))
        if len(values) > 1 and values[-1] <= values[-2]:
            raise SourceError(f"{path}, line {number}: the clock goes backwards or stands still.")
    if not values:
        raise SourceError(f"{path} holds no time stamps.")
    return np.array(values, dtype=np.int64)


def tie_frame_clock(clock_ns: NDArray[np.int64], pts_s: NDArray[np.float64]) -> FrameClock | None:
    """Ties logged frame times to a video's time stamps by their pattern.

    Each may have frames that the other lacks, in small number.
    Where the pattern does not tell (a constant rate), the shift that pairs the first ones wins.

    Args:
        clock_ns: [n] increasing.
        pts_s: [m] increasing.

    Returns:
        None when the two do not belong together: no shift makes nine frames of ten agree within a fifth of
        the frame interval (by chance it would be 0.45).
    """
    if min(len(clock_ns), len(pts_s)) < 2 or abs(len(clock_ns) - len(pts_s)) > _LARGEST_LAG:
        return None
    interval_s = float(np.median(np.diff(pts_s)))
    start_ns = int(clock_ns[0])
    clock_s = np.asarray((clock_ns - start_ns) * 1e-9, dtype=np.float64)
    best_s, best_residual_s = 0.0, np.inf
    for lag in sorted(range(-_LARGEST_LAG, _LARGEST_LAG + 1), key=abs):
        logged, filmed = clock_s[max(lag, 0) :], pts_s[max(-lag, 0) :]
        shared = min(len(logged), len(filmed))
        if shared < max(2, 0.5 * min(len(clock_s), len(pts_s))):
            continue
        origin_s = float(np.median(logged[:shared] - filmed[:shared]))
        distance_s = np.abs(_nearest(clock_s - origin_s, pts_s)[1])
        residual_s = float(np.quantile(distance_s, 0.9))
        if residual_s < best_residual_s - _CLOCK_JITTER_S:
            best_s, best_residual_s = origin_s, residual_s
    if best_residual_s > _AGREEMENT * interval_s:
        return None
    nearest, distance_s = _nearest(clock_s - best_s, pts_s)
    near = np.abs(distance_s) <= 0.5 * interval_s
    origin_s = best_s + float(np.median(distance_s[near]))
    return FrameClock(
        origin_ns=start_ns + round(origin_s * 1e9),
        frame_ns=tuple(int(clock_ns[at]) if ok else None for at, ok in zip(nearest, near, strict=True)),
        residual_s=float(np.median(np.abs(distance_s[near] - (origin_s - best_s)))),
    )


def _nearest(
    clock_s: NDArray[np.float64], pts_s: NDArray[np.float64]
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """For each frame, the place of the logged time next to it and how much later that is."""
    nearest = np.searchsorted(0.5 * (clock_s[1:] + clock_s[:-1]), pts_s)
    return nearest, clock_s[nearest] - pts_s


def _read(path: Path) -> bytes:
    try:
        if path.stat().st_size > _LARGEST_FILE:
            raise SourceError(
                f"{path} is larger than {_LARGEST_FILE >> 20} MiB, which no file of its kind is."
            )
        return path.read_bytes()
    except OSError as error:
        raise SourceError(f"{path} cannot be read: {error.strerror}.") from error
