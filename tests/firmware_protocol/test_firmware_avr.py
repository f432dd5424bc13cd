"""The image for the ATmega328P as built, in simavr: edges to the processor cycle, watchdogs, size.

Times are simulated ones. A cycle is 62.5 ns; simavr may see a match up to an instruction late, four cycles.
"""

import re
import subprocess
from itertools import pairwise
from random import Random

import pytest

from firmware_protocol import Event, Ping, Set, Stat, Stop, Train, encode
from firmware_protocol.limits import FULL_LEVEL, HEARTBEAT_TIMEOUT_MS, MAX_ON_MS, MIN_PERIOD_US
from firmware_protocol.messages import State

CYCLE_S = 1 / 16e6
INSTRUCTION_S = 4 * CYCLE_S
TICK_S = 4e-6


def pulse_train(avr, period_us, on_us, count):
    """The pulses of a train with a restless host beside it: commands at random moments all the time."""
    avr.ready()
    avr.ask(Train(avr.nonce, avr.tick_in(0.3), period_us, on_us, count, FULL_LEVEL))
    random = Random(period_us + on_us)
    end = avr.now_s + 0.4 + count * period_us * 1e-6
    while avr.now_s < end:
        avr.ping()
        avr.run(0.005 + 0.2 * random.random())
    assert len(avr.pulses()) == count
    return avr.pulses()


@pytest.mark.parametrize("on_us", [20, 136, 10_000, 100_000, 250_000])
def test_pulses_are_exact_to_the_cycle_whatever_the_line_does(avr, on_us):
    pulses = pulse_train(avr, 1_000_000, on_us, 8)
    for start, width in pulses:
        assert width == pytest.approx(on_us * 1e-6, abs=INSTRUCTION_S)
        assert (start - pulses[0][0] + 0.5) % 1 - 0.5 == pytest.approx(0, abs=INSTRUCTION_S)


def test_a_width_between_two_ticks_is_rounded_down(avr):
    for _, width in pulse_train(avr, 500_000, 139, 4):
        assert width == pytest.approx(136e-6, abs=INSTRUCTION_S)


def test_the_shortest_pulse_is_not_a_long_one(avr):
    """4 us is less than the interrupt needs: longer by that, but not by a turn of the timer."""
    for _, width in pulse_train(avr, 500_000, 1, 4):
        assert width < 20e-6


