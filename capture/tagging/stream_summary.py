"""What is to be said of a long capture: a few numbers a pulse are kept, everything else is counted."""

from __future__ import annotations

from array import array
from collections import Counter
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from capture.tagging.config import TaggingConfig
from capture.tagging.drift import FAIL_SHARE, WARN_SHARE, DriftStep
from capture.tagging.result import FrameTag, Pulse

Floats = NDArray[np.float64]

# A step from pulse to pulse is so many whole periods when it is off by less than this share of one.
_TOLERANCE = 0.12
# Times of what went wrong that are kept.
_MOST_TIMES = 100
# A level of exposure that has held so long is the new standard.
_STANDARD_S = 60.0
# Pulses at each end whose light is compared, as a share and at least.
_END_SHARE, _END_PULSES = 0.1, 5
_SIGMAS = 4.0


@dataclass(frozen=True)
class StreamResult:
    """A long capture in sum.

    Attributes:
        frames: (position, tag) of the frames that `ready` had not given out.
        count: frames in all.
        labels: how many frames are "lit", "unlit", "partial", "untagged", or None for another reason
            ("uncertain").
        refused: why no frame could be tagged, in a sentence; None = there are tags.
        pulses: pulses found.
        on_s: [P] their starts on the frames' axis.
        off_s: [P] their ends.
        light: [P] light that each added to the picture (mean, linear, 1 = white clip); NaN where no frame
            was fully lit.
        period_s: mean time from pulse to pulse; None for fewer than three pulses of one rhythm.
        period_sigma_s: its standard deviation.
        jitter_s: robust standard deviation of the steps from pulse to pulse.
        missed: pulses that did not come, between others of the same rhythm.
        missed_s: when, the first hundred.
        phase_jumps: how often the rhythm began anew in the middle of a segment, as a reset does.
        segments: stretches without a gap in time.
        readout_s: from the first row's start to the last row's, signed; None = not found out.
        readout_sigma_s: its standard deviation.
        exposure_s: of a row; None = not found out.
        exposure_sigma_s: its standard deviation.
        droop_share: light lost from the first tenth of the pulses to the last (medians); negative = gained;
            None for fewer than ten pulses. A camera that comes nearer changes it too.
        droop_sigma: its standard deviation, by the pulses' scatter.
        latency_s: constant offset of the pulses behind the schedule: clocks, lamp and camera together; None =
            no schedule, or one that does not fit.
        latency_jitter_s: robust standard deviation of the pulses about it.
        matched: pulses that the schedule has too.
        unseen_s: scheduled times, on the frames' axis, without a pulse in the frames: the first hundred.
        unseen: how many.
        unscheduled: pulses that the schedule does not have.
        contradictions: frames left out because light and schedule disagree.
        flicker_hz: of the room light where it was strongest, None = none seen.
        flicker_depth: its amplitude there.
        warnings: sentences for the user.
    """

    frames: tuple[tuple[int, FrameTag], ...]
    count: int
    labels: dict[str, int]
    refused: str | None
    pulses: int
    on_s: Floats
    off_s: Floats
    light: Floats
    period_s: float | None
    period_sigma_s: float | None
    jitter_s: float | None
    missed: int
    missed_s: tuple[float, ...]
    phase_jumps: int
    segments: int
    readout_s: float | None
    readout_sigma_s: float | None
    exposure_s: float | None
    exposure_sigma_s: float | None
    droop_share: float | None
    droop_sigma: float | None
    latency_s: float | None
    latency_jitter_s: float | None
    matched: int
    unseen_s: tuple[float, ...]
    unseen: int
    unscheduled: int
    contradictions: int
    flicker_hz: float | None
    flicker_depth: float | None
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class RhythmSummary:
    """Period and what departs from it.

    Attributes:
        period_s: None = too few pulses.
        period_sigma_s: its standard deviation.
        jitter_s: of a step.
        missed_s: when pulses were due.
        jumps: steps that are no whole periods.
    """

    period_s: float | None
    period_sigma_s: float | None
    jitter_s: float | None
    missed_s: tuple[float, ...]
    jumps: int


