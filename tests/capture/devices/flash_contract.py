"""What every FlashDevice must do, whatever it is made of: one class of tests, run on each back end.

A back end's test file has a fixture `rig` that gives a `FlashRig`, and

    class TestMyFlash(FlashContract):
        ...

The rig opens the flash, lets time pass by the clock that the flash goes by, and knows when the lamp truly was
lit where that can be known.
"""

import json

import pytest

from capture.devices.flash import LONGEST_ON_S, PulseTrain
from capture.errors import FlashError

#: Silence after which a device with a watchdog may not be lit: the heartbeat, and the longest flash.
WATCHDOG_S = 1.5 + LONGEST_ON_S


class FlashRig:
    """A flash on a desk.

    Attributes:
        clock: The one that the flash goes by.
        lead_s: How far ahead trains are begun: time enough for any back end, and for a busy machine.
        slack_s: How far the lamp may be from the plan, latency included.
        real_time: The test itself may be held up by a busy machine.
    """

    clock = None
    real_time = False
    lead_s = 0.15
    slack_s = 0.005

    def open(self):
        """The flash, dark."""
        raise NotImplementedError

    def lamp(self):
        """(host seconds, on) of each edge of the lamp so far; None where it cannot be seen."""
        return None

    def kill_host(self):
        """The host's side falls silent without a word, as a killed process does."""
        pytest.skip("a host that dies is not modelled here")

    def sleep(self, seconds):
        """Time passes and nobody asks the flash anything."""
        self.clock.sleep(seconds)

    def watch(self, flash, seconds):
        """The flash's edges of the next while, polled as a controller does."""
        edges = []
        end_s = self.clock.now_s() + seconds
        while self.clock.now_s() < end_s:
            edges += flash.poll()
            self.clock.sleep(min(0.02, max(0.001, end_s - self.clock.now_s())))
        return [*edges, *flash.poll()]


def lit_since(rig, edge_count):
    """Whether the lamp has come on since it had made that many edges."""
    lamp = rig.lamp()
    return lamp is not None and any(on for _, on in lamp[edge_count:])


def is_dark(rig):
    lamp = rig.lamp()
    return not lamp or not lamp[-1][1]


def edge_count(rig):
    return len(rig.lamp() or ())


