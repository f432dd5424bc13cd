"""F tagging while a capture runs, for captures of any length.

    tagger = StreamTagger(width, height, transfer="srgb")
    tagger.add(frame, pts_s)            each frame
    tagger.expect([edge_s], on_s=0.1)   each pulse that the flash reports
    for position, frame_tag in tagger.ready(): ...
    result = tagger.finish()

Frames are tagged in overlapping stretches of under a minute, each as `tag` tags a whole sequence, with what
the stretches before it have taught: the shutter, the flash's pattern, its lateness behind its schedule. Only
the middle of a stretch is given out, so that every frame is judged with its neighbours on both sides. A gap
in time begins a segment with a rhythm of its own. What fits into one stretch is tagged exactly as by `tag`.
"""

from __future__ import annotations

import itertools
import threading
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from capture.errors import TaggingError
from capture.tagging.analysis import steady_squares
from capture.tagging.config import TaggingConfig
from capture.tagging.dark import UNTAGGED, label_dark, light_stays
from capture.tagging.known import Commands, KnownFlash
from capture.tagging.profiles import ProfileAccumulator
from capture.tagging.result import FrameTag, Pulse, TagResult
from capture.tagging.schedule_check import Schedule, hold_against_schedule
from capture.tagging.split import BLOCKS
from capture.tagging.stream_summary import (
    Counts,
    ExposureLevel,
    PulseTable,
    StreamResult,
    kind_of,
)
from capture.tagging.stretches import Part, Stretch, added_light, parts_of, steps_of
from capture.tagging.tagger import pulses_of, result_of, shutter_is_known, with_remarks
from capture.tagging.watch import PulseStatus, PulseWatch

Floats = NDArray[np.float64]

#: New frames in a stretch, and what it shares with its neighbours on each side, seconds. Six pulses on each
#: side settle what a rhythm says; more frames in a stretch cost memory (15 kB each) and delay.
CHUNK_S, MARGIN_S = 40.0, 6.0
# Least doubt of a scheduled edge when frames are checked against it, and in deviations of the lateness.
_SLACK_S, _SLACK_SIGMAS = 0.015, 5.0
# Commands that are kept while none has been matched.
_MOST_COMMANDS = 400
# A pulse's length when neither the schedule nor the light has told it.
_USUAL_ON_S = 0.1


