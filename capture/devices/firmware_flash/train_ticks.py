"""A train in the device's own ticks and microseconds, from one in host time.

The device runs the train by its clock alone, so the beginning is told as its tick, and the period and width
in seconds as it counts them.
"""

from __future__ import annotations

from capture.devices.firmware_flash.device_clock import DeviceClock
from capture.devices.flash import PulseTrain
from capture.errors import FlashError
from firmware_protocol import Hello, Train
from firmware_protocol.limits import FULL_LEVEL, MAX_ON_MS, MIN_PERIOD_US
from firmware_protocol.messages import Capability

#: The firmware takes no train that begins sooner.
LEAD_S = 1e-3
#: No crystal is off by more.
_CRYSTAL_PPM = 200.0


def in_ticks(train: PulseTrain, hello: Hello, clock: DeviceClock, now_s: float, description: str) -> Train:
    """The command that has the device run `train`.

    Args:
        train: Host clock.
        hello: The device's own words.
        clock: Of the device; at least one round trip old.
        now_s: Host clock.
        description: Of the line, for the messages.

    Raises:
        FlashError: It begins too soon to be told in time, or is dimmed and the device cannot dim.
    """
    level = round(train.level * FULL_LEVEL)
    if level != FULL_LEVEL and not hello.capabilities & Capability.DIMMABLE:
        raise FlashError(f"{description} cannot dim its light to {train.level:.2f}; use level 1.")
    t0_tick = clock.fit.device(train.start_s)
    ahead_s = train.start_s - now_s
    least_s = LEAD_S + min(clock.round_trips_s, default=0.0) + 3 * clock.fit.host_s(t0_tick)[1]
    if ahead_s < least_s:
        raise FlashError(
            f"start_s is {ahead_s * 1e3:.1f} ms ahead; {description} must be told at least "
            f"{least_s * 1e3:.1f} ms before the first flash."
        )
    rate = _rate(clock)
    return Train(
        hello.boot_nonce,
        t0_tick,
        max(MIN_PERIOD_US, round(train.period_s * rate * 1e6)),
        min(MAX_ON_MS * 1000, max(1, round(train.on_s * rate * 1e6))),
        train.count,
        level,
    )


def _rate(clock: DeviceClock) -> float:
    """The device's seconds in a second of the host; 1 unless it is known to be something else.

    The first second of round trips tells it to some 50 ppm on an idle machine and ten times worse on a busy
    one: a resonator's 0.3 % is seen, a crystal's 20 ppm is not and would only be made worse.
    """
    drift_ppm, sigma_ppm = clock.fit.drift_ppm, clock.fit.drift_sigma_ppm
    return 1 + drift_ppm * 1e-6 if abs(drift_ppm) > max(_CRYSTAL_PPM, 5 * sigma_ppm) else 1.0
