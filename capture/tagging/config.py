"""What a user of the tagger may know or want."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class TaggingConfig:
    """Settings of the tagger; the defaults fit a torch or a firmware flash that blinks at about 1 Hz.

    Attributes:
        exposure_s: the exposure time when it is known; fitted otherwise.
        readout_s: time from the first row's start to the last row's, negative when the bottom row is first;
            fitted otherwise.
        readout_sigma_s: standard deviation of the readout that is known; labels hold in spite of it.
        shortest_period_s: of the flash.
        longest_period_s: of the flash.
        longest_on_s: the longest pulse looked for; the frames between pulses must be the larger part.
        min_separation: distance of the classes' log gains in spreads of the unlit one, below which nothing
            is tagged. Camera motion has heavy tails, so five is not as much as it seems; what is found must
            also come often enough and with the same pattern each time.
        full_lit: a frame is lit when every row has at least this share of the pulse's light.
        none_lit: a frame is unlit when no row has more than this.
        risk: a label is given only when the probability that it is wrong, over the uncertain pulse edges,
            is below this; otherwise the frame is called partial.
        stamp_sigma_s: standard deviation of the frames' time stamps; a label must hold within three of them.
        clip_display: display value from which a pixel counts as clipped; video encoders leave clipped areas
            a few codes below white.
        clipped_share: share of the picture from which a frame is remarked as `clipped`.
        hopeless_share: the same from which it is excluded as `clipped_frame`.
        mains_hz: flicker frequencies of mains light, twice the line frequency.
    """

    exposure_s: float | None = None
    readout_s: float | None = None
    readout_sigma_s: float = 0.0
    shortest_period_s: float = 0.5
    longest_period_s: float = 2.0
    longest_on_s: float = 0.35
    min_separation: float = 5.0
    full_lit: float = 0.98
    none_lit: float = 0.02
    risk: float = 0.01
    stamp_sigma_s: float = 0.0
    clip_display: float = 0.98
    clipped_share: float = 0.02
    hopeless_share: float = 0.5
    mains_hz: tuple[float, ...] = (100.0, 120.0)

    def __post_init__(self) -> None:
        """Checks that the numbers make sense together."""
        if not 0 < self.shortest_period_s < self.longest_period_s:
            raise ValueError(
                f"the period's limits {self.shortest_period_s}..{self.longest_period_s} s are not an interval"
            )
        if not 0 < self.longest_on_s < self.longest_period_s:
            raise ValueError(
                f"longest_on_s is {self.longest_on_s}; it must be positive and below the longest period"
            )
        if not 0 <= self.none_lit < self.full_lit <= 1:
            raise ValueError(
                f"none_lit {self.none_lit} and full_lit {self.full_lit} must satisfy 0 <= none < full <= 1"
            )
        if not 0 <= self.readout_sigma_s < 1:
            raise ValueError(
                f"readout_sigma_s is {self.readout_sigma_s}; it must not be negative, and below 1 s"
            )
        if self.exposure_s is not None and not 0 < self.exposure_s < 1:
            raise ValueError(f"exposure_s is {self.exposure_s}; it must be positive and below 1 s")
