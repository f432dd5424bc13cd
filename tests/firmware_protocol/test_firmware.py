"""What the firmware does, the same on every port: the host build, and the ATmega328P image in simavr."""

import json
from itertools import pairwise
from pathlib import Path

import pytest

import firmware_protocol
from firmware_protocol import Err, Event, Hello, Ping, Pong, Set, Stat, Stop, Train, encode
from firmware_protocol.limits import FULL_LEVEL, HEARTBEAT_TIMEOUT_MS, MAX_ON_MS, MAX_RATE_HZ, MIN_PERIOD_US
from firmware_protocol.messages import Capability, Edge, ErrorCode, State, schema_crc

VECTORS = json.loads((Path(firmware_protocol.__file__).parent / "vectors.json").read_text())
FAULTS = {example["name"]: bytes.fromhex(example["wire"]) for example in VECTORS["faults"]}

# The clock of the ATmega328P ticks each 4 us; every edge and every time rounds to that, twice at most.
TICKS_S = 8e-6


def message(kind, **values):
    """A message that Python would not build: what a broken host might send."""
    made = object.__new__(kind)
    for name, value in values.items():
        object.__setattr__(made, name, value)
    return made


def test_a_device_says_who_it_is(flash):
    flash.run(0.2)
    answer = flash.hello()
    assert (answer.protocol_major, answer.schema_crc) == (1, schema_crc())
    assert answer.boot_nonce != 0
    assert answer.capabilities == Capability.SCHEDULE
    assert answer.name.startswith("flash-c 1.0")


def test_the_lamp_is_off_from_the_start_and_while_nobody_commands(flash):
    flash.run(5)
    assert flash.edges == []
    stats = [packet.message for packet in flash.take(Stat)]
    assert len(stats) >= 4  # once a second, unasked
    assert {(stat.state, stat.level, stat.pulses) for stat in stats} == {(State.IDLE, 0, 0)}


def test_a_ping_comes_back_with_the_device_clock(flash):
    flash.ready()
    first = flash.ask(Ping(123))
    flash.run(1)
    second = flash.ask(Ping(124))
    assert (first.t1_host_us, first.boot_nonce) == (123, flash.nonce)
    assert first.t2_tick <= first.t3_tick
    # ask() lets 20 ms pass, run() a second.
    assert (second.t2_tick - first.t2_tick) / flash.tick_hz == pytest.approx(1.02, abs=TICKS_S)


def test_set_lights_for_its_time_and_no_longer(flash):
    flash.ready()
    answer = flash.ask(Set(flash.nonce, FULL_LEVEL, 100))
    assert (answer.state, answer.level) == (State.SET, FULL_LEVEL)
    flash.run(0.5)
    ((_, width),) = flash.pulses()
    assert width == pytest.approx(0.1, abs=TICKS_S)
    on, off = (packet.message for packet in flash.take(Event))
    assert (on.edge, on.pulse, on.level) == (Edge.ON, 1, FULL_LEVEL)
    assert (off.edge, off.pulse, off.level) == (Edge.OFF, 1, 0)
    assert (off.tick - on.tick) / flash.tick_hz == pytest.approx(width, abs=TICKS_S)
    assert flash.ask(Stop()).state == State.IDLE


def test_set_off_and_stop_end_a_flash_at_once(flash):
    flash.ready()
    for end in (Set(flash.nonce, 0, 0), Stop()):
        flash.ask(Set(flash.nonce, FULL_LEVEL, MAX_ON_MS))
        flash.run(0.03)
        assert flash.lit
        answer = flash.ask(end)
        assert (answer.state, answer.level) == (State.IDLE, 0)
        assert not flash.lit
        assert flash.pulses()[-1][1] < 0.06


def test_repeated_sets_never_keep_the_lamp_on_beyond_the_limit(flash):
    flash.ready()
    for _ in range(30):
        flash.ask(Set(flash.nonce, FULL_LEVEL, MAX_ON_MS), within_s=0.02)
        if not flash.lit:
            break
    flash.run(1)
    assert flash.pulses()[0][1] == pytest.approx(MAX_ON_MS / 1000, abs=TICKS_S)


def test_a_shorter_set_shortens_the_flash_that_is_lit(flash):
    flash.ready()
    flash.ask(Set(flash.nonce, FULL_LEVEL, 200))
    flash.ask(Set(flash.nonce, FULL_LEVEL, 30))
    flash.run(0.5)
    ((_, width),) = flash.pulses()
    assert 0.03 <= width < 0.06  # 20 ms between the two, plus the time a command takes on the line