class StreamTagger:
    """Tags frames some tens of seconds after they came; memory does not grow with the capture.

    `add`, `expect` and `pulse_status` are quick; `ready` computes for seconds when a stretch is complete, and
    may be called from another thread while frames go on being added. `finish` comes last, from either.
    """

    def __init__(
        self,
        width: int,
        height: int,
        *,
        transfer: str = "srgb",
        levels: tuple[float, float] | None = None,
        matrix: str = "bt709",
        config: TaggingConfig | None = None,
        schedule_source: str = "the flash's schedule",
        chunk_s: float = CHUNK_S,
        margin_s: float = MARGIN_S,
    ) -> None:
        """Begins a capture.

        Args:
            width: of the frames, pixels; see `ProfileAccumulator` for these.
            height: of the frames, pixels.
            transfer: of the frames.
            levels: stored values of black and white.
            matrix: of Y'CbCr planes.
            config: limits, and what is known of the camera's shutter.
            schedule_source: name of the schedule in warnings.
            chunk_s: new frames in a stretch, seconds.
            margin_s: what stretches share on each side, seconds.

        Raises:
            TaggingError: the frames are too small.
        """
        if not (chunk_s > 0 and margin_s > 0):
            raise ValueError(f"chunk_s {chunk_s} and margin_s {margin_s} must be positive")
        self._config = config or TaggingConfig()
        self._source = schedule_source
        self._chunk_s, self._margin_s = chunk_s, margin_s
        self._kept = ProfileAccumulator(
            width, height, transfer=transfer, levels=levels, matrix=matrix, config=self._config
        )
        self._watch = PulseWatch(self._config)
        self._lock, self._working = threading.Lock(), threading.Lock()
        self._base = self._emitted = 0  # positions: of the oldest frame kept, of the next to be tagged
        self._interval_s = float("nan")
        self._borders: list[int] = []  # positions at which a segment begins
        self._segment = 0
        self._commands: list[float] = []
        self._on_s: float | None = None
        self._offset_s: float | None = None
        self._known = KnownFlash()
        self._steady_light = False
        self._level = ExposureLevel()
        self._table = PulseTable()
        self._counts = Counts()
        self._whole: TagResult | None = None
        self._refused: str | None = None

    def add(
        self,
        frame: NDArray[np.generic],
        pts_s: float,
        *,
        chroma: tuple[NDArray[np.generic], NDArray[np.generic]] | None = None,
    ) -> None:
        """Looks at one frame; see `ProfileAccumulator.add`.

        Raises:
            TaggingError: wrong size, or a time that is not later than the one before.
        """
        with self._lock:
            times = self._kept.times_s
            before_s = times[-1] if times else None
            self._kept.add(frame, pts_s, chroma=chroma)
            if before_s is not None and pts_s - before_s > self._config.longest_period_s:
                self._borders.append(self._base + len(times) - 1)
            self._watch.add(float(pts_s), self._kept.square(BLOCKS))

    def expect(self, times_s: Iterable[float], on_s: float | None = None) -> None:
        """The flash has gone on, or was told to.

        Args:
            times_s: starts of pulses by a clock that runs with the frames', up to a constant. Each once,
                within a few seconds of its frames.
            on_s: length of the pulses.
        """
        times = [float(t) for t in times_s]
        with self._lock:
            self._commands = sorted(self._commands + times)
            self._on_s = on_s if on_s is not None else self._on_s
            if self._offset_s is None:
                del self._commands[:-_MOST_COMMANDS]
            self._watch.expect(times)

    def pulse_status(self) -> PulseStatus:
        """Whether pulses are seen, a second or so after they came."""
        with self._lock:
            return self._watch.status()

    @property
    def latency_s(self) -> float | None:
        """What to add to the schedule's times to come to the frames'; None = not known yet."""
        return self._offset_s

    @property
    def held(self) -> int:
        """Frames that are kept in memory now."""
        return len(self._kept.times_s)

    def ready(self) -> list[tuple[int, FrameTag]]:
        """(position, tag) of frames that have their final tag now, in order; each frame once."""
        out: list[tuple[int, FrameTag]] = []
        with self._working:
            while (stretch := self._next(final=False)) is not None:
                out += self._tag(stretch)
        return out

    def finish(self) -> StreamResult:
        """The remaining tags and the sum of it all. Nothing may be added afterwards."""
        out: list[tuple[int, FrameTag]] = []
        with self._working:
            while (stretch := self._next(final=True)) is not None:
                out += self._tag(stretch)
        return self._sum(out)

    def _next(self, *, final: bool) -> Stretch | None:
        """The next stretch that is complete."""
        with self._lock:
            times = np.array(self._kept.times_s)
            closed = bool(self._borders) or final
            end = self._borders[0] - self._base if self._borders else len(times)
            begin = self._emitted - self._base
            if begin >= end:
                return None
            until_s = times[0] + self._chunk_s + 2 * self._margin_s
            if times[end - 1] >= until_s:
                last, end = False, int(np.searchsorted(times, until_s))
            elif closed:
                last = True
            else:
                return None
            if last and self._borders:
                self._borders.pop(0)
            only = self._emitted == 0 and final and last and end == len(times)
            return Stretch(
                self._kept.profiles(0, end), self._base, begin, last, only, self._commands_near(times, end)
            )

    def _commands_near(self, times: Floats, end: int) -> Commands | None:
        """The commands that may concern a stretch, with a pulse's doubt on each side."""
        if not self._commands:
            return None
        commands = np.array(self._commands)
        if self._offset_s is not None:
            at = commands + self._offset_s
            reach = self._config.longest_period_s
            commands = commands[(at > times[0] - reach) & (at < times[end - 1] + reach)]
        return Commands(commands, self._offset_s, self._on_s) if len(commands) else None

    def _tag(self, stretch: Stretch) -> list[tuple[int, FrameTag]]:
        """Tags of a stretch's frames that have none yet, up to its margin."""
        profiles, seen = stretch.profiles, np.flatnonzero(stretch.profiles.readable)
        self._interval_s = profiles.interval_s
        try:
            parts = parts_of(stretch, seen, self._config, self._known)
        except TaggingError as refusal:
            self._refused = str(refusal)
            parts = [Part(0, len(seen), None)]
        if stretch.only and parts[0].analysis is not None:
            self._whole = result_of(profiles, seen, parts[0].analysis, self._config)
        tags = [tag for part in parts for tag in self._labels(stretch, seen, part)]
        pulses = [
            (pulse, added_light(part.analysis, pulse, seen[part.first : part.end]))
            for part in parts
            if part.analysis is not None
            for pulse in pulses_of(part.analysis.found, seen[part.first : part.end])
        ]
        cut = len(profiles) if stretch.last else self._cut(stretch, [pulse for pulse, _ in pulses])
        drifted = np.zeros(len(profiles), bool)
        new = slice(stretch.begin, cut)
        if stretch.only and parts[0].analysis is not None:
            drifted[seen] = parts[0].analysis.drift.affected
        else:
            drifted[new] = self._level.affected(profiles.pts_s[new], steps_of(parts, profiles.pts_s[new]))
        tags = with_remarks(profiles, seen, tags, drifted[seen], self._config)
        if self._segment and stretch.begin == 0:
            tags[0] = replace(tags[0], reasons=(*tags[0].reasons, "dropped_before"))
        mine = [item for item in pulses if stretch.begin <= item[0].frames[0] < cut]
        tags = self._checked(stretch, cut, tags, mine, parts)
        self._count(stretch, cut, tags, parts)
        self._forget(stretch, cut)
        return [(stretch.base + k, tags[k]) for k in range(stretch.begin, cut)]

    def _labels(self, stretch: Stretch, seen: NDArray[np.int_], part: Part) -> list[FrameTag]:
        """The flash in a part's frames."""
        if part.analysis is not None:
            self._steady_light = False
            return part.analysis.frames
        index = seen[part.first : part.end]
        if self._known.pattern is None or len(index) < 2:
            return [UNTAGGED] * len(index)
        frames = stretch.profiles.take(index)
        squares, _, _ = steady_squares(frames, self._config)
        self._steady_light = self._steady_light or light_stays(squares, self._known.pattern)
        if self._steady_light:
            return [UNTAGGED] * len(index)
        return label_dark(frames.pts_s, squares, self._known.pattern, self._config)

    def _cut(self, stretch: Stretch, pulses: list[Pulse]) -> int:
        """Where the stretch's own frames end: between two pulses, a margin before its end."""
        times = stretch.profiles.pts_s
        wanted = int(np.searchsorted(times, times[-1] - self._margin_s))
        gaps = [(before.frames[1] + after.frames[0]) // 2 for before, after in itertools.pairwise(pulses)]
        near = [k for k in gaps if abs(times[k] - times[wanted]) < self._config.longest_period_s]
        cut = min(near, key=lambda k: abs(k - wanted), default=wanted)
        return max(cut, stretch.begin + 1)

    def _checked(
        self,
        stretch: Stretch,
        cut: int,
        tags: list[FrameTag],
        pulses: list[tuple[Pulse, float]],
        parts: list[Part],
    ) -> list[FrameTag]:
        """The tags after a comparison with the schedule; counts the pulses of the stretch's own frames."""
        late = np.full(len(pulses), np.nan)
        commands = stretch.commands
        on_s = np.array([pulse.t_on_s for pulse, _ in pulses])
        if commands is not None:
            every = np.concatenate(
                [part.analysis.found.labels.on_s for part in parts if part.analysis is not None] or [on_s]
            )
            matched = commands.partners(every)
            if matched is not None:
                self._offset_s = matched[1]
                partner = matched[0][np.searchsorted(every, on_s)]
                late[partner >= 0] = on_s[partner >= 0] - commands.times_s[partner[partner >= 0]]
            elif len(on_s) and commands.can_tell(len(every)):
                self._counts.happened("unlocked", [float(stretch.profiles.pts_s[stretch.begin])])
            if self._offset_s is not None and (matched is not None or not len(on_s)):
                tags = self._held_against_schedule(stretch, cut, tags, pulses, late, parts)
        for (pulse, light), late_s in zip(pulses, late, strict=True):
            self._table.add(pulse, light, float(late_s), self._segment)
        return tags

    def _held_against_schedule(
        self,
        stretch: Stretch,
        cut: int,
        tags: list[FrameTag],
        pulses: list[tuple[Pulse, float]],
        late: Floats,
        parts: list[Part],
    ) -> list[FrameTag]:
        assert stretch.commands is not None
        assert self._offset_s is not None
        found = [part.analysis.found for part in parts if part.analysis is not None]
        shutter = found[0].shutter if found else self._known.shutter
        if shutter is None:
            return tags
        lengths = [pulse.t_off_s - pulse.t_on_s for pulse, _ in pulses]
        _, jitter_s = self._table.lateness()
        schedule = Schedule(
            on_s=stretch.commands.times_s + self._offset_s,
            length_s=float(np.median(lengths)) if lengths else stretch.commands.on_s or _USUAL_ON_S,
            slack_s=max(_SLACK_S, _SLACK_SIGMAS * (jitter_s or 0.0)),
            readout_s=shutter.readout_s,
            exposure_s=shutter.exposure_s,
        )
        return hold_against_schedule(
            stretch.profiles.pts_s,
            tags,
            range(stretch.begin, cut),
            schedule,
            seen_s=np.concatenate([part.labels.on_s for part in found] or [np.zeros(0)]),
            unmatched_s=[
                pulse.t_on_s
                for (pulse, _), late_s in zip(pulses, late, strict=True)
                if not np.isfinite(late_s)
            ],
            counts=self._counts,
            config=self._config,
        )

    def _count(self, stretch: Stretch, cut: int, tags: list[FrameTag], parts: list[Part]) -> None:
        """What the summary needs of a stretch's own frames."""
        pts_s = stretch.profiles.pts_s
        begin_s, end_s = float(pts_s[stretch.begin]), float(pts_s[cut - 1])
        self._counts.labels.update(kind_of(tags[k]) for k in range(stretch.begin, cut))
        self._counts.stepped(steps_of(parts, pts_s[stretch.begin : cut]))
        seen = np.flatnonzero(stretch.profiles.readable)
        for part in parts:
            index = seen[part.first : part.end]
            if part.analysis is None:
                if len(index) and index[-1] >= stretch.begin and index[0] < cut:
                    self._counts.happened("dark", [float(pts_s[max(index[0], stretch.begin)])])
                continue
            times = [float(pts_s[index[window.first]]) for window in part.analysis.found.doubtful]
            self._counts.happened("doubtful", [t for t in times if begin_s <= t <= end_s])
            flicker = part.analysis.flicker
            if flicker is not None and (
                self._counts.flicker is None or flicker.depth > self._counts.flicker[1]
            ):
                self._counts.flicker = flicker.frequency_hz, flicker.depth

    def _forget(self, stretch: Stretch, cut: int) -> None:
        """Drops the frames that no later stretch needs."""
        times = stretch.profiles.pts_s
        with self._lock:
            self._emitted = stretch.base + cut
            keep = cut if stretch.last else int(np.searchsorted(times, times[cut] - self._margin_s))
            self._kept.drop(keep)
            self._base += keep
            self._segment += stretch.last
            if self._offset_s is not None:
                old_s = (
                    times[keep - 1] - self._offset_s - 2 * self._config.longest_period_s if keep else -np.inf
                )
                self._commands = [t for t in self._commands if t > old_s]

    def _sum(self, frames: list[tuple[int, FrameTag]]) -> StreamResult:
        """The result, with all that was counted."""
        table, counts, whole = self._table, self._counts, self._whole
        rhythm = table.rhythm(self._config)
        droop = table.droop()
        latency_s, latency_jitter_s = table.lateness()
        fit = None if whole is not None else self._known.shutter
        if fit is not None and not shutter_is_known(fit, self._interval_s):
            fit = None
        shutter = whole or fit
        if self._emitted == 0:
            self._refused = "There are no frames to tag; give at least 8, with and without flash."
        elif not len(table) and self._refused is None:
            self._refused = "No flash was found in any part of the capture; check that it blinked."
        schedule = counts.warnings(table, rhythm, self._source, droop)
        if whole is not None:
            schedule = [*whole.warnings, *(text for text in schedule if self._source in text)]
        return StreamResult(
            frames=tuple(frames),
            count=self._emitted,
            labels=dict(counts.labels),
            refused=self._refused,
            pulses=len(table),
            on_s=np.array(table.on_s),
            off_s=np.array(table.off_s),
            light=np.array(table.light),
            period_s=rhythm.period_s if whole is None else whole.period_s,
            period_sigma_s=rhythm.period_sigma_s if whole is None else whole.period_sigma_s,
            jitter_s=rhythm.jitter_s if whole is None else whole.jitter_s,
            missed=len(rhythm.missed_s if whole is None else whole.missed_s),
            missed_s=(rhythm.missed_s if whole is None else whole.missed_s)[:100],
            phase_jumps=rhythm.jumps,
            segments=self._segment,
            readout_s=None if shutter is None else shutter.readout_s,
            readout_sigma_s=None if shutter is None else shutter.readout_sigma_s,
            exposure_s=None if shutter is None else shutter.exposure_s,
            exposure_sigma_s=None if shutter is None else shutter.exposure_sigma_s,
            droop_share=droop[0],
            droop_sigma=droop[1],
            latency_s=latency_s,
            latency_jitter_s=latency_jitter_s,
            matched=int(np.isfinite(np.array(table.late_s)).sum()),
            unseen_s=tuple(counts.times.get("unseen", ())),
            unseen=counts.numbers["unseen"],
            unscheduled=counts.numbers["unscheduled"],
            contradictions=counts.numbers["contradiction"],
            flicker_hz=None if counts.flicker is None else counts.flicker[0],
            flicker_depth=None if counts.flicker is None else counts.flicker[1],
            warnings=tuple(schedule) if self._refused is None else (self._refused,),
        )
