"""Known clocks through lines with known delays: the fit finds them, and no claimed sigma is too small."""

import math

import numpy as np
import pytest

from capture.clock_fit import MEMORY_S, ClockFit

HZ = 250_000
PERIOD_S = 0.37
BURST = 8


class Clock:
    """A device's counter that begins anywhere in its 64 bits, and the line to it.

    `there` and `back` give the delay of each way in seconds.
    """

    def __init__(self, seed, drift_ppm=0.0, wander_per_s=0.0, there=None, back=None, origin=None):
        self.random = np.random.default_rng(seed)
        self.origin = 2**63 + int(self.random.integers(1e9)) if origin is None else origin
        self.host_zero_s = 1e5 + self.random.random()
        self.drift, self.wander = drift_ppm * 1e-6, wander_per_s
        self.there, self.back = there, back or there
        self.step_s = 0.0
        self.t = 0.0

    def ticks(self, t):
        shown = (1 + self.drift) * t + 0.5 * self.wander * t * t + self.step_s
        return (self.origin + math.floor(HZ * shown)) % 2**64

    def host_s(self, t):
        return self.host_zero_s + t

    def give(self, fit, count):
        for _ in range(count):
            self.t += 0.05 if fit.samples < BURST else PERIOD_S
            before = self.host_s(self.t) - self.there(self.random)
            fit.add(self.ticks(self.t), before, self.host_s(self.t) + self.back(self.random))

    def errors(self, fit, ahead_s):
        """(error, claimed sigma) of the moment `ahead_s` after the last sample."""
        said, sigma = fit.host_s(self.ticks(self.t + ahead_s))
        return said - self.host_s(self.t + ahead_s), sigma


def uniform(least_s, jitter_s):
    return lambda random: least_s + jitter_s * random.random()


def held_up(least_s, jitter_s):
    """A USB line on a busy machine: exponential jitter, and one in ten held up by anything up to seconds."""
    return lambda random: (
        least_s + jitter_s * random.exponential() + (random.random() < 0.1) * 0.005 * random.pareto(1.2)
    )


LINES = {
    "quick": (uniform(30e-6, 20e-6), None),
    "usb": (uniform(0.5e-3, 1e-3), None),
    "heavy tails": (held_up(0.5e-3, 0.1e-3), None),
    "slow there": (uniform(2e-3, 0.2e-3), uniform(0.1e-3, 0.2e-3)),
    "slow back": (uniform(0.1e-3, 0.2e-3), uniform(2e-3, 0.2e-3)),
}


@pytest.mark.parametrize("drift_ppm", [0, 20, -200, 200, 4000])
@pytest.mark.parametrize("line", LINES)
def test_the_claimed_sigma_covers_the_error(line, drift_ppm):
    """Before, at, and beyond the samples, from the first burst on.

    The sigma holds an unknown division of the quickest round trip as a uniform error, whose worst is 1.7
    sigma; the rest is noise, whose worst of thousands is 4 sigma. Claims are not absurdly large either.
    """
    ratios = []
    for seed in range(5):
        clock = Clock(seed, drift_ppm, there=LINES[line][0], back=LINES[line][1])
        fit = ClockFit(HZ)
        clock.give(fit, BURST)
        for _ in range(12):
            for ahead_s in (-1.0, 0.0, 1.0, 10.0, 60.0):
                error, sigma = clock.errors(fit, ahead_s)
                ratios.append(error / sigma)
            clock.give(fit, 6)
            assert abs(fit.drift_ppm - drift_ppm) < 5 * fit.drift_sigma_ppm
        assert fit.drift_ppm == pytest.approx(drift_ppm, abs=30)  # 1 ms of jitter over 15 s and 40 samples
        assert clock.errors(fit, 0.0)[1] < 1.2e-3
    assert np.max(np.abs(ratios)) < 4.5
    assert np.sqrt(np.mean(np.square(ratios))) < 1.8


def test_jitter_averages_out():
    """A millisecond of USB jitter leaves 0.1 ms: 1 ms / sqrt(12) over 40 samples, twice that at their end."""
    errors = []
    for seed in range(10):
        clock = Clock(seed, 50, there=uniform(0.5e-3, 1e-3))
        fit = ClockFit(HZ)
        clock.give(fit, 150)
        errors.append(clock.errors(fit, 0.0)[0])
    assert np.sqrt(np.mean(np.square(errors))) < 0.1e-3


@pytest.mark.parametrize("wander_per_s", [0.2e-6, -0.5e-6])
def test_a_rate_that_changes_is_followed(wander_per_s):
    """The line lags by its memory squared times the wander: 0.11 ms, and says so."""
    for seed in range(5):
        clock = Clock(seed, 50, wander_per_s, there=uniform(30e-6, 20e-6))
        fit = ClockFit(HZ)
        clock.give(fit, BURST)
        for _ in range(40):
            clock.give(fit, 5)
            error, sigma = clock.errors(fit, 0.5)
            assert abs(error) < 1.5 * MEMORY_S**2 * 0.5e-6
            assert abs(error) < 4 * sigma