@dataclass
class PulseTable:
    """A few numbers of each pulse; 10,000 pulses take 400 kB."""

    on_s: array[float] = field(default_factory=lambda: array("d"))
    off_s: array[float] = field(default_factory=lambda: array("d"))
    light: array[float] = field(default_factory=lambda: array("d"))
    late_s: array[float] = field(default_factory=lambda: array("d"))
    segment: array[int] = field(default_factory=lambda: array("l"))

    def add(self, pulse: Pulse, light: float, late_s: float, segment: int) -> None:
        """One more; `late_s` is behind its command, NaN = it has none."""
        self.on_s.append(pulse.t_on_s)
        self.off_s.append(pulse.t_off_s)
        self.light.append(light)
        self.late_s.append(late_s)
        self.segment.append(segment)

    def __len__(self) -> int:
        return len(self.on_s)

    def lateness(self) -> tuple[float | None, float | None]:
        """Median lateness behind the commands and its robust standard deviation."""
        late = np.array(self.late_s)
        late = late[np.isfinite(late)]
        if not len(late):
            return None, None
        middle = float(np.median(late))
        return middle, 1.4826 * float(np.median(np.abs(late - middle)))

    def droop(self) -> tuple[float | None, float | None]:
        """Share of light lost between the first and the last tenth of the pulses, with its deviation."""
        light = np.array(self.light)
        light = light[np.isfinite(light) & (light > 0)]
        count = max(_END_PULSES, round(_END_SHARE * len(light)))
        if len(light) < 2 * count:
            return None, None
        ends = (np.log(light[:count]), np.log(light[-count:]))
        middle = [float(np.median(end)) for end in ends]
        # a median's deviation is 1.25 of a mean's
        sigma = [
            1.25 * 1.4826 * float(np.median(np.abs(end - m))) / np.sqrt(count)
            for end, m in zip(ends, middle, strict=True)
        ]
        return float(-np.expm1(middle[1] - middle[0])), float(np.hypot(*sigma))

    def rhythm(self, config: TaggingConfig) -> RhythmSummary:
        """Period, jitter, missed pulses and phase jumps over all segments."""
        on_s, segment = np.array(self.on_s), np.array(self.segment)
        apart = np.diff(on_s)
        inside = (np.diff(segment) == 0) & (apart > 0)
        single = inside & (apart >= config.shortest_period_s) & (apart <= config.longest_period_s)
        if single.sum() < 2:
            return RhythmSummary(None, None, None, (), 0)
        period_s = float(np.median(apart[single]))
        count = np.maximum(np.round(apart / period_s), 1)
        whole = inside & (np.abs(apart / period_s - count) < _TOLERANCE)
        if whole.sum() < 2:
            return RhythmSummary(None, None, None, (), int(inside.sum()))
        steps = apart[whole] / count[whole]
        period_s = float(np.median(steps))
        jitter_s = 1.4826 * float(np.median(np.abs(steps - period_s)))
        usual = np.abs(steps - period_s) <= max(5 * jitter_s, 1e-3)
        if jitter_s < 0.02 * period_s:  # a clean rhythm: the mean is more precise than the median
            period_s = float(apart[whole][usual].sum() / count[whole][usual].sum())
        sigma = max(jitter_s, 1e-5) / float(np.sqrt(usual.sum()))
        missed = [
            float(on_s[i] + n * apart[i] / count[i])
            for i in np.flatnonzero(whole & (count > 1))
            for n in range(1, int(count[i]))
        ]
        return RhythmSummary(period_s, sigma, jitter_s, tuple(missed), int((inside & ~whole).sum()))


class ExposureLevel:
    """Which frames have the exposure and white balance of most, over a capture of any length.

    A sudden change of more than `FAIL_SHARE` leaves the standard; a level that has held for a minute is
    the new standard. Small steps are absorbed: over hours, their errors would add up to a large one.
    """

    def __init__(self) -> None:
        """At the standard."""
        self._off: dict[str, float] = {}
        self._held_s: dict[str, float] = {}
        self._known_s = 0.0

    def affected(self, pts_s: Floats, steps: tuple[DriftStep, ...]) -> NDArray[np.bool_]:
        """[K] bool, frames off the standard; to be asked for all frames in order, once.

        Args:
            pts_s: [K] of the frames.
            steps: changes among them, in order.
        """
        out = np.zeros(len(pts_s), bool)
        for channel in sorted({*self._off, *(step.channel for step in steps)}):
            own = [step for step in steps if step.channel == channel]
            times = [float(pts_s[0]), *(step.time_s for step in own), float(pts_s[-1]) + 1e-9]
            off = self._off.get(channel, 0.0)
            for i in range(len(times) - 1):
                if i:
                    off += float(np.log1p(own[i - 1].share))
                    off = 0.0 if abs(off) < max(WARN_SHARE, 0.5 * FAIL_SHARE) else off
                    self._held_s[channel] = 0.0
                self._held_s[channel] = self._held_s.get(channel, 0.0) + times[i + 1] - times[i]
                standard_s = min(self._known_s + times[i] - times[0], _STANDARD_S)
                if off and self._held_s[channel] > standard_s:
                    off = 0.0
                if abs(off) > FAIL_SHARE:
                    out |= (pts_s >= times[i]) & (pts_s < times[i + 1])
            self._off[channel] = off
        self._known_s += float(pts_s[-1] - pts_s[0]) if len(pts_s) else 0.0
        return out


