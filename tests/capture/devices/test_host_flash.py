"""A lamp that the host switches, as a flash: in virtual time by hand, and once with its thread."""

import gc
import subprocess
import sys
import threading
import time
import weakref

import pytest

from capture.devices.bench import MonotonicClock, VirtualClock
from capture.devices.flash import FlashCapabilities, FlashInfo, PulseTrain
from capture.devices.host_flash import HostFlash
from capture.errors import FlashError, FlashGoneError


class Lamp:
    """A lamp that writes down what it is told."""

    def __init__(self, clock, dimmable=False):
        self.clock = clock
        self.told = []
        self.armed = []
        self.on = False
        self.closed = False
        self.broken = None
        self.takes_s = 0.0
        self.trouble = None
        self.info = FlashInfo(url="test:", name="the lamp", back_end="test", details={})
        self.capabilities = FlashCapabilities(
            own_schedule=False, watchdog=False, shortest_on_s=0.05, dimmable=dimmable
        )

    def prepare(self, level):
        self.level = level

    def arm(self, on_s):
        self.armed.append(on_s)

    def switch(self, on):
        if self.broken is not None and (on or self.broken_off):
            raise self.broken
        self.clock.sleep(self.takes_s)
        self.on = on
        self.told.append((self.clock.now_s(), on))

    broken_off = False

    def check(self, idle_s):
        if self.trouble is not None:
            trouble, self.trouble = self.trouble, None
            raise trouble

    def confirm_dark(self):
        return not self.on

    def report(self):
        return {"lamp": 1}

    def close(self):
        self.closed = True


@pytest.fixture
def clock():
    return VirtualClock(100.0)


@pytest.fixture
def lamp(clock):
    return Lamp(clock)


@pytest.fixture
def flash(lamp, clock):
    with HostFlash(lamp, clock) as flash:
        yield flash


def threads():
    return [thread for thread in threading.enumerate() if thread.name == "test"]


def run_until(flash, clock, time_s):
    while (next_s := flash.next_s()) is not None and next_s <= time_s:
        clock.advance_to(next_s)
        flash.run_due()
    clock.advance_to(time_s)


def test_the_train_is_made_and_each_edge_comes_once(flash, lamp, clock):
    lamp.takes_s = 0.002
    flash.start(PulseTrain(start_s=101.0, period_s=1.0, on_s=0.1, count=3))
    run_until(flash, clock, 102.5)
    edges = flash.poll()
    assert [(edge.pulse, edge.on) for edge in edges] == [(0, True), (0, False), (1, True), (1, False)]
    # The command takes 2 ms; the edge is in its middle.
    assert [edge.time_s for edge in edges] == pytest.approx([101.001, 101.101, 102.001, 102.101])
    assert flash.poll() == ()
    assert lamp.armed == [0.1, 0.1]
    run_until(flash, clock, 104)
    assert len(flash.poll()) == 2
    assert flash.link_report()["flashes"] == 3
    assert flash.link_report()["lamp"] == 1


def test_off_ends_the_train_and_is_confirmed(flash, lamp, clock):
    flash.start(PulseTrain(start_s=101.0, count=5))
    run_until(flash, clock, 101.05)
    assert lamp.on
    assert flash.off() is True
    assert not lamp.on
    assert flash.off() is True
    run_until(flash, clock, 110)
    assert [edge.on for edge in flash.poll()] == [True, False]


def test_a_train_replaces_the_one_before_it(flash, lamp, clock):
    flash.start(PulseTrain(start_s=101.0, count=5))
    run_until(flash, clock, 101.05)
    flash.start(PulseTrain(start_s=103.0, count=1))
    assert not lamp.on
    run_until(flash, clock, 110)
    assert [edge.time_s for edge in flash.poll() if edge.on] == pytest.approx([101.0, 103.0])


@pytest.mark.parametrize(
    ("train", "words"),
    [
        (PulseTrain(start_s=101.0, on_s=0.01), "0.05"),
        (PulseTrain(start_s=101.0, level=0.5), "cannot be dimmed"),
        (PulseTrain(start_s=100.001), "later"),
        (PulseTrain(start_s=90.0), "later"),
    ],
)
def test_a_train_beyond_the_lamp_is_refused_and_the_one_that_runs_goes_on(flash, clock, train, words):
    flash.start(PulseTrain(start_s=100.5, count=2))
    with pytest.raises(FlashError, match=words):
        flash.start(train)
    run_until(flash, clock, 103)
    assert sum(edge.on for edge in flash.poll()) == 2


