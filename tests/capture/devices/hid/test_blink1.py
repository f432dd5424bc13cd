"""The blink(1): bytes as its documents have them, and its watchdog on a model of it."""

import pytest
from expected_exchange import expected_exchange
from hid_models import Blink1Model, ModelTransport

from capture.devices.bench import VirtualClock
from capture.devices.flash import PulseTrain
from capture.devices.hid.blink1 import Blink1Lamp
from capture.devices.hid.transport import HidAddress
from capture.devices.host_flash import HostFlash
from capture.errors import FlashError, FlashGoneError

ADDRESS = HidAddress(
    path="/dev/hidraw1", vendor_id=0x27B8, product_id=0x01ED, serial="3A1B2C3D", product="blink(1) mk3"
)
CLOCK = VirtualClock()


def nine(text: str) -> bytes:
    return bytes.fromhex(text).ljust(9, b"\0")


def eight(text: str) -> bytes:
    return bytes.fromhex(text).ljust(8, b"\0")


BLACK = ("set", nine("016e"))
MK1 = [BLACK, ("set", nine("0176")), ("get", eight("0176003131"))]


def mk3() -> list:
    """Off, the version, its 32 lines (red in line 0, on LED 2), then black ones of 10 ms for all LEDs."""
    exchange = [BLACK, ("set", nine("0176")), ("get", eight("0176003336"))]
    for line in range(32):
        exchange += [
            ("set", bytes((1, ord("R"), 0, 0, 0, 0, 0, line, 0))),
            ("get", eight("0152ff0000003202") if line == 0 else eight("0152")),
        ]
    exchange += [("set", nine("016c"))]
    exchange += [("set", bytes((1, ord("P"), 0, 0, 0, 0, 1, line, 0))) for line in range(32)]
    return exchange


class TestBytes:
    def test_colour_now_on_all_leds(self):
        commands = [("set", nine("016effffff")), BLACK]
        with expected_exchange(MK1 + commands, ADDRESS) as transport:
            lamp = Blink1Lamp(transport, CLOCK)
            lamp.switch(True)
            lamp.switch(False)

    def test_a_level_is_a_grey(self):
        with expected_exchange([*MK1, ("set", nine("016e808080"))], ADDRESS) as transport:
            lamp = Blink1Lamp(transport, CLOCK)
            lamp.prepare(0.5)
            lamp.switch(True)

    def test_the_watchdog_is_set_to_the_flash_and_a_grace_in_ticks_of_10_ms_and_keeps_the_light(self):
        armed = [("set", nine("0144 01 000f 01")), ("set", nine("0144 01 0019 01"))]
        with expected_exchange(mk3() + armed, ADDRESS) as transport:
            lamp = Blink1Lamp(transport, CLOCK)
            lamp.arm(0.1)
            lamp.arm(0.25)  # 250 ms is the longest that any light here may be on

    def test_closing_ends_the_watchdog_and_writes_the_pattern_back(self):
        with expected_exchange(mk3() + restoring(), ADDRESS) as transport:
            Blink1Lamp(transport, CLOCK).close()

    def test_a_mk1_has_no_watchdog_and_its_pattern_is_left_alone(self):
        with expected_exchange(MK1, ADDRESS) as transport:
            lamp = Blink1Lamp(transport, CLOCK)
            assert not lamp.capabilities.watchdog
            lamp.arm(0.1)
            assert lamp.confirm_dark() is False
            lamp.close()

    def test_the_colour_is_read_back(self):
        reading = [
            ("set", nine("0172")),
            ("get", eight("0172000000")),
            ("set", nine("0172")),
            ("get", eight("0172400000")),
        ]
        with expected_exchange(mk3() + reading, ADDRESS) as transport:
            lamp = Blink1Lamp(transport, CLOCK)
            assert lamp.confirm_dark() is True
            assert lamp.confirm_dark() is False

    @pytest.mark.parametrize("wrong", ["", "0176", "0152003336", "ff76003336", "0176000000"])
    def test_another_answer_is_no_blink1(self, wrong):
        answer = bytes.fromhex(wrong)
        with (
            expected_exchange(
                [*MK1[:2], ("get", answer.ljust(8 * bool(answer), b"\0"))], ADDRESS
            ) as transport,
            pytest.raises(FlashError, match=r"blink\(1\) does not"),
        ):
            Blink1Lamp(transport, CLOCK)