class FlashContract:
    """Subclass it beside a fixture `rig`."""

    def train(self, rig, **changes):
        values = {"period_s": 0.4, "on_s": 0.05, "count": 2}
        return PulseTrain(start_s=rig.clock.now_s() + rig.lead_s, **(values | changes))

    def begin(self, rig, flash, **changes):
        """Starts a train; on a machine that was held up in between, a later one."""
        for _ in range(4 if rig.real_time else 0):
            train = self.train(rig, **changes)
            try:
                flash.start(train)
                return train
            except FlashError:
                rig.watch(flash, 1.0)
        train = self.train(rig, **changes)
        flash.start(train)
        return train

    def begin_lit(self, rig, flash, **changes):
        """As `begin`, until the lamp is lit; the edges so far."""
        train = self.begin(rig, flash, **({"on_s": LONGEST_ON_S, "period_s": 0.5} | changes))
        edges = rig.watch(flash, train.start_s + 0.06 - rig.clock.now_s())
        patience = 100 if rig.real_time else 0
        while not edges and patience:
            patience -= 1
            edges = rig.watch(flash, 0.02)
        assert edges
        return edges

    def test_it_opens_dark_and_says_who_it_is(self, rig):
        before = edge_count(rig)
        with rig.open() as flash:
            assert rig.watch(flash, 0.1) == []
            assert flash.info.back_end
            assert flash.info.url
            assert 0 < flash.capabilities.shortest_on_s < flash.capabilities.longest_on_s <= LONGEST_ON_S
            for part in (dict(flash.info.details), flash.capabilities.to_json(), flash.link_report()):
                json.dumps(part, allow_nan=False)  # all of it goes into session.json
        assert not lit_since(rig, before)

    def test_a_train_has_its_count_period_and_width_and_every_edge_is_told_once(self, rig):
        before = edge_count(rig)
        with rig.open() as flash:
            train = self.begin(rig, flash, count=3)
            edges = rig.watch(flash, train.end_s - rig.clock.now_s() + 0.25)
            assert [(e.pulse, e.on) for e in edges] == [(k, on) for k in range(3) for on in (True, False)]
            times = [edge.time_s for edge in edges]
            assert times == sorted(times)
            # A sigma is a claim that can be used: neither nothing nor a tenth of a second.
            assert all(0 < edge.sigma_s < 0.1 for edge in edges)
            for edge in edges:
                planned = train.start_s + edge.pulse * train.period_s + (0 if edge.on else train.on_s)
                latency = flash.capabilities.latency_s or 0.0
                assert edge.time_s == pytest.approx(planned + latency, abs=rig.slack_s + 5 * edge.sigma_s)
            assert is_dark(rig)
        lamp = rig.lamp()
        if lamp is not None:
            true = lamp[before:]
            assert [on for _, on in true] == [True, False] * 3
            for (time_s, _), edge in zip(true, edges, strict=True):
                # The edge that was told, but for a constant latency, is the edge that was.
                assert edge.time_s == pytest.approx(time_s, abs=rig.slack_s + 5 * edge.sigma_s)

    def test_off_is_safe_in_every_state_and_ends_a_flash_that_is_lit(self, rig):
        with rig.open() as flash:
            assert isinstance(flash.off(), bool)  # nothing was on
            self.begin(rig, flash, on_s=0.2)
            assert flash.off()  # armed
            before = edge_count(rig)
            rig.watch(flash, rig.lead_s + 0.25)
            assert not lit_since(rig, before)

            flash.poll()
            edges = self.begin_lit(rig, flash, count=3)
            assert flash.off()  # lit
            assert flash.off()
            assert is_dark(rig)
            before = edge_count(rig)
            edges += rig.watch(flash, 0.5)
            assert flash.off()  # long dark
            assert not lit_since(rig, before)
            assert [edge.on for edge in edges] == [True, False] * (len(edges) // 2)
            if not rig.real_time:
                assert len(edges) == 2
                assert edges[1].time_s - edges[0].time_s < 0.2

    def test_a_second_train_takes_the_place_of_the_first(self, rig):
        with rig.open() as flash:
            self.begin(rig, flash, period_s=0.6, count=100)
            edges = rig.watch(flash, rig.lead_s + 0.07)
            second = self.begin(rig, flash, period_s=0.5, count=2)
            edges += rig.watch(flash, second.end_s - rig.clock.now_s() + 0.5)
            of_second = [edge for edge in edges if edge.time_s > second.start_s - rig.slack_s]
            assert [(e.pulse, e.on) for e in of_second] == [(k, on) for k in range(2) for on in (True, False)]
            of_first = [edge for edge in edges if edge not in of_second]
            assert [edge.on for edge in of_first] == [True, False] * (len(of_first) // 2)
            assert rig.real_time or {edge.pulse for edge in of_first} == {0}

    def test_what_is_beyond_its_limits_is_refused_and_lights_nothing(self, rig):
        with rig.open() as flash:
            before = edge_count(rig)
            with pytest.raises(FlashError):
                flash.start(PulseTrain(start_s=rig.clock.now_s() - 1.0))
            if not flash.capabilities.dimmable:
                with pytest.raises(FlashError):
                    flash.start(self.train(rig, level=0.5))
            if flash.capabilities.shortest_on_s > 1e-3:
                with pytest.raises(FlashError):
                    flash.start(self.train(rig, on_s=flash.capabilities.shortest_on_s / 10))
            assert rig.watch(flash, rig.lead_s + 0.1) == []
            assert not lit_since(rig, before)

    def test_leaving_puts_it_out_and_what_is_closed_stays_closed(self, rig):
        with rig.open() as flash:
            self.begin_lit(rig, flash, count=100)
        assert is_dark(rig)
        before = edge_count(rig)
        flash.close()
        assert isinstance(flash.off(), bool)
        with pytest.raises(FlashError):
            flash.start(self.train(rig))
        rig.sleep(0.6)
        assert not lit_since(rig, before)

    def test_it_can_be_opened_again(self, rig):
        rig.open().close()
        with rig.open() as flash:
            train = self.begin(rig, flash, count=1)
            edges = rig.watch(flash, train.end_s - rig.clock.now_s() + 0.25)
        assert [edge.on for edge in edges] == [True, False]

    def test_a_host_that_dies_leaves_it_dark_where_it_has_a_watchdog(self, rig):
        flash = rig.open()
        try:
            if not flash.capabilities.watchdog:
                pytest.skip("it has no watchdog, and says so")
            self.begin_lit(rig, flash, count=1000)
            rig.kill_host()
            rig.sleep(WATCHDOG_S + 0.05)  # a round of the device's main loop, and one of ours
            assert rig.lamp() is None or is_dark(rig)
            before = edge_count(rig)
            rig.sleep(1.0)
            assert not lit_since(rig, before)
        finally:
            flash.close()
