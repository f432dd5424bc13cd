"""The firmware's flash in simulated time: the C core in this process, and the chip in simavr."""

from dataclasses import replace

import pytest
from flash_contract import FlashContract, FlashRig
from flash_doubles import StepLine, SteppedCore, SteppedProgram, build

from capture.devices.bench import Bench
from capture.devices.firmware_flash.flash import open_firmware_flash
from capture.devices.firmware_flash.link import refusal
from capture.devices.flash import PulseTrain
from capture.errors import FlashError, FlashGoneError, FlashResetError
from firmware_protocol import Err, Hello, Stop, encode
from firmware_protocol.messages import ErrorCode


class SteppedRig(FlashRig):
    """`line` is the transport and the clock; nobody but the test moves its time."""

    def __init__(self, line):
        self.line = self.clock = line

    def open(self):
        self.line.closed = False
        return open_firmware_flash(self.line, Bench(self.line), url="stepped:", back_end="serial")

    def lamp(self):
        return self.line.lamp()

    def kill_host(self):
        """Nobody polls any more: the whole host is what the test's thread does."""


@pytest.fixture
def core(firmware_directory):
    device = SteppedCore(build(firmware_directory, "core"))
    yield device
    device.close()


@pytest.fixture
def chip(firmware_directory):
    device = SteppedProgram(build(firmware_directory, "runner"), build(firmware_directory, "flash.elf"))
    yield device
    device.close()


class TestContractOnTheCore(FlashContract):
    @pytest.fixture
    def rig(self, core):
        return SteppedRig(StepLine(core))


class TestContractOnTheChip(FlashContract):
    @pytest.fixture
    def rig(self, chip):
        return SteppedRig(StepLine(chip, step_us=1000))


class TestContractOnAClockThatIsOffAndWraps(FlashContract):
    """Ticks go through 2^64, at 0.4 % too fast."""

    @pytest.fixture
    def rig(self, firmware_directory):
        device = SteppedCore(build(firmware_directory, "core"), clock_us=2**64 - 2_500_000)
        line = StepLine(device, rate=1.004)
        line.sleep(1.05)  # its second of darkness, which such a counter does not tell
        yield SteppedRig(line)
        device.close()


@pytest.fixture
def rig(core):
    return SteppedRig(StepLine(core))


def lit_soon(rig, flash, **changes):
    """A train that has just begun, lit."""
    train = PulseTrain(start_s=rig.clock.now_s() + 0.15, **({"on_s": 0.2, "count": 100} | changes))
    flash.start(train)
    edges = rig.watch(flash, 0.2)
    assert [edge.on for edge in edges] == [True]
    return train


def poll_until_it_raises(rig, flash, kind, within_s):
    end_s = rig.clock.now_s() + within_s
    while rig.clock.now_s() < end_s:
        try:
            flash.poll()
        except kind as error:
            return str(error)
        rig.clock.sleep(0.01)
    raise AssertionError(f"no {kind.__name__} came in {within_s} s")


def test_a_clock_that_is_off_by_more_than_a_crystal_gets_its_trains_in_host_time(core):
    """A resonator 0.4 % fast: ten flashes later that would be 40 ms; the first second tells it to 50 ppm."""
    rig = SteppedRig(StepLine(core, rate=1.004))
    with rig.open() as flash:
        train = PulseTrain(start_s=rig.clock.now_s() + 0.2, period_s=1.0, on_s=0.1, count=11)
        flash.start(train)
        edges = rig.watch(flash, 11)
        assert flash.link_report()["clock"]["drift_ppm"] == pytest.approx(4000, abs=20)
    lamp = rig.lamp()
    for k in range(11):
        assert lamp[2 * k][0] == pytest.approx(train.start_s + k, abs=1e-3 + k * 100e-6)
        assert lamp[2 * k + 1][0] - lamp[2 * k][0] == pytest.approx(0.1, abs=20e-6)
    for (time_s, _), edge in zip(lamp, edges, strict=True):
        assert edge.time_s == pytest.approx(time_s, abs=4 * edge.sigma_s)


def test_a_reset_while_lit_is_said_once_and_the_next_train_runs(rig):
    with rig.open() as flash:
        lit_soon(rig, flash)
        rig.line.reset()
        assert not rig.lamp()[-1][1]
        message = poll_until_it_raises(
            rig, flash, FlashResetError, 1.2
        )  # its first words come within a second
        assert "restarted" in message
        flash.poll()
        train = PulseTrain(start_s=rig.clock.now_s() + 2.0, count=1)
        flash.start(train)
        assert [edge.on for edge in rig.watch(flash, 2.3)] == [True, False]
        assert flash.link_report()["resets"] == 1
        assert rig.lamp()[-2][0] == pytest.approx(train.start_s, abs=1e-3)


