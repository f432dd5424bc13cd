"""The Litra lamps: their bytes as litra-rs has them, and what they do on a model of the lamp."""

import pytest
from expected_exchange import expected_exchange
from hid_models import LitraModel, ModelTransport

from capture.devices.bench import VirtualClock
from capture.devices.flash import PulseTrain
from capture.devices.hid.litra import LitraLamp
from capture.devices.hid.transport import HidAddress
from capture.devices.host_flash import HostFlash
from capture.errors import FlashError, FlashGoneError


def address(product_id: int = 0xC900) -> HidAddress:
    return HidAddress(
        path="/dev/hidraw0", vendor_id=0x046D, product_id=product_id, serial="2246FE", product="Litra"
    )


def long(text: str) -> bytes:
    return bytes.fromhex(text).ljust(20, b"\0")


def opening(index: str = "04", lumen: str = "0064", kelvin: str = "0fa0", on: str = "00") -> list:
    """What is said when a Glow is opened: where is the light, is it on, how bright, how warm; off."""
    return [
        ("out", long("11ff000c1990")),
        ("in", long(f"11ff000c{index}0000")),
        ("out", long(f"11ff{index}01")),
        ("in", long(f"11ff{index}01{on}")),
        ("out", long(f"11ff{index}31")),
        ("in", long(f"11ff{index}31{lumen}")),
        ("out", long(f"11ff{index}81")),
        ("in", long(f"11ff{index}81{kelvin}")),
        ("out", long(f"11ff{index}1c00")),
    ]


CLOCK = VirtualClock()


class TestBytes:
    def test_opening_asks_where_the_light_is_and_turns_it_off(self):
        with expected_exchange(opening(on="01"), address()) as transport:
            lamp = LitraLamp(transport, CLOCK)
        assert lamp.info.details["was_on"] is True
        assert lamp.info.details["found"] == {"lumen": 100, "kelvin": 4000}
        assert lamp.info.url == "litra:serial=2246FE"

    def test_on_and_off(self):
        commands = [("out", long("11ff041c01")), ("out", long("11ff041c00"))]
        with expected_exchange(opening() + commands, address()) as transport:
            lamp = LitraLamp(transport, CLOCK)
            lamp.switch(True)
            lamp.switch(False)

    def test_brightness_is_in_lumen_high_byte_first(self):
        setting = [
            ("out", long("11ff044c00fa")),
            ("in", long("11ff044c00fa")),
            ("out", long("11ff0431")),
            ("in", long("11ff043100fa")),
            ("out", long("11ff044c007d")),
            ("in", long("11ff044c007d")),
            ("out", long("11ff0431")),
            ("in", long("11ff0431007d")),
        ]
        with expected_exchange(opening() + setting, address()) as transport:
            lamp = LitraLamp(transport, CLOCK)
            lamp.prepare(1.0)
            lamp.prepare(0.5)

    def test_a_beam_goes_up_to_400_lumen(self):
        setting = [
            ("out", long("11ff044c0190")),
            ("in", long("11ff044c0190")),
            ("out", long("11ff0431")),
            ("in", long("11ff04310190")),
        ]
        with expected_exchange(opening() + setting, address(0xC901)) as transport:
            LitraLamp(transport, CLOCK).prepare(1.0)

    def test_temperature_is_set_read_back_and_restored(self):
        setting = [
            ("out", long("11ff049c1388")),
            ("in", long("11ff049c1388")),
            ("out", long("11ff0481")),
            ("in", long("11ff04811388")),
            ("out", long("11ff049c0fa0")),
        ]
        with expected_exchange(opening() + setting, address()) as transport:
            lamp = LitraLamp(transport, CLOCK, kelvin=5000)
            lamp.close()

    def test_a_lamp_that_tells_another_place_is_talked_to_there(self):
        commands = [("out", long("11ff091c01")), ("out", long("11ff0901")), ("in", long("11ff090100"))]
        with expected_exchange(opening(index="09") + commands, address(0xC903)) as transport:
            lamp = LitraLamp(transport, CLOCK)
            lamp.switch(True)
            assert lamp.confirm_dark()

    @pytest.mark.parametrize(("product", "index"), [(0xC900, "04"), (0xB901, "04"), (0xC903, "06")])
    def test_a_lamp_that_says_nothing_gets_the_usual_bytes(self, product, index):
        exchange = [
            ("out", long("11ff000c1990")),
            ("out", long(f"11ff{index}01")),
            ("out", long(f"11ff{index}1c00")),
            ("out", long(f"11ff{index}1c01")),
        ]
        with expected_exchange(exchange, address(product)) as transport:
            lamp = LitraLamp(transport, CLOCK)
            lamp.switch(True)
            assert not lamp.confirm_dark()

    def test_a_device_without_the_light_is_refused(self):
        exchange = [("out", long("11ff000c1990")), ("in", long("11ff000c000000"))]
        with (
            expected_exchange(exchange, address()) as transport,
            pytest.raises(FlashError, match="0x1990 is missing"),
        ):
            LitraLamp(transport, CLOCK)

    def test_reports_of_others_are_passed_over_while_waiting(self):
        strange = [("in", b"\x10\xff\x05\x00\x00\x00\x00"), ("in", long("11ff0f3a01")), ("in", b"\x11")]
        exchange = opening()
        with expected_exchange(exchange[:3] + strange + exchange[3:], address()) as transport:
            LitraLamp(transport, CLOCK)

    @pytest.mark.parametrize(
        ("settings", "words"),
        [({"lumen": 251}, "20 to 250"), ({"lumen": 10}, "20 to 250"), ({"kelvin": 5050}, "steps of 100")],
    )
    def test_settings_beyond_the_model_are_refused(self, settings, words):
        with pytest.raises(FlashError, match=words):
            LitraLamp(ModelTransport(LitraModel(), address(), VirtualClock()), VirtualClock(), **settings)