def test_a_lamp_that_goes_away_in_the_train_is_told_by_every_poll(flash, lamp, clock):
    flash.start(PulseTrain(start_s=101.0, count=5))
    run_until(flash, clock, 101.5)
    lamp.broken = FlashGoneError("the lamp is gone")
    lamp.broken_off = True
    run_until(flash, clock, 102.5)
    with pytest.raises(FlashGoneError):
        flash.poll()
    assert len(flash.poll()) == 2  # what happened before is not lost
    with pytest.raises(FlashGoneError):
        flash.poll()
    with pytest.raises(FlashGoneError):
        flash.start(PulseTrain(start_s=110.0))
    assert flash.off() is False
    run_until(flash, clock, 110)  # it is told to go out some more times, and then no more
    assert flash.next_s() is None


def test_a_failure_turns_the_lamp_off_and_ends_the_train(flash, lamp, clock):
    flash.start(PulseTrain(start_s=101.0, count=5))
    run_until(flash, clock, 101.05)
    lamp.trouble = FlashError("somebody pressed the button")
    with pytest.raises(FlashError, match="button"):
        flash.poll()
    assert not lamp.on
    run_until(flash, clock, 110)
    assert [edge.on for edge in flash.poll()] == [True, False]
    flash.start(PulseTrain(start_s=111.0, count=1))
    run_until(flash, clock, 112)
    assert len(flash.poll()) == 2


def test_a_lamp_that_does_not_take_its_command_off_is_told_again(flash, lamp, clock):
    flash.start(PulseTrain(start_s=101.0, on_s=0.1, count=5))
    run_until(flash, clock, 101.05)
    lamp.broken, lamp.broken_off = FlashGoneError("a disturbance on the cable"), True
    run_until(flash, clock, 101.3)
    assert lamp.on
    lamp.broken = None
    run_until(flash, clock, 101.5)
    assert not lamp.on
    assert flash.next_s() is None
    with pytest.raises(FlashGoneError):
        flash.poll()
    assert [edge.on for edge in flash.poll()] == [True, False]


def test_what_a_back_end_did_not_foresee_is_a_flash_error_too(flash, lamp, clock):
    flash.start(PulseTrain(start_s=101.0, count=5))
    lamp.broken = ZeroDivisionError("oops")
    run_until(flash, clock, 102)
    with pytest.raises(FlashError, match="oops"):
        flash.poll()


def test_a_lamp_that_was_lit_for_too_long_ends_the_train(flash, lamp, clock):
    flash.start(PulseTrain(start_s=101.0, on_s=0.1, count=5))
    run_until(flash, clock, 101.05)
    clock.advance_to(101.6)  # the machine was busy
    flash.run_due()
    assert not lamp.on
    with pytest.raises(FlashError, match=r"lit for 0\.60 s"):
        flash.poll()


def test_closing_puts_it_out_once_and_for_all(lamp, clock):
    with HostFlash(lamp, clock) as flash:
        flash.start(PulseTrain(start_s=101.0, count=5))
        run_until(flash, clock, 101.05)
    assert not lamp.on
    assert lamp.closed
    flash.close()
    assert flash.off() is False
    with pytest.raises(FlashError, match="closed"):
        flash.start(PulseTrain(start_s=103.0))
    assert [edge.on for edge in flash.poll()] == [True, False]
    assert flash.poll() == ()


def test_a_lamp_that_nobody_closes_is_dark_when_it_is_forgotten(lamp, clock):
    flash = HostFlash(lamp, clock)
    flash.start(PulseTrain(start_s=101.0, count=5))
    run_until(flash, clock, 101.05)
    assert lamp.on
    gone, closed = weakref.ref(flash), flash._closed
    del flash
    gc.collect()
    assert gone() is None
    assert closed.is_set()  # a thread in the middle of its work lights nothing any more
    assert not lamp.on
    assert lamp.closed


