"""HID through `hidapi`: what is plugged in, which one is meant, and what a driver's failure means."""

import sys
from types import SimpleNamespace

import pytest

from capture.devices import table
from capture.devices.bench import Bench, VirtualClock
from capture.devices.hid import blink1, firmware, litra, relay
from capture.devices.hid.transport import find_devices, open_device, udev_rule
from capture.errors import FlashError, FlashGoneError


def entry(path, vendor_id, product_id, serial="", product="", usage_page=0):
    return {
        "path": path.encode(),
        "vendor_id": vendor_id,
        "product_id": product_id,
        "serial_number": serial,
        "product_string": product,
        "usage_page": usage_page,
    }


GLOW = entry("/dev/hidraw0", 0x046D, 0xC900, "AAA1", "Litra Glow", 0xFF43)
BEAM = entry("/dev/hidraw1", 0x046D, 0xC901, "BBB2", "Litra Beam", 0xFF43)
MOUSE = entry("/dev/hidraw2", 0x046D, 0xC077, "", "USB Optical Mouse", 1)
RELAY = entry("/dev/hidraw3", 0x16C0, 0x05DF, "", "USBRelay2")
TRINKET = entry("/dev/hidraw4", 0x16C0, 0x05DF, "", "Trinket keyboard")
BLINK1 = entry("/dev/hidraw5", 0x27B8, 0x01ED, "3A1B2C3D", "blink(1) mk3")
OURS = entry("/dev/hidraw6", 0x1209, 0x0001, "F00D", "relight flash 1.0", 0xFF52)


class FakeDevice:
    """`hid.device` as far as it is used; `relay` answers as a board does."""

    def __init__(self, module):
        self.module = module
        self.path = None

    def open_path(self, path):
        if path in self.module.locked:
            raise OSError("open failed")
        self.path = path
        self.module.opened.append(path)

    def write(self, report):
        return -1 if self.module.gone else len(report)

    def read(self, length, timeout_ms=0):
        assert timeout_ms > 0, "0 waits for ever"
        if self.module.gone:
            raise OSError("read error")
        return []

    def send_feature_report(self, report):
        if self.module.refuses:
            raise OSError("refused")
        return -1 if self.module.gone else len(report)

    def get_feature_report(self, report_id, length):
        if self.module.gone:
            raise OSError("read error")
        return list(self.module.states[self.path])

    def close(self):
        if self.path is None:
            raise ValueError("not open")
        self.module.closed.append(self.path)
        self.path = None


@pytest.fixture
def hidapi(monkeypatch):
    module = SimpleNamespace(
        entries=[GLOW, MOUSE, RELAY, TRINKET, BLINK1, OURS],
        opened=[],
        closed=[],
        locked=set(),
        gone=False,
        refuses=False,
        states={b"/dev/hidraw3": b"BITFT\0\0\0"},
    )
    module.enumerate = lambda vendor_id=0, product_id=0: [
        found for found in module.entries if vendor_id in (0, found["vendor_id"])
    ]
    module.device = lambda: FakeDevice(module)
    monkeypatch.setitem(sys.modules, "hidraw" if sys.platform == "linux" else "hid", module)
    return module


@pytest.fixture
def bench():
    return Bench(VirtualClock())


def test_each_back_end_lists_what_is_its_own_and_opens_nothing(hidapi):
    hidapi.entries += [BEAM]
    assert litra.list_flashes() == ["litra:serial=AAA1", "litra:serial=BBB2"]
    assert relay.list_flashes() == [
        "hidrelay:path=/dev/hidraw3;channel=1",
        "hidrelay:path=/dev/hidraw3;channel=2",
    ]
    assert blink1.list_flashes() == ["blink1:serial=3A1B2C3D"]
    assert firmware.list_flashes() == ["hid-firmware:serial=F00D"]
    assert hidapi.opened == []


def test_a_device_of_the_shared_usb_number_that_is_no_relay_board_is_never_opened(hidapi, bench):
    hidapi.entries = [TRINKET]
    assert relay.list_flashes() == []
    for rest in ("", "serial=BITFT", "path=/dev/hidraw4"):
        with pytest.raises(FlashError, match="USBRelay"):
            relay.open_flash(rest, bench)
    assert hidapi.opened == []


def test_two_lamps_are_told_apart_or_listed(hidapi, bench):
    hidapi.entries += [BEAM]
    with pytest.raises(FlashError, match=r"AAA1.*BBB2.*litra:serial="):
        litra.open_flash("", bench)
    with litra.open_flash("serial=BBB2", bench) as flash:
        assert flash.info.name == "Logitech Litra Beam"
    with litra.open_flash("path=/dev/hidraw0", bench) as flash:
        assert flash.info.name == "Logitech Litra Glow"
    with pytest.raises(FlashError, match=r"No Litra has serial=CCC3; plugged in: .*AAA1"):
        litra.open_flash("serial=CCC3", bench)
    assert hidapi.opened == hidapi.closed


