"""Thousands of byte-level faults on the line, and resets between any two bytes: the lamp always ends off."""

import json
from pathlib import Path
from random import Random

import pytest

import firmware_protocol
from firmware_protocol import Hello, Ping, Pong, Set, Stop, Train, encode
from firmware_protocol.limits import FULL_LEVEL, HEARTBEAT_TIMEOUT_MS, MAX_ON_MS, MAX_RATE_HZ

VECTORS = json.loads((Path(firmware_protocol.__file__).parent / "vectors.json").read_text())

# After this much silence nothing may be lit: the heartbeat has been lost, and a poll has noticed.
SILENCE_S = HEARTBEAT_TIMEOUT_MS / 1000 + 0.03

# Edges fall on ticks, 4 us on the ATmega328P, and simavr sees them up to four cycles late.
SLACK_S = 1e-6


def session(flash, random):
    """What a host sends in one go, with a train that begins while the last of it arrives."""
    nonce = flash.nonce
    t0 = round((flash.now_s - flash.zero_s + random.uniform(0.02, 0.3)) * flash.tick_hz)
    period_us = random.choice([333_334, 400_000, 1_000_000])
    messages = [
        Hello.from_host("faults"),
        Ping(round(flash.now_s * 1e6)),
        Set(nonce, FULL_LEVEL, random.choice([1, 100, MAX_ON_MS])),
        Train(nonce, t0, period_us, random.choice([50, 100_000, 250_000]), 60_000, FULL_LEVEL),
        Ping(2**64 - 1),
    ]
    if random.random() < 0.2:
        messages.append(Stop())
    return b"".join(encode(message, random.randrange(1, 0x10000)) for message in messages)


def damage(wire, random):
    """One to five faults: flipped bits, lost bytes, foreign bytes, a torn end, a repeat."""
    wire = bytearray(wire)
    for _ in range(random.randrange(1, 6)):
        where = random.randrange(len(wire) + 1)
        kind = random.randrange(6)
        if kind == 0 and where < len(wire):
            wire[where] ^= 1 << random.randrange(8)
        elif kind == 1:
            del wire[where : where + random.randrange(1, 30)]
        elif kind == 2:
            wire[where:where] = random.randbytes(random.randrange(1, 90))
        elif kind == 3:
            del wire[max(where, 1) :]
        elif kind == 4:
            wire[where:where] = wire[max(0, where - 40) : where]
        else:
            wire[where:where] = bytes.fromhex(random.choice(VECTORS["faults"] + VECTORS["frames"])["wire"])
    return bytes(wire)


def begin(flash):
    flash.ready()
    flash.zero_s = flash.now_s - flash.ping().t3_tick / flash.tick_hz  # to within the 20 ms of a ping
    return flash


def expect_recovery(flash):
    """Silence, darkness, and one delimiter is all that a frame needs to be heard again."""
    silent_s = flash.now_s
    flash.run(SILENCE_S + 0.5)
    assert not flash.lit
    assert not flash.edges or flash.edges[-1][0] < silent_s + SILENCE_S
    flash.take()
    flash.write(b"\0")
    assert isinstance(flash.ping(), Pong)


def expect_limits(flash):
    """Over everything that has happened: no pulse too long, no second with a fourth flash."""
    starts = [start for start, _ in flash.pulses()]
    assert starts, "the faults were so many that nothing was tested"
    assert max(width for _, width in flash.pulses()) <= MAX_ON_MS / 1000 + SLACK_S
    assert all(b - a >= 1 - SLACK_S for a, b in zip(starts, starts[MAX_RATE_HZ:], strict=False))


def run_faults(flash, count, random):
    begin(flash)
    for _ in range(count):
        wire = damage(session(flash, random), random)
        cut = random.randrange(len(wire) + 1)
        flash.write(wire[:cut])
        flash.run(random.choice([0.001, 0.05, 0.4]))
        flash.write(wire[cut:])
        flash.run(random.choice([0.001, 0.7]))
        expect_recovery(flash)
    expect_limits(flash)


def test_damaged_sessions_end_dark_and_are_recovered_from(double):
    """With three faults a session on the average, some two thousand faults."""
    run_faults(double, 700, Random(1))


def test_damaged_sessions_on_the_atmega328p(avr):
    run_faults(avr, 30, Random(2))


@pytest.mark.parametrize("device", ["double", "avr"])
def test_a_reset_between_any_two_bytes_ends_dark(device, request):
    flash = begin(request.getfixturevalue(device))
    random = Random(3)
    length = len(session(flash, random))
    for cut in range(0, length, 1 if device == "double" else 9):
        wire = session(flash, random)
        flash.write(wire[:cut])
        flash.run(random.choice([0.02, 0.3]))
        flash.command("reset")
        flash.run(0.05)
        assert not flash.lit
        flash.write(wire[cut:])
        expect_recovery(flash)
        flash.zero_s = flash.now_s - flash.ping().t3_tick / flash.tick_hz
        old, flash.nonce = flash.nonce, flash.hello().boot_nonce
        assert flash.nonce not in (0, old)
    expect_limits(flash)


def test_boot_noise_and_a_wrong_baud_rate_light_nothing(flash):
    begin(flash)
    random = Random(4)
    for _ in range(12):
        flash.write(random.randbytes(random.randrange(1, 1500)))
        flash.run(0.3)
        flash.write(bytes(random.choice([0x00, 0x80, 0xF8, 0xFE]) for _ in range(200)))
        flash.run(0.1)
    assert flash.edges == []
    flash.write(b"\0")
    assert isinstance(flash.ping(), Pong)


def test_a_timer_that_fails_is_noticed_by_the_main_loop(double):
    """The guard above the hardware: an edge off that does not come is made by software."""
    begin(double)
    double.ask(Set(double.nonce, FULL_LEVEL, 100), within_s=0.01)
    double.command("break")
    double.run(1)
    ((_, width),) = double.pulses()
    # 250 ms, 5 ms of patience, and the loop's own 10 ms.
    assert MAX_ON_MS / 1000 < width <= 0.266
    assert double.ask(Stop()).state == 3


@pytest.mark.parametrize("start", [2**32 - 1_500_000, 2**63 - 1_500_000, 2**64 - 1_500_000])
def test_a_clock_that_wraps_in_the_middle_of_a_train_changes_nothing(host_build, opened, start):
    with opened(host_build / "flash_double", "--clock", start) as flash:
        flash.run(1.05)
        flash.hello()
        t0 = (start + round((1.07 + 0.2) * 1e6)) % 2**64
        flash.ask(Train(flash.nonce, t0, 400_000, 100_000, 6, FULL_LEVEL))
        flash.keep_alive(3)
        begun = [round(on * 1e6) for on, _ in flash.pulses()]
        assert len(begun) == 6
        flash.run(2)
        assert not flash.lit