def test_a_train_flashes_on_the_devices_own_clock(flash):
    flash.ready()
    t0 = flash.tick_in(0.5)
    answer = flash.ask(Train(flash.nonce, t0, 1_000_000, 100_000, 3, FULL_LEVEL))
    assert (answer.state, answer.level) == (State.TRAIN, 0)
    flash.keep_alive(4)
    assert [width for _, width in flash.pulses()] == pytest.approx([0.1] * 3, abs=TICKS_S)
    starts = [start for start, _ in flash.pulses()]
    assert [b - a for a, b in pairwise(starts)] == pytest.approx([1, 1], abs=TICKS_S)
    ticks = [p.message.tick for p in flash.take(Event) if p.message.edge == Edge.ON]
    assert ticks == [t0 + k * flash.tick_hz for k in range(3)]
    assert flash.ask(Stop()).state == State.IDLE


def test_an_odd_period_is_kept_on_the_average_and_never_too_fast(flash):
    flash.ready()
    t0 = flash.tick_in(0.5)
    flash.ask(Train(flash.nonce, t0, MIN_PERIOD_US, 20_000, 13, FULL_LEVEL))
    flash.keep_alive(5.5)
    ticks = [p.message.tick for p in flash.take(Event) if p.message.edge == Edge.ON]
    exact = [t0 + k * MIN_PERIOD_US * flash.tick_hz / 1e6 for k in range(13)]
    assert all(0 <= tick - wanted < 1 for tick, wanted in zip(ticks, exact, strict=True))
    assert min(b - a for a, b in zip(ticks, ticks[MAX_RATE_HZ:], strict=False)) >= flash.tick_hz


def test_stop_drops_a_train(flash):
    flash.ready()
    flash.ask(Train(flash.nonce, flash.tick_in(0.2), 500_000, 100_000, 100, FULL_LEVEL))
    flash.keep_alive(1)
    assert flash.ask(Stop()).state == State.IDLE
    seen = len(flash.edges)
    flash.run(3)
    assert len(flash.edges) == seen
    assert not flash.lit