@pytest.fixture
def clock():
    return VirtualClock()


@pytest.fixture
def model():
    return LitraModel()


@pytest.fixture
def transport(model, clock):
    return ModelTransport(model, address(), clock, takes_s=0.001)


@pytest.fixture
def flash(transport, clock):
    with HostFlash(LitraLamp(transport, clock, kelvin=5000, lumen=200), clock) as flash:
        yield flash


def run_until(flash, clock, time_s):
    while (next_s := flash.next_s()) is not None and next_s <= time_s:
        clock.advance_to(next_s)
        flash.run_due()
    clock.advance_to(time_s)


def train(clock, **settings):
    return PulseTrain(**({"start_s": clock.now_s() + 1, "count": 3} | settings))


class TestModel:
    def test_a_train_lights_it_and_closing_puts_everything_back(self, flash, model, clock):
        flash.start(train(clock, level=0.5))
        assert (model.lumen, model.kelvin) == (100, 5000)
        run_until(flash, clock, clock.now_s() + 5)
        edges = flash.poll()
        # The lamp changes when the command has gone out, 1 ms after it was given; the edge is in the middle.
        assert [edge.time_s + 0.0005 for edge in edges] == pytest.approx(
            [time_s for time_s, _ in model.changes]
        )
        assert [edge.on for edge in edges] == [lit for _, lit in model.changes] == [True, False] * 3
        flash.close()
        assert (model.lumen, model.kelvin, model.on) == (100, 4000, False)

    def test_it_is_dark_once_opened_though_it_was_on(self, model, transport, clock):
        model.on = True
        with HostFlash(LitraLamp(transport, clock), clock) as flash:
            assert not model.on
            assert flash.info.details["was_on"]
        assert not model.on

    def test_off_is_confirmed_by_reading_back(self, flash, model, clock):
        flash.start(train(clock))
        run_until(flash, clock, clock.now_s() + 1.05)
        assert model.on
        assert flash.off() is True
        assert not model.on

    def test_a_level_below_its_lowest_is_refused(self, flash, clock):
        with pytest.raises(FlashError, match="20 or more"):
            flash.start(train(clock, level=0.05))

    def test_its_own_events_are_no_surprise(self, flash, model, clock):
        flash.start(train(clock))
        for _ in range(30):
            run_until(flash, clock, clock.now_s() + 0.13)
            flash.poll()
        assert flash.link_report()["unanswered"] == 0

    def test_the_front_button_is_noticed(self, flash, model, clock):
        flash.start(train(clock))
        run_until(flash, clock, clock.now_s() + 1.5)
        flash.poll()
        model.press_power(clock.now_s())
        with pytest.raises(FlashError, match=r"pressed a button .* \(now on\)"):
            flash.poll()
        assert not model.on
        assert flash.next_s() is None

    def test_more_light_by_hand_is_noticed(self, flash, model, clock):
        flash.start(train(clock))
        model.press_brighter()
        with pytest.raises(FlashError, match="220 lumen"):
            flash.poll()

    def test_pulled_out_in_the_train(self, flash, transport, clock):
        flash.start(train(clock))
        run_until(flash, clock, clock.now_s() + 1.05)
        transport.gone = True
        run_until(flash, clock, clock.now_s() + 0.1)
        with pytest.raises(FlashGoneError):
            flash.poll()
        assert flash.off() is False
        flash.close()

    def test_a_command_that_is_refused_ends_the_train(self, flash, model, clock):
        flash.start(train(clock))
        model.refuse = 0x05
        run_until(flash, clock, clock.now_s() + 1.05)
        with pytest.raises(FlashError, match="HID\\+\\+ error 5"):
            flash.poll()
        assert flash.next_s() is None

    def test_a_lamp_that_falls_silent_is_told(self, flash, model, clock):
        flash.start(train(clock))
        model.answers = False
        run_until(flash, clock, clock.now_s() + 2.5)
        with pytest.raises(FlashError, match="has not answered"):
            flash.poll()

    def test_a_lamp_that_never_answers_can_be_used_all_the_same(self, clock):
        model = LitraModel(answers=False)
        with HostFlash(LitraLamp(ModelTransport(model, address(), clock), clock), clock) as flash:
            flash.start(train(clock, count=1))
            run_until(flash, clock, clock.now_s() + 3)
            assert len(flash.poll()) == 2
            assert flash.off() is False
        assert [lit for _, lit in model.changes] == [True, False]

    def test_a_lamp_whose_root_is_silent_is_read_back_at_the_usual_place(self, clock):
        model = LitraModel(answers_root=False)
        with HostFlash(LitraLamp(ModelTransport(model, address(), clock), clock), clock) as flash:
            assert flash.off() is True
