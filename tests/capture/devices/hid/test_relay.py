"""The relay boards: bytes as usbrelay and usb-relay-hid have them, and what they do to a model of one."""

import pytest
from expected_exchange import expected_exchange
from hid_models import ModelTransport, RelayModel

from capture.devices.bench import VirtualClock
from capture.devices.flash import PulseTrain
from capture.devices.hid.relay import RelayLamp, read_state
from capture.devices.hid.transport import HidAddress
from capture.devices.host_flash import HostFlash
from capture.errors import FlashError, FlashGoneError

CLOCK = VirtualClock()


def address(product: str = "USBRelay2") -> HidAddress:
    return HidAddress(path="/dev/hidraw3", vendor_id=0x16C0, product_id=0x05DF, product=product)


def state(mask: int) -> bytes:
    return b"BITFT\0\0" + bytes((mask,))


def nine(text: str) -> bytes:
    return bytes.fromhex(text).ljust(9, b"\0")


class TestBytes:
    def test_opening_reads_the_state_and_opens_the_relay(self):
        with expected_exchange([("get", state(0b01)), ("set", nine("00fd01"))], address()) as transport:
            lamp = RelayLamp(transport, CLOCK)
        assert lamp.info.url == "hidrelay:serial=BITFT;channel=1"
        assert lamp.info.details["was_on"] is True
        assert "3,600 an hour" in lamp.info.details["wear"]

    def test_on_and_off_name_the_channel(self):
        exchange = [
            ("get", state(0)),
            ("set", nine("00fd02")),
            ("set", nine("00ff02")),
            ("set", nine("00fd02")),
            ("get", state(0b01)),
        ]
        with expected_exchange(exchange, address()) as transport:
            lamp = RelayLamp(transport, CLOCK, channel=2)
            lamp.switch(True)
            lamp.switch(False)
            assert lamp.confirm_dark()
        assert lamp.report() == {"operations": 2}

    def test_a_state_with_the_report_id_before_it_says_the_same(self):
        with expected_exchange([("get", b"\x01" + state(0b10))], address()) as transport:
            assert read_state(transport) == ("BITFT", 0b10)

    @pytest.mark.parametrize("wrong", [b"", b"BITFT", bytes(3), b"\xff\xfeTFT\0\0\0", bytes(12), bytes(8)])
    def test_another_answer_is_no_relay_board(self, wrong):
        with expected_exchange([("get", wrong)], address()) as transport, pytest.raises(FlashError):
            read_state(transport)

    @pytest.mark.parametrize("product", ["", "Trinket", "USBRelay", "USBRelay9", "USBRelay2 clone", "TEMPer"])
    def test_another_product_of_the_same_usb_number_is_left_alone(self, product):
        with (
            expected_exchange([], address(product)) as transport,
            pytest.raises(FlashError, match="no USBRelay board"),
        ):
            RelayLamp(transport, CLOCK)

    @pytest.mark.parametrize("channel", [0, 3, -1])
    def test_a_channel_that_the_board_has_not_is_refused(self, channel):
        with expected_exchange([], address()) as transport, pytest.raises(FlashError, match="1 to 2"):
            RelayLamp(transport, CLOCK, channel=channel)


@pytest.fixture
def clock():
    return VirtualClock()


@pytest.fixture
def model():
    return RelayModel()


@pytest.fixture
def transport(model, clock):
    return ModelTransport(model, address(), clock, takes_s=0.002)


@pytest.fixture
def flash(transport, clock):
    with HostFlash(RelayLamp(transport, clock), clock) as flash:
        yield flash


def run_until(flash, clock, time_s):
    while (next_s := flash.next_s()) is not None and next_s <= time_s:
        clock.advance_to(next_s)
        flash.run_due()
    clock.advance_to(time_s)


class TestModel:
    def test_a_train_moves_only_its_channel(self, flash, model, clock):
        model.closed |= 0b10
        flash.start(PulseTrain(start_s=clock.now_s() + 1, count=3))
        run_until(flash, clock, clock.now_s() + 5)
        assert [edge.on for edge in flash.poll()] == [lit for _, lit in model.changes] == [True, False] * 3
        assert model.closed == 0b10
        assert flash.link_report()["operations"] == 6
        # The command takes 2 ms, uniform in between, and the relay itself has a spread of 2 ms.
        flash.start(PulseTrain(start_s=clock.now_s() + 1, count=1))
        run_until(flash, clock, clock.now_s() + 2)
        assert flash.poll()[0].sigma_s == pytest.approx(((0.002**2 / 12) + 0.002**2) ** 0.5)

    def test_off_is_read_back(self, flash, model, clock):
        flash.start(PulseTrain(start_s=clock.now_s() + 1))
        run_until(flash, clock, clock.now_s() + 1.05)
        assert model.closed == 1
        assert flash.off() is True
        assert model.closed == 0

    def test_a_relay_that_another_program_moves_is_noticed(self, flash, model, clock):
        flash.start(PulseTrain(start_s=clock.now_s() + 10))
        model.closed = 1
        clock.sleep(2)
        with pytest.raises(FlashError, match="another program"):
            flash.poll()
        assert model.closed == 0

    def test_its_state_is_not_read_when_a_switch_is_near(self, flash, transport, clock):
        flash.start(PulseTrain(start_s=clock.now_s() + 2))
        run_until(flash, clock, clock.now_s() + 1.95)
        transport.get_feature = None  # to read it would fail
        assert flash.poll() == ()

    def test_no_level_but_full(self, flash, clock):
        with pytest.raises(FlashError, match="cannot be dimmed"):
            flash.start(PulseTrain(start_s=clock.now_s() + 1, level=0.5))

    def test_pulled_out_in_the_train(self, flash, transport, clock):
        flash.start(PulseTrain(start_s=clock.now_s() + 1))
        run_until(flash, clock, clock.now_s() + 1.05)
        transport.gone = True
        run_until(flash, clock, clock.now_s() + 1)
        with pytest.raises(FlashGoneError):
            flash.poll()
        assert flash.off() is False