def test_its_guard_knows_of_every_light_before_it_goes_on_and_after_it_is_off(lamp, clock):
    said = []

    class Guard:
        def lit(self, on):
            said.append(("guard", on))

        def end(self):
            said.append(("guard", "end"))

    switch = lamp.switch
    lamp.switch = lambda on: (switch(on), said.append(("lamp", on)))
    with HostFlash(lamp, clock, Guard()) as flash:
        flash.start(PulseTrain(start_s=101.0, count=1))
        run_until(flash, clock, 102)
    one = [("guard", True), ("lamp", True), ("lamp", False), ("guard", False)]
    assert said == [*one, *one[2:], ("guard", "end")]


def test_a_signal_in_the_middle_of_a_call_can_turn_it_off(flash, lamp, clock):
    flash.start(PulseTrain(start_s=101.0, count=5))
    run_until(flash, clock, 101.05)
    confirmed = []
    lamp.check = lambda idle_s: confirmed.append(flash.off())  # as a signal's handler, with the lock held
    assert [edge.on for edge in flash.poll()] == [True, False]
    assert confirmed == [True]
    assert not lamp.on


def test_a_lamp_that_was_lit_for_too_long_is_still_put_out_by_off(flash, lamp, clock):
    flash.start(PulseTrain(start_s=101.0, count=5))
    run_until(flash, clock, 101.05)
    clock.advance_to(103)
    assert flash.off() is True
    assert flash.poll()[-1].on is False


DIES = """
import sys, time
from capture.devices.bench import MonotonicClock
from capture.devices.flash import FlashCapabilities, FlashInfo, PulseTrain
from capture.devices.host_flash import HostFlash

class Lamp:
    info = FlashInfo(url="test:", name="lamp", back_end="test", details={})
    capabilities = FlashCapabilities(own_schedule=False, watchdog=False, shortest_on_s=0.05)
    def prepare(self, level): pass
    def arm(self, on_s): pass
    def switch(self, on): print("on" if on else "off", flush=True)
    def check(self, idle_s): pass
    def report(self): return {}
    def close(self): print("closed", flush=True)

clock = MonotonicClock()
flash = HostFlash(Lamp(), clock)
flash.start(PulseTrain(start_s=clock.now_s() + 0.05, on_s=0.25, period_s=0.5, count=100))
while not flash.poll():
    time.sleep(0.01)
raise SystemExit("the program ends while it is lit")
"""


def test_a_program_that_ends_without_closing_it_leaves_it_dark():
    ended = subprocess.run([sys.executable, "-c", DIES], capture_output=True, text=True, timeout=60)
    assert ended.returncode == 1
    assert ended.stdout.split()[0] == "on"
    assert ended.stdout.split()[-2:] == ["off", "closed"]


def test_the_thread_switches_in_time_and_ends_with_the_flash():
    clock = MonotonicClock()
    lamp = Lamp(clock)
    with HostFlash(lamp, clock) as flash:
        start_s = clock.now_s() + 0.1
        flash.start(PulseTrain(start_s=start_s, period_s=0.4, on_s=0.05, count=2))
        edges = []
        deadline_s = clock.now_s() + 10
        while len(edges) < 4 and clock.now_s() < deadline_s:
            time.sleep(0.02)
            edges += flash.poll()
        assert len(threads()) == 1
    # A flash is made or, on a machine that is very busy, left out; never is one early.
    assert all(edge.time_s >= start_s + 0.4 * edge.pulse for edge in edges if edge.on)
    assert len(edges) + 2 * len(flash.link_report()["skipped"]) == 4
    deadline_s = clock.now_s() + 10
    while threads() and clock.now_s() < deadline_s:
        time.sleep(0.01)
    assert not threads()


def test_a_forgotten_flash_ends_its_thread():
    clock = MonotonicClock()
    lamp = Lamp(clock)
    flash = HostFlash(lamp, clock)
    flash.start(PulseTrain(start_s=clock.now_s() + 30))
    del flash
    deadline_s = clock.now_s() + 10
    while threads() and clock.now_s() < deadline_s:
        gc.collect()
        time.sleep(0.01)
    assert not threads()
    assert lamp.closed
