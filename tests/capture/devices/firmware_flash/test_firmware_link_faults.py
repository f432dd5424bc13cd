"""The host over a line that damages: the firmware's lamp ends off, the host recovers or says why.

Each case is a session with its own seed: open, trains, polls, off, close, with flipped bits, lost, doubled
and foreign bytes both ways, a host that is held up, resets between any two bytes, and unplugging. All in
simulated time. FLASH_FAULT_CASES=20000 in the environment runs more of them.
"""

import os
from random import Random

import pytest
from flash_doubles import StepLine, SteppedCore, SteppedProgram, build, damage

from capture.devices.bench import Bench
from capture.devices.firmware_flash.flash import open_firmware_flash
from capture.devices.flash import PulseTrain
from capture.errors import FlashError, FlashGoneError, FlashResetError
from firmware_protocol.limits import HEARTBEAT_TIMEOUT_MS, MAX_ON_MS, MAX_RATE_HZ

CASES = int(os.environ.get("FLASH_FAULT_CASES", "160"))
#: Silence, and a round of the main loop.
SILENCE_S = HEARTBEAT_TIMEOUT_MS / 1000 + 0.03
#: The longest that each call may take: patience for HELLO, a burst of PINGs each 100 ms late, the second of
#: darkness, STOP; ten tries and the same again after a reset; five tries.
OPEN_S = 5.0 + 8 * 0.14 + 1.1 + 1.1 + 0.6
START_S = 1.1 + OPEN_S
OFF_S = 0.6


class FaultyLine(StepLine):
    """Damages what passes.

    Attributes:
        odds: Of each fault, per byte; 0 = a sound line.
    """

    def __init__(self, device, random, odds, **settings):
        super().__init__(device, **settings)
        self.random, self.odds = random, odds
        self.faults = 0

    def _damage(self, data):
        damaged = damage(data, self.random, self.odds)
        self.faults += damaged != data
        return damaged

    def write(self, data):
        if self.odds and self.random.random() < 0.3 * self.odds * len(data):
            cut = self.random.randrange(len(data) + 1)  # a reset, a held up host or a pulled plug in a frame
            super().write(self._damage(data[:cut]))
            self.faults += 1
            kind = self.random.randrange(8)
            if kind < 3:
                self.reset()
            elif kind < 7:
                self.sleep(self.random.choice([0.02, 0.3, 1.0, 2.5]))
            else:
                self.unplugged = True
            data = data[cut:]
        super().write(self._damage(data))

    def read(self, timeout_s):
        if self.odds and self.random.random() < 0.02 * self.odds * 100:
            self.sleep(self.random.choice([0.01, 0.1, 0.4]))  # the machine is busy
        return self._damage(super().read(timeout_s))


def opened(line):
    line.closed = False
    return open_firmware_flash(line, Bench(line), url="faulty:", back_end="serial")


class Timed:
    """Calls that may fail with FlashError and with nothing else, and must be back in time."""

    def __init__(self, line):
        self.line = line
        self.errors = []

    def __call__(self, limit_s, call, *arguments):
        before_s = self.line.now_s()
        slept = self.line.slept_s
        try:
            return call(*arguments)
        except FlashError as error:
            self.errors.append(error)
            return None
        finally:
            held_up_s = self.line.slept_s - slept
            assert self.line.now_s() - before_s <= limit_s + held_up_s


class CountingLine(FaultyLine):
    """Knows how long its own faults have held the host up."""

    slept_s = 0.0
    reading = False

    def sleep(self, seconds):
        self.slept_s += seconds
        super().sleep(seconds)


def session(line, random):
    """What a controller does; every error is one that a user can be told."""
    timed = Timed(line)
    flash = timed(OPEN_S, opened, line)
    if flash is None:
        return timed, None
    for _ in range(random.randrange(1, 4)):
        train = PulseTrain(
            start_s=line.now_s() + random.choice([0.05, 0.2, 0.6]),
            period_s=random.choice([0.34, 0.5, 1.0]),
            on_s=random.choice([0.001, 0.1, 0.25]),
            count=random.choice([1, 3, 1000]),
        )
        timed(START_S, flash.start, train)
        last_s = -1.0
        for _ in range(random.randrange(5, 40)):
            for edge in timed(0.1, flash.poll) or ():
                assert edge.sigma_s > 0
                assert edge.time_s >= last_s - 0.1
                last_s = edge.time_s
            StepLine.sleep(line, 0.05)
    return timed, flash