def test_a_train_told_to_a_device_that_has_just_restarted_is_refused_by_its_nonce(rig):
    with rig.open() as flash:
        rig.line.reset()
        with pytest.raises(FlashResetError):
            flash.start(PulseTrain(start_s=rig.clock.now_s() + 0.5))
        rig.watch(flash, 2)
        assert rig.lamp() == []


def test_a_device_that_resets_when_it_is_opened_is_waited_for(core):
    """Two seconds of boot loader, its noise, and the second of darkness after it."""
    line = StepLine(core, boot_s=2.0, boot_noise=b"\x00\xf8\x80garbage\r\n" * 20)
    line.reset()
    rig = SteppedRig(line)
    before_s = line.now_s()
    with rig.open() as flash:
        assert 3.0 < line.now_s() - before_s < 3.6
        flash.start(PulseTrain(start_s=line.now_s() + 0.1, count=1))
        assert len(rig.watch(flash, 0.4)) == 2


def test_an_unplugged_line_is_said_by_the_next_poll_and_by_all_calls_after_it(rig):
    flash = rig.open()
    lit_soon(rig, flash)
    rig.line.unplugged = True
    for _ in range(3):
        with pytest.raises(FlashGoneError, match="not there any more"):
            flash.poll()
    with pytest.raises(FlashGoneError):
        flash.start(PulseTrain(start_s=rig.clock.now_s() + 0.5))
    assert flash.off() is False
    flash.close()
    rig.clock.sleep(1.8)
    assert not rig.lamp()[-1][1]


def test_a_device_that_falls_silent_is_gone_after_three_seconds(rig):
    flash = rig.open()
    lit_soon(rig, flash)
    rig.line.device.feed = lambda data: None
    rig.line.device.take = lambda: b""
    before_s = rig.clock.now_s()
    assert "silent for 3.0 s" in poll_until_it_raises(rig, flash, FlashGoneError, 4)
    before_s = rig.clock.now_s()
    assert flash.off() is False
    assert rig.clock.now_s() - before_s == pytest.approx(0.5, abs=0.01)
    flash.close()
    rig.clock.sleep(1.8)
    assert not rig.lamp()[-1][1]


def test_a_host_that_was_held_up_for_two_seconds_is_told_that_the_light_has_gone_out(rig):
    with rig.open() as flash:
        lit_soon(rig, flash)
        rig.clock.sleep(2.0)
        assert "has put its light out" in poll_until_it_raises(rig, flash, FlashError, 0.1)
        flash.start(PulseTrain(start_s=rig.clock.now_s() + 0.5, count=1))
        edges = rig.watch(flash, 0.9)
        assert [(edge.pulse, edge.on) for edge in edges][-2:] == [(0, True), (0, False)]


def test_a_train_that_the_device_has_ended_is_noticed_though_its_word_was_lost(rig):
    with rig.open() as flash:
        lit_soon(rig, flash)
        take = rig.line.device.take
        rig.line.device.take = lambda: take() and b""  # ERR 8 is lost
        rig.clock.sleep(1.7)
        rig.line.device.take = take
        assert "ended its train by itself after 2 flashes" in poll_until_it_raises(
            rig, flash, FlashError, 1.1
        )
        assert rig.watch(flash, 0.5) == []


def test_a_train_of_a_host_before_us_ends_when_the_flash_is_opened(rig):
    first = rig.open()
    lit_soon(rig, first, on_s=0.25)
    with rig.open() as second:
        assert not rig.lamp()[-1][1]
        assert len(rig.lamp()) == 2
        assert rig.watch(second, 1.0) == []


def test_a_train_that_is_too_near_is_refused_with_how_near_it_may_be(rig):
    with (
        rig.open() as flash,
        pytest.raises(FlashError, match=r"0\.5 ms ahead; .* at least [1-9]\.\d ms before"),
    ):
        flash.start(PulseTrain(start_s=rig.clock.now_s() + 0.0005))


def test_a_train_that_a_bad_line_makes_late_is_refused_and_lights_nothing(rig):
    """The first TRAIN is lost; its repeat comes 100 ms later, and the flash was to begin after 50."""
    with rig.open() as flash:
        write, lost = rig.line.write, []
        rig.line.write = lambda data: write(data) if lost or len(data) < 20 else lost.append(data)
        with pytest.raises(FlashError, match=r"was told too late: .*; start later"):
            flash.start(PulseTrain(start_s=rig.clock.now_s() + 0.05))
        assert lost
        assert rig.watch(flash, 0.5) == []
        assert flash.link_report()["repeats"] == 1