@pytest.mark.parametrize("after_beat", range(1, 5))
def test_a_short_pulse_that_begins_within_another_interrupt_is_not_missed(avr, after_beat):
    """The main loop's beat is each 2,500 ticks; its interrupt holds up the one that sets the pulse's end."""
    avr.ready()
    for on_us in (4, 8, 12, 16):
        t0 = -(-avr.tick_in(0.1) // 2500) * 2500 + after_beat
        avr.ask(Train(avr.nonce, t0, 500_000, on_us, 2, FULL_LEVEL))
        avr.keep_alive(1.5)
    assert len(avr.pulses()) == 8
    assert all(width < 60e-6 for _, width in avr.pulses())


@pytest.mark.parametrize("low_half", [0, 1, 0xFFFE, 0xFFFF])
def test_an_edge_at_the_overflow_of_the_timer_has_the_right_tick(avr, low_half):
    avr.ready()
    t0 = (avr.tick_in(0.1) // 0x10000 + 1) * 0x10000 + low_half
    avr.ask(Train(avr.nonce, t0, 1_000_000, 0x10000 * 4 - 20_000, 1, FULL_LEVEL))
    avr.keep_alive(1)
    on, off = (packet.message.tick for packet in avr.take(Event))
    assert (on, off - on) == (t0, 0x10000 - 5000)
    ((_, width),) = avr.pulses()
    assert width == pytest.approx((0x10000 - 5000) * TICK_S, abs=INSTRUCTION_S)


def test_the_highest_rate_has_an_error_of_less_than_a_tick(avr):
    pulses = pulse_train(avr, MIN_PERIOD_US, 250_000, 15)
    for k, (start, width) in enumerate(pulses):
        assert width == pytest.approx(0.25, abs=INSTRUCTION_S)
        late = start - pulses[0][0] - k * MIN_PERIOD_US * 1e-6
        assert -INSTRUCTION_S < late < TICK_S


def test_the_ticks_of_events_are_those_of_the_pin(avr):
    pulse_train(avr, 400_000, 70_000, 5)
    ticks = [packet.message.tick for packet in avr.take(Event)]
    offsets = [when - tick * TICK_S for (when, _), tick in zip(avr.edges, ticks, strict=True)]
    assert max(offsets) - min(offsets) < INSTRUCTION_S


def test_the_stamps_of_a_pong_are_those_of_the_line(avr):
    """The clock fit of the host takes t2 for the arrival of the PING and t3 for the departure of the PONG."""
    avr.ready()
    avr.ask(Set(avr.nonce, FULL_LEVEL, 10))
    avr.run(0.1)
    (rise_s, _), *_ = avr.edges
    zero_s = rise_s - avr.take(Event)[0].message.tick * TICK_S
    for _ in range(10):
        avr.run(0.0317)
        before = len(avr.heard_s), len(avr.sent_s)
        pong = avr.ping()
        heard_s, sent_s = avr.heard_s[before[0] :], avr.sent_s[before[1] :]
        # An interrupt and the reading of the clock take some microseconds; a frame's stuffing varies more.
        assert zero_s + pong.t2_tick * TICK_S == pytest.approx(heard_s[-1], abs=20e-6)
        assert zero_s + pong.t3_tick * TICK_S == pytest.approx(sent_s[0], abs=40e-6)


def test_the_departure_of_a_pong_is_right_behind_other_answers_too(avr):
    avr.ready()
    avr.ask(Set(avr.nonce, FULL_LEVEL, 10))
    avr.run(0.1)
    zero_s = avr.edges[0][0] - avr.take(Event)[0].message.tick * TICK_S
    for number in range(5):
        avr.run(0.0317)
        avr.take()
        before = len(avr.sent_s)
        avr.write(encode(Stop(), 1000 + number) + encode(Ping(number), 2000 + number))
        avr.run(0.05)
        stat, pong = (packet for packet in avr.take() if packet.seq)
        assert isinstance(stat.message, Stat)
        departed_s = avr.sent_s[before:][-len(encode(pong.message, pong.seq))]
        assert zero_s + pong.message.t3_tick * TICK_S == pytest.approx(departed_s, abs=40e-6)


def test_the_line_runs_at_the_rate_of_the_specification(avr):
    """Ten bits a byte at 115,200 baud within the 2.5 % that a receiver forgives; simavr counts eleven."""
    avr.run(1.2)
    gaps = [b - a for a, b in pairwise(avr.sent_s[2:])]
    assert max(gaps) < 100e-6
    assert min(gaps) == pytest.approx(11 / 115_200, rel=0.025)


@pytest.mark.parametrize("lit", [True, False])
def test_a_hanging_processor_is_reset_and_the_lamp_dark_within_the_limit(avr, lit):
    """Interrupts off and an endless loop: the compare unit ends the pulse, the hardware watchdog the rest."""
    avr.ready()
    old = avr.nonce
    avr.ask(Train(old, avr.tick_in(0.3), 1_000_000, 50_000, 1000, FULL_LEVEL))
    avr.run(0.29 if lit else 0.1)
    assert avr.lit == lit
    avr.command("hang")
    avr.run(2)
    assert not avr.lit
    assert len(avr.pulses()) == lit
    assert all(width <= 0.05 + INSTRUCTION_S for _, width in avr.pulses())
    answer = avr.ask(Stop())
    assert answer.state == State.SAFE  # it says that a watchdog has been at work
    assert answer.boot_nonce not in (0, old)
    assert isinstance(avr.ask(Set(answer.boot_nonce, FULL_LEVEL, 10)), Stat)


def test_a_processor_that_hangs_at_any_moment_keeps_no_lamp_on(avr):
    """Around both edges, from before the pulse is armed to after its end."""
    avr.ready()
    random = Random(5)
    for _ in range(25):
        avr.ask(Train(avr.nonce, avr.tick_in(0.1), 1_000_000, 200_000, 10, FULL_LEVEL))
        avr.run(random.choice([0.08, 0.28]) + random.uniform(-0.005, 0.005))
        avr.command("hang")
        avr.run(1.3)
        assert not avr.lit
        avr.hello()
    assert avr.pulses()
    assert all(width <= 0.2 + INSTRUCTION_S for _, width in avr.pulses())


def test_killing_the_host_ends_the_train_in_time(avr):
    """Nothing more comes from the line: the last flash has ended 1.5 s after the last word."""
    avr.ready()
    avr.ask(Train(avr.nonce, avr.tick_in(0.2), 400_000, 250_000, 60_000, FULL_LEVEL))
    last_word = avr.now_s
    avr.run(10)
    assert not avr.lit
    assert len(avr.pulses()) == 4
    assert avr.edges[-1][0] - last_word < HEARTBEAT_TIMEOUT_MS / 1000 + 0.02
    assert all(width <= MAX_ON_MS / 1000 + INSTRUCTION_S for _, width in avr.pulses())


def test_a_reset_at_any_moment_of_a_pulse_turns_the_lamp_off(avr):
    avr.ready()
    for wait in (0.0, 0.085, 0.1, 0.1337, 0.19):
        avr.ask(Train(avr.nonce, avr.tick_in(0.1), 1_000_000, 100_000, 10, FULL_LEVEL))
        avr.run(wait)
        avr.command("reset")
        avr.run(1.2)
        assert not avr.lit
        assert avr.hello().boot_nonce
    assert all(width <= 0.1 + INSTRUCTION_S for _, width in avr.pulses())


def test_the_other_lamp_pin_works_as_well(avr_on_d10):
    for _, width in pulse_train(avr_on_d10, 500_000, 100_000, 3):
        assert width == pytest.approx(0.1, abs=INSTRUCTION_S)


def test_the_image_fits_with_room_for_the_stack(avr, avr_build):
    """32,256 bytes beside the boot loader; 2,048 bytes of RAM that data and stack share."""
    size = subprocess.run(
        ["avr-size", "-A", avr_build / "flash.elf"], capture_output=True, text=True, check=True
    ).stdout
    sections = {name: int(count) for name, count in re.findall(r"^(\.\w+)\s+(\d+)", size, re.MULTILINE)}
    assert sections[".text"] + sections[".data"] < 16_384
    data_end = 0x100 + sum(sections.get(name, 0) for name in (".data", ".bss", ".noinit"))
    pulse_train(avr, 400_000, 10_000, 5)
    avr.write(b"?\n" + b"\x55" * 300 + b"\0")
    avr.run(0.2)
    assert avr.ask(Stop()).pulses == 5
    assert avr.stack - data_end > 200


def test_the_image_has_no_heap_and_no_floating_point(avr_build):
    listing = subprocess.run(["avr-nm", avr_build / "flash.elf"], capture_output=True, text=True, check=True)
    names = {line.split()[-1] for line in listing.stdout.splitlines()}
    assert "device_poll" in names
    assert not names & {"malloc", "calloc", "realloc", "free"}
    assert not [name for name in names if re.fullmatch(r"__\w*sf\w*\d?|__fp_\w+", name)]
