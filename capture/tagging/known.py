"""What the frames so far have taught of a flash and a camera, for the frames to come.

A camera's shutter does not change while its controls are locked, and a lamp keeps its pattern.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture.tagging.bands import BandGains
from capture.tagging.config import TaggingConfig
from capture.tagging.edges import EdgeRange
from capture.tagging.shutter_fit import Shutter, fit_shutter

Floats = NDArray[np.float64]

# Phases of a pulse's start against the frames that are told apart, and pulses kept of each.
_PHASES, _EACH = 12, 2
# Phases from which the shutter is believed, and its deviations, as shares of the span, before and after: what
# fits of one phase were wrong by, and what the model leaves (a lamp that rises, time stamps).
_ENOUGH_PHASES, _DOUBT, _LEAST_DOUBT = 6, 0.2, 0.005
# Of a common factor, which only a known exposure fixes well.
_LEAST_STRETCH = 0.12
# Pulses from which a fit is made, and so many times more from which it is made again.
_LEAST_SAMPLES, _MORE = 8, 1.3
# Pulses and commands belong together within this: a phone's jank, and an interval of frames.
_TOLERANCE_S = 0.12
# Fewer matches than this share of the pulses leave the commands unproved.
_LEAST_MATCHED = 0.5
_LEAST_LOCKED = 3


@dataclass(frozen=True, eq=False)
class _Sample:
    """A pulse that the shutter is fitted to.

    Attributes:
        data: of this pulse alone.
        edges: likewise.
        commanded_s: when it was told to go on; NaN = not known.
    """

    data: BandGains
    edges: EdgeRange
    commanded_s: float


class KnownFlash:
    """Shutter, and the light's pattern over the picture.

    One clock in step with another shows the same phase of the shutter for minutes, and fits of it can be
    sharp and wrong. So the shutter is fitted to pulses of as many phases as have come by, and until they are
    many it is doubted.
    """

    def __init__(self) -> None:
        """Nothing is known."""
        self.pattern: Floats | None = None
        self.map: Floats | None = None
        self.log_gain = 0.0
        self.shutter: Shutter | None = None
        self._samples: list[list[_Sample]] = [[] for _ in range(_PHASES)]
        self._fitted = 0

    def learn_pattern(self, pattern: Floats, map_: Floats, log_gain: float) -> None:
        """Takes the latest pattern: the camera walks, and what the lamp lights in the picture changes.

        Args:
            pattern: [n, n] log gain.
            map_: unit vector of the light over the picture.
            log_gain: mean log gain of lit frames.
        """
        self.pattern, self.map, self.log_gain = pattern, map_, log_gain

    def learn_pulses(
        self, data: BandGains, edges: EdgeRange, on_s: Floats, commanded_s: Floats, interval_s: float
    ) -> None:
        """Keeps pulses of phases that are not known well yet.

        Args:
            data: of the pulses.
            edges: search ranges of their edges.
            on_s: [P] their starts.
            commanded_s: [P] when they were told to go on; NaN = not known.
            interval_s: from frame to frame.
        """
        for p in range(len(on_s)):
            first_s = data.start_s[p, 0]
            phase = int(_PHASES * (((on_s[p] - first_s) / interval_s) % 1)) % _PHASES
            if len(self._samples[phase]) < _EACH:
                one = np.array([p])
                sample = _Sample(data.take(one), edges.take(one), float(commanded_s[p]))
                self._samples[phase].append(sample)

    def fit_again(self, gain_prior: Floats, interval_s: float, config: TaggingConfig) -> None:
        """Fits the shutter to the pulses that are kept, if there are new ones."""
        samples = [sample for phase in self._samples for sample in phase]
        if len(samples) < max(_LEAST_SAMPLES, _MORE * self._fitted):
            return
        self._fitted = len(samples)
        fit = fit_shutter(
            _joined([sample.data for sample in samples]),
            EdgeRange(
                *(
                    np.concatenate([getattr(sample.edges, name) for sample in samples])
                    for name in ("on_low", "on_high", "off_low", "off_high")
                )
            ),
            np.full(len(samples), -1),
            gain_prior,
            interval_s,
            config,
            np.array([sample.commanded_s for sample in samples]),
        )
        self.shutter = self._doubted(fit, config)

    def first_shutter(self, fit: Shutter, config: TaggingConfig) -> Shutter:
        """The shutter of the first frames, fitted to them alone; doubted, as their phases may all be one."""
        self.shutter = self._doubted(fit, config)
        return self.shutter

    def _doubted(self, fit: Shutter, config: TaggingConfig) -> Shutter:
        """The fit with the deviations that it has by the phases seen."""
        span = abs(fit.readout_s) + fit.exposure_s
        phases = sum(bool(phase) for phase in self._samples)
        doubt = _DOUBT if phases < _ENOUGH_PHASES else _LEAST_DOUBT
        free = config.readout_s is None and config.exposure_s is None
        stretch = max(fit.stretch_sigma, doubt, _LEAST_STRETCH) if free else fit.stretch_sigma
        readout = doubt * span if config.readout_s is None and not free else 0.0
        return replace(
            fit,
            stretch_sigma=stretch,
            readout_doubt_s=readout if config.readout_s is None else config.readout_sigma_s,
            readout_sigma_s=max(fit.readout_sigma_s, readout, stretch * abs(fit.readout_s) if free else 0.0),
            exposure_sigma_s=max(fit.exposure_sigma_s, stretch * fit.exposure_s if free else 0.0),
        )


@dataclass(frozen=True, eq=False)
class Commands:
    """When the flash was told to go on.

    Attributes:
        times_s: [N] increasing, by a clock that runs with the frames'.
        offset_s: what to add to come to the frames' time; None = not known yet.
        on_s: how long each was to last; None = not known.
    """

    times_s: Floats
    offset_s: float | None
    on_s: float | None = None

    def partners(self, on_s: Floats) -> tuple[NDArray[np.int_], float] | None:
        """Each pulse's command, -1 = none, and the offset; None when the two do not agree.

        Args:
            on_s: [P] starts of pulses, increasing.
        """
        if min(len(self.times_s), len(on_s)) < self._least:
            return None
        found: tuple[int, float, NDArray[np.int_], float] | None = None
        for start_s in self._offsets(on_s):
            offset_s = start_s
            for _ in range(2):  # the nearest command at a coarse offset, then at the matches' own
                partner = _nearest(self.times_s + offset_s, on_s)
                late = on_s - self.times_s[partner] - offset_s
                near = np.abs(late) <= _TOLERANCE_S
                if not near.any():
                    break
                offset_s += float(np.median(late[near]))
            matched = len(np.unique(partner[near]))
            rank = (matched, -abs(offset_s))
            if found is None or rank > found[:2]:
                found = (*rank, np.where(near, partner, -1), offset_s)
        if found is None or found[0] < max(self._least, _LEAST_MATCHED * len(on_s)):
            return None
        return _once(found[2], on_s - self.times_s[found[2]]), found[3]

    @property
    def _least(self) -> int:
        return _LEAST_LOCKED if self.offset_s is None else 1

    def can_tell(self, pulses: int) -> bool:
        """Whether so many pulses are enough to say whether the two agree; too few of them are a no."""
        expected = len(self.times_s)
        return expected >= self._least and (pulses >= self._least or pulses < _LEAST_MATCHED * expected)

    def _offsets(self, on_s: Floats) -> list[float]:
        if self.offset_s is not None:
            return [self.offset_s]
        # the first pulses against every command: one of them is right
        pairs = (on_s[:_LEAST_LOCKED, None] - self.times_s).ravel()
        return [float(value) for value in np.unique(np.round(pairs, 2))]


def _once(partner: NDArray[np.int_], late: Floats) -> NDArray[np.int_]:
    """No command twice: of two pulses that claim one, the nearer to the usual lateness keeps it."""
    usual = float(np.median(late[partner >= 0]))
    out = partner.copy()
    for command in np.unique(partner[partner >= 0]):
        claim = np.flatnonzero(partner == command)
        out[claim[np.argsort(np.abs(late[claim] - usual))[1:]]] = -1
    return out


def _nearest(times: Floats, t: Floats) -> NDArray[np.int_]:
    """Index of the time nearest to each t."""
    if len(times) == 1:
        return np.zeros(len(t), int)
    right = np.clip(np.searchsorted(times, t), 1, len(times) - 1)
    return right - (t - times[right - 1] < times[right] - t)


def _joined(parts: list[BandGains]) -> BandGains:
    """The data of several pulses, padded to the longest."""
    longest = max(part.start_s.shape[1] for part in parts)

    def padded(values: NDArray[Any], fill: float) -> NDArray[Any]:
        room = [(0, 0), (0, longest - values.shape[1]), *([(0, 0)] * (values.ndim - 2))]
        return np.pad(values, room, constant_values=fill)

    return BandGains(
        start_s=np.concatenate([padded(part.start_s, 0.0) for part in parts]),
        gain=np.concatenate([padded(part.gain, 0.0) for part in parts]),
        weight=np.concatenate([padded(part.weight, 0.0) for part in parts]),
        frames=np.concatenate([padded(part.frames, -1) for part in parts]),
    )