def restoring() -> list:
    exchange = [("set", nine("0144 00 0000 01"))]
    for line in reversed(range(32)):
        exchange += [
            ("set", nine("016c02") if line == 0 else nine("016c")),
            ("set", nine("0150ff00000032") if line == 0 else bytes((1, ord("P"), 0, 0, 0, 0, 0, line, 0))),
        ]
    return [*exchange, ("set", nine("016c"))]


@pytest.fixture
def clock():
    return VirtualClock()


def flash_of(model, clock):
    transport = ModelTransport(model, ADDRESS, clock, takes_s=0.001)
    return HostFlash(Blink1Lamp(transport, clock), clock), transport


def run_until(flash, clock, time_s):
    while (next_s := flash.next_s()) is not None and next_s <= time_s:
        clock.advance_to(next_s)
        flash.run_due()
    clock.advance_to(time_s)


MODELS = [
    lambda: Blink1Model(firmware=(2, 6)),
    lambda: Blink1Model(firmware=(3, 3), whole_pattern=True),
]


class TestModel:
    @pytest.mark.parametrize("make", [*MODELS, lambda: Blink1Model(firmware=(1, 1))])
    def test_a_train_lights_it_and_its_pattern_is_as_before(self, make, clock):
        model = make()
        pattern = list(model.pattern)
        flash, _ = flash_of(model, clock)
        with flash:
            flash.start(PulseTrain(start_s=clock.now_s() + 1, count=3))
            run_until(flash, clock, clock.now_s() + 5)
            assert [edge.on for edge in flash.poll()] == [True, False] * 3
        model.advance(clock.now_s() + 60)
        assert [lit for _, lit in model.changes] == [True, False] * 3
        assert model.pattern == pattern
        assert model.saves == 0

    @pytest.mark.parametrize("make", MODELS)
    def test_it_goes_dark_and_stays_so_when_the_host_dies_while_it_is_lit(self, make, clock):
        model = make()
        flash, _ = flash_of(model, clock)
        start_s = clock.now_s() + 1
        flash.start(PulseTrain(start_s=start_s, on_s=0.1, count=3))
        run_until(flash, clock, start_s + 0.05)
        assert any(model.rgb)
        model.advance(start_s + 60)  # nothing comes any more
        (on_s, lit), (off_s, dark) = model.changes
        assert (lit, dark) == (True, False)
        # 150 ms were set, 1 ms before the light; 10 ms more for its next tick, 2 ms for two transfers.
        assert 0.1 < off_s - on_s <= 0.162
        flash.off()

    def test_without_the_black_pattern_the_watchdog_would_flash_colours(self, clock):
        model = Blink1Model()
        model.set_feature(nine("0144 01 000f 01 00 1f"), 0.0)
        model.set_feature(nine("016effffff"), 0.0)
        model.advance(10.0)
        assert len(model.changes) > 4

    def test_the_watchdog_that_bites_between_flashes_harms_none(self, clock):
        model = Blink1Model()
        flash, _ = flash_of(model, clock)
        with flash:
            start_s = clock.now_s() + 1
            flash.start(PulseTrain(start_s=start_s, on_s=0.1, period_s=0.5, count=5))
            run_until(flash, clock, start_s + 3)
        begins = [time_s - start_s for time_s, lit in model.changes if lit]
        # Lit after the command that arms it and the one that lights it, 1 ms each.
        assert begins == pytest.approx([0.002 + 0.5 * k for k in range(5)])

    def test_off_is_confirmed(self, clock):
        model = Blink1Model()
        flash, _ = flash_of(model, clock)
        with flash:
            flash.start(PulseTrain(start_s=clock.now_s() + 1))
            run_until(flash, clock, clock.now_s() + 1.05)
            assert flash.off() is True
        assert not any(model.rgb)

    def test_pulled_out_in_the_train(self, clock):
        flash, transport = flash_of(Blink1Model(), clock)
        with flash:
            flash.start(PulseTrain(start_s=clock.now_s() + 1))
            run_until(flash, clock, clock.now_s() + 1.05)
            transport.gone = True
            run_until(flash, clock, clock.now_s() + 1)
            with pytest.raises(FlashGoneError):
                flash.poll()
            assert flash.off() is False