def expect_dark_end(line, timed, flash):
    if flash is not None:
        confirmed = timed(OFF_S, flash.off)
        assert confirmed in (True, False)
        if confirmed:
            assert not line.device.edges or not line.device.edges[-1][1]
        assert timed(OFF_S, flash.link_report) is not None
        assert timed(2 * OFF_S, flash.close) is None
    closed_s = line.now_s()
    StepLine.sleep(line, SILENCE_S + 0.3)
    lamp = line.lamp()
    assert not lamp or not lamp[-1][1]
    assert not lamp or lamp[-1][0] < closed_s + SILENCE_S


def expect_limits(line):
    """By the device's own clock, which keeps them."""
    lamp = line.device.edges
    starts = [t for t, on in lamp if on]
    assert all(b[0] - a[0] <= MAX_ON_MS / 1000 + 1e-6 for a, b in zip(lamp[::2], lamp[1::2], strict=True))
    third = zip(starts, starts[MAX_RATE_HZ:], strict=False)
    assert all(b - a >= 1 - 1e-6 for a, b in third)


def expect_recovery(line):
    """Whatever happened: on a sound line the same device is opened and flashes."""
    line.odds = 0
    line.unplugged = False
    line.take_all()
    with opened(line) as flash:
        before = len(line.device.edges)
        train = PulseTrain(start_s=line.now_s() + 0.1, period_s=0.4, on_s=0.05, count=2)
        flash.start(train)
        edges = []
        while line.now_s() < train.end_s + 0.1:
            edges += flash.poll()
            StepLine.sleep(line, 0.02)
        edges += flash.poll()
    assert [(edge.pulse, edge.on) for edge in edges] == [(0, True), (0, False), (1, True), (1, False)]
    for (time_s, _), edge in zip(line.lamp()[before:], edges, strict=True):
        assert edge.time_s == pytest.approx(time_s, abs=5 * edge.sigma_s)


def run_case(device, seed, **settings):
    random = Random(seed)
    line = CountingLine(device, random, random.choice([3e-4, 2e-3, 1e-2, 5e-2]), **settings)
    line.boot_s = random.choice([0.0, 0.0, 0.3, 1.5])
    line.boot_noise = random.randbytes(random.randrange(60))
    timed, flash = session(line, random)
    expect_dark_end(line, timed, flash)
    expect_recovery(line)
    expect_limits(line)
    return line.faults, timed.errors


@pytest.mark.parametrize("block", range(4))
def test_sessions_over_a_line_that_damages_end_dark_and_are_recovered_from(firmware_directory, block):
    library = build(firmware_directory, "core")
    faults, errors = 0, []
    for seed in range(block * CASES // 4, (block + 1) * CASES // 4):
        device = SteppedCore(library)
        try:
            case_faults, case_errors = run_case(device, seed, rate=1 + (seed % 9 - 4) * 1e-3)
        except BaseException as error:
            error.add_note(f"seed {seed}")
            raise
        finally:
            device.close()
        faults += case_faults
        errors += case_errors
    sentences = {str(error) for error in errors}
    assert all(text.endswith(".") and "\n" not in text for text in sentences), sentences
    assert faults > 2 * CASES // 4
    kinds = {type(error) for error in errors}
    assert {FlashError, FlashGoneError, FlashResetError} <= kinds


@pytest.mark.parametrize("seed", [5, 7])
def test_sessions_with_the_chip_over_a_line_that_damages(firmware_directory, seed):
    device = SteppedProgram(build(firmware_directory, "runner"), build(firmware_directory, "flash.elf"))
    try:
        run_case(device, seed, step_us=2000)
    finally:
        device.close()
