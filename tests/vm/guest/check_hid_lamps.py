"""Lamps on USB HID behind the kernel's uhid: hidapi, /dev/hidraw and reports are real, the lamp is a model.

Times are judged by what an emulated machine on a busy host can hold: a tenth of a second.
"""

import os
import signal
import subprocess
import sys
import time
from itertools import pairwise

import pytest
from flash_contract import FlashContract, FlashRig
from hid_models import (
    BLINK1_DESCRIPTOR,
    LITRA_DESCRIPTOR,
    RELAY_DESCRIPTOR,
    Blink1Model,
    LitraModel,
    RelayModel,
)
from kernel import load, until
from uhid import UhidDevice

from capture.devices.bench import MonotonicClock
from capture.devices.flash import PulseTrain
from capture.devices.hid import blink1, litra, relay
from capture.devices.hid.guard import LIMIT_S
from capture.devices.table import open_flash
from capture.errors import FlashError, FlashGoneError

TOLERANCE_S = 0.1
LAMPS = {
    "litra": (litra, LitraModel, LITRA_DESCRIPTOR, 0x046D, 0xC900, "Litra Glow", "2246FE900DBB"),
    "hidrelay": (relay, RelayModel, RELAY_DESCRIPTOR, 0x16C0, 0x05DF, "USBRelay2", ""),
    "blink1": (blink1, Blink1Model, BLINK1_DESCRIPTOR, 0x27B8, 0x01ED, "blink(1) mk2", "3A1B2C3D"),
}


@pytest.fixture(scope="module", autouse=True)
def driver():
    load("uhid")
    load("hid-generic")


@pytest.fixture(params=list(LAMPS))
def scheme(request):
    return request.param


@pytest.fixture
def plug():
    """Plugs a lamp of a kind in: (model, device)."""
    devices = []

    def plugged(scheme):
        back_end, model_class, *about = LAMPS[scheme]
        model = model_class()
        devices.append(UhidDevice(model, *about))
        until(back_end.list_flashes, f"a {scheme}")
        return model, devices[-1]

    yield plugged
    for device in devices:
        device.close()


def train(count=3, on_s=0.1, period_s=0.4, **more):
    return PulseTrain(start_s=time.monotonic() + 0.3, period_s=period_s, on_s=on_s, count=count, **more)


def edges_until(flash, end_s):
    edges = []
    while time.monotonic() < end_s:
        edges += flash.poll()
        time.sleep(0.02)
    return edges


def test_a_lamp_is_found_and_its_url_opens_it(scheme, plug):
    assert LAMPS[scheme][0].list_flashes() == []
    model, device = plug(scheme)
    urls = LAMPS[scheme][0].list_flashes()
    assert urls
    with open_flash(urls[0]) as flash:
        assert flash.info.back_end == scheme
    device.close()
    until(lambda: LAMPS[scheme][0].list_flashes() == [], "the end of the lamp")
    assert not any(lit for _, lit in model.changes)


def test_a_train_arrives_edge_by_edge(scheme, plug):
    model, _ = plug(scheme)
    with open_flash(f"{scheme}:") as flash:
        asked = train()
        flash.start(asked)
        edges = edges_until(flash, asked.end_s + 0.3)
        assert flash.off() is True
    assert [on for _, on in model.changes] == [True, False] * 3
    assert [(edge.on, edge.pulse) for edge in edges] == [
        (on, pulse) for pulse in range(3) for on in (True, False)
    ]
    for edge, (happened_s, _) in zip(edges, model.changes, strict=True):
        assert edge.time_s == pytest.approx(happened_s, abs=TOLERANCE_S)
    for (on_s, _), (off_s, _) in list(pairwise(model.changes))[::2]:
        assert off_s - on_s == pytest.approx(0.1, abs=TOLERANCE_S)


def test_a_lamp_pulled_out_in_a_flash_is_gone(scheme, plug):
    model, device = plug(scheme)
    flash = open_flash(f"{scheme}:")
    flash.start(train(count=20))
    until(lambda: model.changes, "light")
    device.close()
    with pytest.raises(FlashGoneError):
        edges_until(flash, time.monotonic() + 3)
    assert flash.off() is False
    flash.close()
    flash.close()


def test_a_lamp_that_is_not_there_is_one_sentence(scheme):
    with pytest.raises(FlashError, match="plugged in"):
        open_flash(f"{scheme}:")


class LitraRig(FlashRig):
    """A Litra on the kernel's bus; its lamp is the model's."""

    clock = MonotonicClock()
    real_time = True
    lead_s, slack_s = 0.3, TOLERANCE_S

    def __init__(self, model):
        self._model = model

    def open(self):
        return open_flash("litra:")

    def lamp(self):
        return self._model.changes


class TestContract(FlashContract):
    """What every flash must do."""

    @pytest.fixture
    def rig(self, plug):
        return LitraRig(plug("litra")[0])


def test_a_litra_is_as_bright_as_told_and_put_back(plug):
    model, _ = plug("litra")
    model.lumen, model.kelvin = 70, 3000
    with open_flash("litra:kelvin=5000;lumen=200") as flash:
        flash.start(train(count=1, level=0.5))
        until(lambda: model.changes, "light")
        assert (model.lumen, model.kelvin) == (100, 5000)
        edges_until(flash, time.monotonic() + 0.3)
    # Unlike USB, uhid lets a report that goes out return before it has arrived.
    until(lambda: (model.on, model.lumen, model.kelvin) == (False, 70, 3000), "what was there before", 1.0)


def test_a_pressed_button_ends_the_train(plug):
    model, _ = plug("litra")
    with open_flash("litra:") as flash:
        flash.start(train(count=20, period_s=1.0, level=0.5))
        until(lambda: len(model.changes) >= 2, "a flash")
        model.press_brighter()
        with pytest.raises(FlashError, match="button"):
            edges_until(flash, time.monotonic() + 3)
    assert not model.on


@pytest.mark.parametrize(
    ("scheme", "blow"),
    [(scheme, signal.SIGKILL) for scheme in LAMPS] + [("litra", signal.SIGSTOP)],
)
def test_a_lamp_goes_dark_when_the_program_is_killed_or_stands_still_in_a_flash(scheme, blow, plug):
    """By the device's own watchdog, or by the process that the back end keeps for that."""
    model, _ = plug(scheme)
    program = (
        "import time\n"
        "from capture.devices.table import open_flash\n"
        "from capture.devices.flash import PulseTrain\n"
        f"flash = open_flash('{scheme}:')\n"
        "flash.start(PulseTrain(start_s=time.monotonic() + 0.3, on_s=0.2, count=100))\n"
        "time.sleep(60)\n"
    )
    process = subprocess.Popen([sys.executable, "-c", program], env=os.environ | {"PYTHONPATH": os.getcwd()})
    until(lambda: model.changes, "light")
    process.send_signal(blow)
    until(lambda: not model.changes[-1][1], "darkness", 2.0)
    time.sleep(1.2)
    process.kill()
    process.wait(10)
    assert [lit for _, lit in model.changes] == [True, False]
    (on_s, _), (off_s, _) = model.changes
    assert (
        off_s - on_s <= LIMIT_S + 2 * TOLERANCE_S
    )  # another process has to wake, open the lamp, and tell it