def test_a_train_replaces_the_one_before_and_set_drops_it(flash):
    flash.ready()
    flash.ask(Train(flash.nonce, flash.tick_in(0.1), 500_000, 50_000, 100, FULL_LEVEL))
    flash.keep_alive(1)
    flash.ask(Train(flash.nonce, flash.tick_in(1), 1_000_000, 20_000, 100, FULL_LEVEL))
    seen = len(flash.edges)
    flash.keep_alive(2.5)
    assert [round(width, 4) for _, width in flash.pulses()][seen // 2 :] == [0.02, 0.02]
    seen = len(flash.edges)
    flash.ask(Set(flash.nonce, FULL_LEVEL, 10))
    flash.keep_alive(2.5)
    assert len(flash.edges) == seen + 2  # that SET, and nothing more


def test_without_a_heartbeat_the_train_ends_and_the_lamp_stays_off(flash):
    flash.ready()
    flash.ask(Train(flash.nonce, flash.tick_in(0.1), 1_000_000, 250_000, 1000, FULL_LEVEL))
    last_word = flash.now_s
    flash.run(5)
    assert not flash.lit
    assert all(when < last_word + HEARTBEAT_TIMEOUT_MS / 1000 + 0.03 for when, _ in flash.edges)
    errors = [packet.message for packet in flash.take(Err)]
    assert errors == [Err(ErrorCode.HEARTBEAT, 0, HEARTBEAT_TIMEOUT_MS)]
    answer = flash.ask(Stop())
    assert (answer.state, answer.heartbeats_lost) == (State.SAFE, 1)  # STOP does not wake it
    assert flash.ask(Set(flash.nonce, FULL_LEVEL, 10)).state == State.SET
    flash.run(0.1)
    assert flash.ask(Stop()).state == State.IDLE


def test_a_lost_heartbeat_turns_a_lit_lamp_off(flash):
    flash.ready()
    # The second flash is lit from 1.4 s to 1.65 s after the last word of the host.
    flash.ask(Train(flash.nonce, flash.tick_in(0.4), 1_000_000, 250_000, 1000, FULL_LEVEL))
    flash.run(3)
    assert len(flash.pulses()) == 2
    assert flash.pulses()[1][1] < 0.15


def test_an_idle_device_waits_without_complaint(flash):
    flash.ready()
    flash.run(4)
    assert flash.take(Err) == []
    assert flash.ask(Stop()).state == State.IDLE


@pytest.mark.parametrize(
    ("kind", "values", "code", "limit"),
    [
        (Set, {"level": FULL_LEVEL, "ttl_ms": 251}, ErrorCode.OUT_OF_RANGE, 250),
        (Set, {"level": FULL_LEVEL, "ttl_ms": 65535}, ErrorCode.OUT_OF_RANGE, 250),
        (Set, {"level": 1000, "ttl_ms": 100}, ErrorCode.UNSUPPORTED, FULL_LEVEL),
        (Train, {"on_us": 250_001}, ErrorCode.OUT_OF_RANGE, 250_000),
        (Train, {"on_us": 0}, ErrorCode.OUT_OF_RANGE, 1),
        (Train, {"count": 0}, ErrorCode.OUT_OF_RANGE, 1),
        (Train, {"period_us": MIN_PERIOD_US - 1}, ErrorCode.RATE, MIN_PERIOD_US),
        (Train, {"period_us": 0}, ErrorCode.RATE, MIN_PERIOD_US),
        (Train, {"level": 0}, ErrorCode.UNSUPPORTED, FULL_LEVEL),
        (Train, {"t0_tick": 1}, ErrorCode.LATE, 0),
        (Train, {"t0_tick": 2**64 - 1}, ErrorCode.LATE, 0),
    ],
)
def test_a_limit_is_held_whatever_the_host_says(flash, kind, values, code, limit):
    flash.ready()
    if kind is Train:
        usual = {"t0_tick": flash.tick_in(0.1), "period_us": 1_000_000, "on_us": 1000, "count": 1}
        values = {"boot_nonce": flash.nonce} | usual | {"level": FULL_LEVEL} | values
    else:
        values = {"boot_nonce": flash.nonce} | values
    assert flash.ask(message(kind, **values)) == Err(code, flash.seq, limit)
    flash.run(2)
    assert flash.edges == []
    assert flash.ask(Stop()).state == State.IDLE


def test_a_fourth_flash_in_one_second_is_refused(flash):
    flash.ready()
    answers = []
    for _ in range(6):
        answers.append(flash.ask(Set(flash.nonce, FULL_LEVEL, 10)))
        flash.run(0.1)
    assert [isinstance(answer, Stat) for answer in answers] == [True] * 3 + [False] * 3
    assert answers[3] == Err(ErrorCode.RATE, flash.seq - 2, MAX_RATE_HZ)
    flash.run(0.4)
    assert isinstance(flash.ask(Set(flash.nonce, FULL_LEVEL, 10)), Stat)


def test_a_train_that_would_begin_too_soon_after_other_flashes_is_refused(flash):
    flash.ready()
    for _ in range(3):
        flash.ask(Set(flash.nonce, FULL_LEVEL, 10))
        flash.run(0.05)
    soon = Train(flash.nonce, flash.tick_in(0.5), MIN_PERIOD_US, 10_000, 10, FULL_LEVEL)
    assert flash.ask(soon) == Err(ErrorCode.RATE, flash.seq, MAX_RATE_HZ)
    later = Train(flash.nonce, flash.tick_in(1.0), MIN_PERIOD_US, 10_000, 3, FULL_LEVEL)
    assert flash.ask(later).state == State.TRAIN
    flash.keep_alive(2.5)
    assert len(flash.pulses()) == 6


def test_a_reset_cannot_be_used_to_flash_faster(flash):
    """A start counts as three flashes: the lamp stays dark for its first second."""
    starts = []
    for _ in range(3):
        flash.run(0.3)
        flash.hello()
        while not isinstance(flash.ask(Set(flash.nonce, FULL_LEVEL, 5)), Stat):
            flash.run(0.05)
        for _ in range(2):
            flash.run(0.02)
            flash.ask(Set(flash.nonce, FULL_LEVEL, 5))
        flash.command("reset")
    starts = [start for start, _ in flash.pulses()]
    assert len(starts) == 9
    assert all(b - a >= 1 for a, b in zip(starts, starts[MAX_RATE_HZ:], strict=False))


def test_a_reset_turns_the_lamp_off_and_changes_the_nonce(flash):
    flash.ready()
    old = flash.nonce
    flash.ask(Train(old, flash.tick_in(0.1), 500_000, 250_000, 1000, FULL_LEVEL))
    flash.run(0.15)
    assert flash.lit
    flash.command("reset")
    flash.run(0.1)
    assert not flash.lit
    flash.run(3)
    assert not flash.lit
    assert flash.ping().boot_nonce != old
    assert flash.ask(Set(old, FULL_LEVEL, 100)) == Err(ErrorCode.STALE_NONCE, flash.seq, 0)
    assert flash.ask(Stop()).pulses == 0
    assert flash.ask(Stop()).boot_nonce == flash.hello().boot_nonce


def test_nonces_of_many_starts_differ(flash):
    nonces = set()
    for _ in range(20):
        flash.run(0.1)
        nonces.add(flash.hello().boot_nonce)
        flash.command("reset")
    assert len(nonces) == 20
    assert 0 not in nonces


def test_a_repeated_command_is_done_once_and_answered_alike(flash):
    flash.ready()
    command = encode(Set(flash.nonce, FULL_LEVEL, 20), 500)
    answers = []
    for _ in range(3):
        flash.write(command)
        flash.run(0.1)
        answers += [packet for packet in flash.take() if packet.seq == 500]
        flash.ping()  # heartbeats in between do not make a repeat a new command
    assert len(flash.pulses()) == 1
    assert len(answers) == 3
    assert len(set(answers)) == 1
    flash.write(encode(Set(flash.nonce, FULL_LEVEL, 20), 501))
    flash.run(0.1)
    assert len(flash.pulses()) == 2


def test_a_repeated_ping_gets_the_same_stamps(flash):
    flash.ready()
    first = flash.ask(Ping(9), seq=40)
    flash.run(0.5)
    assert flash.ask(Ping(9), seq=40) == first
    assert flash.ask(Ping(9), seq=41) != first


def test_a_new_host_may_count_like_the_one_before(flash):
    flash.ready()
    for _ in range(2):
        flash.seq = 0
        flash.hello()
        assert isinstance(flash.ask(Set(flash.nonce, FULL_LEVEL, 20)), Stat)
        flash.run(0.2)
    assert len(flash.pulses()) == 2


def test_frames_that_are_no_command_are_refused_or_ignored(flash):
    flash.ready()
    for name in ("message type 0x7f", "ping a byte short", "wire version 2"):
        flash.write(FAULTS[name])
    flash.run(0.05)
    assert [packet.message for packet in flash.take()] == [
        Err(ErrorCode.UNKNOWN_TYPE, 6, 0),
        Err(ErrorCode.LENGTH, 7, 8),
        Err(ErrorCode.VERSION, 5, 1),
    ]
    # What only devices say comes from a line that echoes: an answer would go round for ever.
    flash.write(b"".join(encode(m, 3) for m in (Pong(1, 2, 3, 4), Err(1, 2, 3), Event(1, 2, 1, 1, 1))))
    flash.write(encode(Stat(1, 2, 0, 0, 0, 0, 0, 0), 0))
    flash.write(encode(Hello(1, 0, schema_crc(), flash.nonce, 1, 1, "myself"), 4))
    flash.run(0.1)
    assert [packet for packet in flash.take() if packet.seq] == []


def test_a_line_that_echoes_keeps_no_lamp_alive(flash):
    flash.ready()
    flash.ask(Train(flash.nonce, flash.tick_in(0.1), 400_000, 100_000, 1000, FULL_LEVEL))
    for _ in range(40):
        flash.raw = b""
        flash.run(0.1)
        flash.write(flash.raw)
    assert flash.ask(Stop()).state == State.SAFE
    assert len(flash.pulses()) <= 4


def test_line_errors_are_counted(flash):
    flash.ready()
    flash.write(FAULTS["a checksum off by one bit"])
    flash.write(FAULTS["too short for a checksum"])
    flash.write(FAULTS["a code byte that points past the end"])
    flash.write(FAULTS["sixty-four bytes and no delimiter"])
    flash.run(0.05)
    answer = flash.ask(Stop())
    assert (answer.crc_errors, answer.framing_errors) == (1, 3)


def test_a_delimiter_is_heard_after_more_noise_than_the_device_can_hold(flash):
    flash.ready()
    flash.write(b"\x55" * 1000 + b"\0" + encode(Ping(1), 9))
    flash.run(0.2)
    assert [type(packet.message) for packet in flash.take() if packet.seq == 9] == [Pong]


def test_a_person_at_a_terminal_gets_a_banner(flash):
    flash.ready()
    for typed in (b"?\n", b"?\r\n"):
        flash.raw = b""
        flash.write(typed)
        flash.run(0.1)
        assert b"Flash of the relightable portrait rig" in flash.raw
        assert b"at most 250 ms on, at most 3 flashes a second" in flash.raw
        assert flash.raw.isascii()
        assert isinstance(flash.ping(), Pong)


def test_a_flood_of_commands_tears_no_frame(flash):
    """More is asked than the line can answer: whole answers are missing, none is damaged."""
    flash.ready()
    flash.raw = b""
    flash.write(b"".join(encode(Stop(), seq) for seq in range(1000, 1200)))
    flash.run(1)
    answers = [packet.seq for packet in flash.take() if packet.seq]
    assert answers
    assert answers == sorted(answers)
    assert flash.noise == []
    assert flash.ask(Stop()).framing_errors == 0


def test_a_flood_of_commands_drowns_no_event(flash):
    flash.ready()
    flash.ask(Train(flash.nonce, flash.tick_in(0.1), 400_000, 1000, 3, FULL_LEVEL))
    for _ in range(10):
        flash.write(encode(Ping(1), 7) * 80)
        flash.run(0.13)
    assert [packet.message.pulse for packet in flash.take(Event)] == [1, 1, 2, 2, 3, 3]