@pytest.mark.parametrize("code", [*ErrorCode, 77])
def test_every_error_of_the_device_is_one_sentence_that_names_it(code):
    text = str(refusal(Err(code, 1, 3), Stop(), "/dev/ttyUSB0"))
    assert text.startswith("/dev/ttyUSB0 ")
    assert text.endswith(".")


def test_what_is_not_the_flash_is_named_with_what_it_said(core):
    line = StepLine(core)
    core.feed = lambda data: None
    core.take = lambda: b"Grbl 1.1h ['$' for help]\r\n"
    line.step_us = 50_000
    before_s = line.now_s()
    with pytest.raises(FlashError, match=r"is not the flash: .*Grbl 1\.1h.*name another port"):
        SteppedRig(line).open()
    assert line.now_s() - before_s < 5.1
    assert line.closed


def test_a_port_where_nobody_is_says_so_after_five_seconds(core):
    line = StepLine(core)
    core.feed, core.take = (lambda data: None), (lambda: b"")
    before_s = line.now_s()
    with pytest.raises(FlashError, match=r"has not answered in 5 s; check that it is the port"):
        SteppedRig(line).open()
    assert line.now_s() - before_s < 5.1


def test_a_line_that_echoes_is_no_flash(core):
    line = StepLine(core)
    echo = bytearray()
    core.feed, core.take = echo.extend, lambda: bytes([echo.pop(0) for _ in range(len(echo))])
    with pytest.raises(FlashError, match="only echoes"):
        SteppedRig(line).open()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"protocol_major": 2}, r"speaks protocol 2\.0, this program 1\.0; update"),
        ({"schema_crc": 0x1234}, r"other message layouts \(0x1234, here 0xba3e\); build the firmware"),
        ({"capabilities": 0}, "cannot run a train"),
    ],
)
def test_another_version_is_one_clear_sentence(core, change, said):
    line = StepLine(core)
    hello = replace(Hello.from_host("other 9.9"), boot_nonce=7, tick_hz=1_000_000, capabilities=1)
    answers = [encode(replace(hello, **change), 1)]
    core.feed, core.take = (lambda data: None), lambda: answers.pop() if answers else b""
    with pytest.raises(FlashError, match=said):
        SteppedRig(line).open()


def test_events_that_are_lost_are_noticed(rig):
    with rig.open() as flash:
        flash.start(PulseTrain(start_s=rig.clock.now_s() + 0.1, period_s=0.4, on_s=0.05, count=4))
        take = rig.line.device.take
        edges = rig.watch(flash, 0.4)
        rig.line.device.take = lambda: take() and b""  # the second flash happens unheard
        rig.clock.sleep(0.3)
        rig.line.device.take = take
        edges += rig.watch(flash, 1.2)
        assert [edge.pulse for edge in edges] == [0, 0, 2, 2, 3, 3]
        assert flash.link_report()["edges_missing"] == 2


def test_a_train_on_the_chip_has_its_period_and_width_to_the_cycle_while_the_host_talks(chip):
    """In cycles of the simulated ATmega328P: an instruction of four is how late simavr may see a match."""
    rig = SteppedRig(StepLine(chip, step_us=1000))
    with rig.open() as flash:
        train = PulseTrain(start_s=rig.clock.now_s() + 0.3, period_s=0.5, on_s=0.1, count=6)
        flash.start(train)
        assert len(rig.watch(flash, 3.2)) == 12
    edges = chip.edges
    for k in range(6):
        assert edges[2 * k][0] - edges[0][0] == pytest.approx(0.5 * k, abs=4 / 16e6)
        assert edges[2 * k + 1][0] - edges[2 * k][0] == pytest.approx(0.1, abs=4 / 16e6)
    # And the first is where the host wanted it, as well as it knew the chip's clock through 1 ms steps.
    assert rig.lamp()[0][0] == pytest.approx(train.start_s, abs=2e-3)


def test_a_chip_that_hangs_while_lit_goes_dark_and_is_said_to_have_restarted(chip):
    rig = SteppedRig(StepLine(chip, step_us=1000))
    with rig.open() as flash:
        lit_soon(rig, flash)
        chip.command("hang")
        poll_until_it_raises(rig, flash, FlashResetError, 1.5)
        on_s, off_s = (t for t, _ in rig.lamp())
        assert off_s - on_s < 0.25


def test_off_within_a_command_is_answered_and_confuses_nothing(core):
    """As the handler of an interrupt calls it."""
    rig = SteppedRig(StepLine(core))
    with rig.open() as flash:
        read, confirmed = rig.line.read, []

        def interrupted(timeout_s):
            if not confirmed:
                confirmed.append(None)
                confirmed[0] = flash.off()
            return read(timeout_s)

        rig.line.read = interrupted
        flash.start(PulseTrain(start_s=rig.clock.now_s() + 0.2, count=1))
        assert confirmed == [True]
        rig.watch(flash, 0.5)