def kind_of(tag: FrameTag) -> str:
    """The word under which a frame is counted."""
    if tag.flash is not None:
        return "lit" if tag.flash else "unlit"
    return next((reason for reason in ("partial_flash", "untagged") if reason in tag.reasons), "uncertain")


@dataclass
class Counts:
    """What is counted over a capture."""

    labels: Counter[str] = field(default_factory=Counter)
    times: dict[str, list[float]] = field(default_factory=dict)
    numbers: Counter[str] = field(default_factory=Counter)
    steps: list[DriftStep] = field(default_factory=list)
    flicker: tuple[float, float] | None = None

    def happened(self, what: str, times_s: list[float]) -> None:
        """Something went wrong at these times; the first are kept, all are counted."""
        self.numbers[what] += len(times_s)
        kept = self.times.setdefault(what, [])
        kept += times_s[: _MOST_TIMES - len(kept)]

    def stepped(self, steps: tuple[DriftStep, ...]) -> None:
        """Changes of exposure or balance."""
        self.numbers["steps"] += len(steps)
        self.steps += steps[: _MOST_TIMES - len(self.steps)]

    def warnings(
        self, table: PulseTable, rhythm: RhythmSummary, source: str, droop: tuple[float | None, float | None]
    ) -> list[str]:
        """Sentences for the user."""
        out = []
        if not self.labels["lit"]:
            out.append(
                "No frame is lit in every row: the pulses are too short for this shutter; make them longer "
                "than exposure, readout and frame interval together."
            )
        if rhythm.period_s is None:
            pulses = "1 pulse is" if len(table) == 1 else f"{len(table)} pulses are"
            out.append(f"{pulses} too few to tell a period.")
        if rhythm.missed_s:
            times = ", ".join(f"{t:.2f}" for t in rhythm.missed_s[:5])
            out.append(
                f"{len(rhythm.missed_s)} pulses did not come (at {times} s); those frames are without flash."
            )
        if rhythm.jumps:
            out.append(f"The rhythm of the pulses began anew {rhythm.jumps} times, as after a reset.")
        for what, sentence in (
            (
                "doubtful",
                "{n} bright moments are not like the flash ({at} s); their frames are untagged.",
            ),
            ("dark", "No pulse came for {n} stretches of frames ({at} s); is the flash alive?"),
            ("unseen", "{n} pulses of {source} are not in the frames ({at} s)."),
            ("unscheduled", "{n} pulses in the frames are not in {source} ({at} s)."),
            ("contradiction", "{n} frames contradict {source} ({at} s) and are left out."),
            ("unlocked", "{source} does not fit the pulses in {n} stretches of frames ({at} s)."),
        ):
            if number := self.numbers[what]:
                at = ", ".join(f"{t:.2f}" for t in self.times[what][:5])
                out.append(sentence.format(n=number, at=at, source=source))
        if self.flicker is not None:
            hz, depth = self.flicker
            out.append(
                f"The room light flickers at {hz:.1f} Hz by {100 * depth:.1f} %; expose for a multiple of "
                f"{1e3 / hz:.1f} ms, or use daylight."
            )
        if self.steps:
            first = self.steps[0]
            out.append(
                f"The {first.channel} jumps {self.numbers['steps']} times, first by "
                f"{100 * first.share:+.1f} % at {first.time_s:.2f} s; lock exposure and white balance of the "
                "camera."
            )
        share, sigma = droop
        if share is not None and sigma is not None and abs(share) > max(FAIL_SHARE, _SIGMAS * sigma):
            out.append(
                f"The flash adds {100 * abs(share):.0f} % {'less' if share > 0 else 'more'} light at the end "
                "than at the beginning: its battery, its heat, or the camera's distance."
            )
        return out
