"""A lamp that nobody here controls."""

import pytest

from capture.devices import manual
from capture.devices.bench import Bench, VirtualClock
from capture.devices.flash import PulseTrain
from capture.devices.manual import ManualFlash
from capture.devices.table import open_flash
from capture.errors import FlashError


@pytest.fixture
def bench():
    return Bench(VirtualClock())


def test_the_person_is_told_what_to_do_and_to_end_it():
    said = []
    with ManualFlash(tell=said.append) as flash:
        flash.start(PulseTrain(start_s=1.0, period_s=1.0, on_s=0.1, count=20))
        assert flash.poll() == ()
    assert len(said) == 2
    assert "0.1 s every 1 s, 20 times" in said[0]
    assert said[1] == "Switch the lamp off."
    assert flash.off() is False
    assert len(said) == 2


def test_a_person_is_told_no_more_digits_than_a_hand_has():
    said = []
    with ManualFlash(tell=said.append) as flash:
        flash.start(PulseTrain(start_s=1.0, period_s=1.01273333, on_s=0.1, count=5))
    assert "0.1 s every 1.01 s, 5 times" in said[0]


def test_a_lamp_that_blinks_by_itself_is_described_by_its_url(bench):
    flash = open_flash("manual:period=1;on=0.1", bench)
    assert flash.info.url == "manual:period=1;on=0.1"
    assert flash.info.details == {"period_s": 1.0, "on_s": 0.1}
    assert flash.capabilities.own_schedule
    assert not flash.capabilities.watchdog
    assert not open_flash("manual:", bench).capabilities.own_schedule


@pytest.mark.parametrize(
    ("rest", "words"),
    [
        ("period=0.3;on=0.1", "three times a second"),
        ("period=1;on=0.3", "at most 0.25"),
        ("period=nan;on=0.1", "three times a second"),
        ("period=1;on=0", "at most"),
        ("period=1", "go together"),
        ("colour=red", "colour"),
    ],
)
def test_what_is_not_safe_or_not_understood_is_refused(bench, rest, words):
    with pytest.raises(FlashError, match=words):
        manual.open_flash(rest, bench)


def test_none_is_ever_listed():
    assert manual.list_flashes() == []