def test_held_up_round_trips_hardly_matter():
    quiet = Clock(1, 50, there=uniform(0.2e-3, 0.05e-3))
    fit = ClockFit(HZ)
    for k in range(100):
        quiet.give(fit, 1)
        if k % 4 == 3:  # 200 ms late on the way there, all on the same side
            quiet.t += PERIOD_S
            fit.add(quiet.ticks(quiet.t), quiet.host_s(quiet.t) - 0.2, quiet.host_s(quiet.t) + 0.0002)
    assert fit.outliers == 0  # late is not wrong
    assert abs(quiet.errors(fit, 0.0)[0]) < 0.05e-3


def test_one_impossible_sample_is_dropped_and_widens_the_claim_until_the_next():
    clock = Clock(2, there=uniform(0.2e-3, 0.05e-3))
    fit = ClockFit(HZ)
    clock.give(fit, 40)
    _, before = clock.errors(fit, 0.0)
    assert not fit.add(clock.ticks(clock.t + 1), clock.host_s(clock.t + 1.5), clock.host_s(clock.t + 1.501))
    error, sigma = clock.errors(fit, 0.0)
    assert abs(error) < 0.05e-3
    assert sigma > 0.4
    clock.t += 1.0
    clock.give(fit, 1)
    assert clock.errors(fit, 0.0)[1] < 1.5 * before
    assert (fit.outliers, fit.restarts) == (1, 0)


@pytest.mark.parametrize("step_s", [-0.5, 0.05, 1000.0])
def test_a_clock_that_is_set_is_found_again_and_never_claimed_to_be_known_in_between(step_s):
    clock = Clock(3, 100, there=uniform(0.2e-3, 0.1e-3))
    fit = ClockFit(HZ)
    clock.give(fit, 60)
    clock.step_s = step_s
    for _ in range(10):
        clock.give(fit, 1)
        error, sigma = clock.errors(fit, 0.0)
        assert abs(error) < 4 * sigma
    assert abs(error) < 0.3e-3
    assert (fit.outliers, fit.restarts) == (0, 1)


def test_a_quickest_round_trip_of_long_ago_does_not_make_a_slower_line_look_exact():
    """From 0.2 ms to 5 ms each way, all of it there: 2.5 ms are unknown, and 4 sigma must hold them."""
    clock = Clock(4, 30, there=uniform(0.1e-3, 0.02e-3))
    fit = ClockFit(HZ)
    clock.give(fit, 100)
    clock.there, clock.back = uniform(5e-3, 0.02e-3), uniform(0.1e-3, 0.02e-3)
    for _ in range(250):
        clock.give(fit, 1)
        error, sigma = clock.errors(fit, 0.0)
        assert abs(error) < 4 * sigma


@pytest.mark.parametrize("origin", [0, 2**32 - 1000, 2**63 - 1000, 2**64 - 1000])
def test_ticks_of_64_bits_lose_nothing_and_may_wrap(origin):
    clock = Clock(5, 100, there=lambda _: 0.0, origin=origin)
    fit = ClockFit(HZ)
    clock.give(fit, 60)
    for ahead_s in (-5.0, 0.0, 0.3):
        error, _ = clock.errors(fit, ahead_s)
        assert abs(error) < 2 / HZ  # a counter shows the tick that has begun: half of one on the average
        host_s = clock.host_s(clock.t + ahead_s)
        there_and_back = fit.device(host_s)
        assert (there_and_back - clock.ticks(clock.t + ahead_s) + 2**63) % 2**64 - 2**63 in range(-2, 3)


def test_a_round_trip_that_ends_before_it_begins_is_refused():
    fit = ClockFit(HZ)
    with pytest.raises(ValueError, match="before it begins"):
        fit.add(0, 2.0, 1.0)
    with pytest.raises(ValueError, match="no time"):
        fit.add(0, math.nan, 1.0)
    with pytest.raises(ValueError, match="positive rate"):
        ClockFit(0)
    with pytest.raises(ValueError, match="not known"):
        fit.device(1.0)


def test_the_report_holds_plain_values():
    fit = ClockFit(HZ)
    assert fit.report()["drift_ppm"] is None
    clock = Clock(6, 100, there=uniform(0.5e-3, 1e-3))
    clock.give(fit, 100)
    report = fit.report()
    assert all(value is None or type(value) in (int, float) for value in report.values())
    assert report["drift_ppm"] == pytest.approx(100, abs=30)
    assert 1e-3 < report["quickest_round_trip_s"] < 1.5e-3
