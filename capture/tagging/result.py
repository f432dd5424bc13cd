"""What the tagger returns."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class FlashPrior:
    """What is known beforehand of the flash: a schedule, a log of commands. It is checked, not believed.

    Attributes:
        times_s: when the flash was asked to go on; their common offset to the frames' times need not be
            known.
        on_s: for how long, None = not known.
        source: where that comes from, for messages.
    """

    times_s: tuple[float, ...]
    on_s: float | None
    source: str


@dataclass(frozen=True)
class FrameTag:
    """The flash in one frame.

    Attributes:
        flash: 1 = every row fully lit, 0 = no row lit, None = in part, or not known.
        lit_fraction: mean share of the pulse's light over the rows, 0..1; None where nothing can be said.
        confidence: probability that the label is right; of None, that the frame is neither lit nor unlit.
        reasons: remarks, and why a frame is left out: `partial_flash`, `flash_uncertain` (an edge may touch
            it), `contradiction` (light and schedule disagree), `untagged` (nothing could be said), `drift`,
            `clipped`, `clipped_frame`, `dropped_before`, `unreadable`.
    """

    flash: int | None
    lit_fraction: float | None
    confidence: float
    reasons: tuple[str, ...]


@dataclass(frozen=True)
class Pulse:
    """One pulse of the flash.

    Attributes:
        t_on_s: when it began, on the frames' time axis (start of the first row's exposure).
        t_off_s: when it ended.
        t_on_sigma_s: standard deviation of t_on_s; where no row looked it is as wide as that gap.
        t_off_sigma_s: standard deviation of t_off_s.
        gain: its light over the usual pulse's, 1 = the same.
        cycle: number of its period in the rhythm, from 0; None = an extra pulse, or no rhythm.
        frames: the frames it touches at all, first and one past the last.
    """

    t_on_s: float
    t_off_s: float
    t_on_sigma_s: float
    t_off_sigma_s: float
    gain: float
    cycle: int | None
    frames: tuple[int, int]


@dataclass(frozen=True)
class PriorCheck:
    """How a prior compares with the pulses that were seen.

    Attributes:
        offset_s: what to add to the prior's times to come to the frames' time: clock offset and the flash's
            latency.
        jitter_s: robust standard deviation of the pulses about that.
        matched: number of pulses that the prior knows.
        missing_s: times, on the frames' axis, at which the prior has a pulse and the frames have none.
        extra_s: times of pulses that the prior does not have.
    """

    offset_s: float
    jitter_s: float
    matched: int
    missing_s: tuple[float, ...]
    extra_s: tuple[float, ...]


@dataclass(frozen=True)
class TagResult:
    """The flash over a sequence.

    Attributes:
        frames: one tag for each frame.
        pulses: in order of time.
        period_s: mean time from pulse to pulse; None for fewer than three pulses of one rhythm.
        period_sigma_s: its standard deviation.
        jitter_s: robust standard deviation of the steps from pulse to pulse.
        missed_s: when a pulse was due and none came.
        readout_s: from the first row's start to the last row's, negative when the bottom row is first.
        readout_sigma_s: its standard deviation.
        exposure_s: of a row.
        exposure_sigma_s: its standard deviation.
        separation: distance of lit and unlit frames in spreads of the unlit ones.
        flicker_hz: of the room light, None = none seen.
        flicker_depth: its amplitude as a share of the room light.
        prior: the comparison with a schedule; None = none given.
        warnings: sentences for the user.
    """

    frames: tuple[FrameTag, ...]
    pulses: tuple[Pulse, ...]
    period_s: float | None
    period_sigma_s: float | None
    jitter_s: float | None
    missed_s: tuple[float, ...]
    readout_s: float | None
    readout_sigma_s: float | None
    exposure_s: float | None
    exposure_sigma_s: float | None
    separation: float
    flicker_hz: float | None
    flicker_depth: float | None
    prior: PriorCheck | None
    warnings: tuple[str, ...]