def test_a_relay_board_is_found_by_its_own_number(hidapi, bench):
    hidapi.entries += [entry("/dev/hidraw7", 0x16C0, 0x05DF, "", "USBRelay1")]
    hidapi.states[b"/dev/hidraw7"] = b"XYZZY\0\0\0"
    with relay.open_flash("serial=XYZZY", bench) as flash:
        assert flash.info.url == "hidrelay:serial=XYZZY;channel=1"
    with relay.open_flash("serial=BITFT;channel=2", bench) as flash:
        assert flash.info.name == "USBRelay2 BITFT, channel 2"
    with pytest.raises(FlashError, match="BITFT at /dev/hidraw3; XYZZY at /dev/hidraw7"):
        relay.open_flash("serial=NOSUC", bench)
    assert sorted(hidapi.opened) == sorted(hidapi.closed)


def test_the_table_opens_them_by_url(hidapi, bench):
    with table.open_flash("hidrelay:channel=2", bench) as flash:
        assert flash.info.back_end == "hidrelay"
    with pytest.raises(FlashError, match="colour"):
        table.open_flash("litra:colour=red", bench)


@pytest.mark.parametrize(
    ("back_end", "kind"),
    [(litra, "Litra"), (relay, "USBRelay"), (blink1, r"blink\(1\)"), (firmware, "firmware")],
)
def test_nothing_plugged_in_is_said_so(hidapi, bench, back_end, kind):
    hidapi.entries = [MOUSE]
    with pytest.raises(FlashError, match=f"No .*{kind}.* is plugged in"):
        back_end.open_flash("", bench)


def test_no_permission_comes_with_the_rule_that_gives_it(hidapi, monkeypatch):
    hidapi.locked = {b"/dev/hidraw0"}
    (address,) = find_devices(0x046D, (0xC900,))
    monkeypatch.setattr("os.path.exists", lambda path: True)
    monkeypatch.setattr("os.access", lambda path, mode: False)
    with pytest.raises(FlashError, match="You may not open") as caught:
        open_device(address)
    rule = 'SUBSYSTEM=="hidraw", ATTRS{idVendor}=="046d", ATTRS{idProduct}=="c900", TAG+="uaccess"'
    assert udev_rule(0x046D, 0xC900) == rule
    assert rule in str(caught.value)
    monkeypatch.setattr("os.access", lambda path, mode: True)
    with pytest.raises(FlashError, match="close other programs"):
        open_device(address)


def test_a_device_that_went_away_before_it_was_opened_is_gone(hidapi):
    hidapi.locked = {b"/dev/hidraw-none"}
    hidapi.entries = [GLOW | {"path": b"/dev/hidraw-none"}]
    (address,) = find_devices(0x046D, (0xC900,))
    with pytest.raises(FlashGoneError, match="not plugged in any more"):
        open_device(address)


def test_a_device_that_was_pulled_out_is_gone_however_the_driver_says_it(hidapi):
    transport = open_device(find_devices(0x046D, (0xC900,))[0])
    hidapi.gone = True
    for use in (
        lambda: transport.write(bytes(20)),  # -1, without a word
        lambda: transport.read(0.1),  # OSError
        lambda: transport.send_feature(bytes(9)),
        lambda: transport.get_feature(1, 9),
    ):
        with pytest.raises(FlashGoneError, match=r"Litra Glow AAA1 at /dev/hidraw0 .* cable"):
            use()
    transport.close()
    transport.close()


def test_a_read_without_patience_does_not_wait_for_ever(hidapi):
    transport = open_device(find_devices(0x046D, (0xC900,))[0])
    assert transport.read(0.0) == b""


def test_a_lamp_that_fails_while_it_is_opened_is_let_go(hidapi, bench):
    hidapi.states[b"/dev/hidraw3"] = b"nonsense, all of it"
    with pytest.raises(FlashError, match="not what a USB relay board says"):
        relay.open_flash("", bench)
    assert hidapi.closed == [b"/dev/hidraw3"]


def test_without_hidapi_one_sentence_says_what_to_install(monkeypatch):
    for name in ("hid", "hidraw"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(FlashError, match="pip install hidapi"):
        litra.list_flashes()


def test_the_other_package_of_the_name_hid_is_not_taken_for_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "hidraw", None)
    monkeypatch.setitem(sys.modules, "hid", SimpleNamespace(Device=object, enumerate=list))
    with pytest.raises(FlashError, match="must be uninstalled"):
        litra.list_flashes()
