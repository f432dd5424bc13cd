"""The contract of all flashes, on models of the HID lamps in virtual time."""

import pytest
from flash_contract import FlashContract, FlashRig
from hid_models import Blink1Model, DrivenClock, LitraModel, ModelTransport, RelayModel

from capture.devices.hid.blink1 import Blink1Lamp
from capture.devices.hid.litra import LitraLamp
from capture.devices.hid.relay import RelayLamp
from capture.devices.hid.transport import HidAddress
from capture.devices.host_flash import HostFlash


class HidRig(FlashRig):
    """A lamp's model; it stays while the host opens and closes it."""

    def __init__(self, lamp_class, model, vendor_id, product_id, product):
        self.clock = DrivenClock()
        self._lamp_class, self._model = lamp_class, model
        self._address = HidAddress(
            path="/dev/hidraw0", vendor_id=vendor_id, product_id=product_id, serial="1", product=product
        )

    def open(self):
        # A transfer takes the millisecond of a USB frame.
        transport = ModelTransport(self._model, self._address, self.clock, takes_s=0.001)
        self.clock.flash = HostFlash(self._lamp_class(transport, self.clock), self.clock)
        return self.clock.flash

    def lamp(self):
        self._model.advance(self.clock.now_s())
        return list(self._model.changes)

    def kill_host(self):
        self.clock.flash = None


class TestLitra(FlashContract):
    @pytest.fixture
    def rig(self):
        return HidRig(LitraLamp, LitraModel(), 0x046D, 0xC900, "Litra Glow")


class TestRelay(FlashContract):
    @pytest.fixture
    def rig(self):
        return HidRig(RelayLamp, RelayModel(), 0x16C0, 0x05DF, "USBRelay2")


class TestBlink1(FlashContract):
    @pytest.fixture
    def rig(self):
        return HidRig(Blink1Lamp, Blink1Model(), 0x27B8, 0x01ED, "blink(1) mk2")


class TestBlink1Mk3(FlashContract):
    @pytest.fixture
    def rig(self):
        return HidRig(
            Blink1Lamp, Blink1Model(firmware=(3, 3), whole_pattern=True), 0x27B8, 0x01ED, "blink(1)"
        )
