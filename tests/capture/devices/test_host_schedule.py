"""The schedule as a pure state machine: asked at any times, it keeps its deadlines and its limits."""

import math
import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from capture.devices.flash import SHORTEST_PERIOD_S, FlashEdge, PulseTrain
from capture.devices.host_schedule import LATEST_S, HostSchedule


def play(schedule: HostSchedule, times: list[float], takes_s: float = 0.0) -> list[FlashEdge]:
    """The edges when it is asked at these times, and each command takes so long."""
    edges = []
    for now_s in times:
        step = schedule.due(now_s)
        if step is not None:
            edges.append(schedule.done(step, now_s, now_s + takes_s))
    return edges


def every(step_s: float, end_s: float, start_s: float = 0.0) -> list[float]:
    return [start_s + k * step_s for k in range(round((end_s - start_s) / step_s))]


def test_a_train_runs_by_absolute_deadlines_so_that_no_delay_adds_up():
    schedule = HostSchedule()
    schedule.start(PulseTrain(start_s=10.0, period_s=0.5, on_s=0.1, count=100))
    late = random.Random(1)
    now_s, edges = 0.0, []
    while (next_s := schedule.next_s()) is not None:
        now_s = max(now_s, next_s) + late.uniform(0, 0.01)
        edges += play(schedule, [now_s])
    begins = [edge.time_s for edge in edges if edge.on]
    assert len(begins) == 100
    # Each is late by its own delay alone, at most the 10 ms drawn above.
    assert all(0 <= begin - (10.0 + 0.5 * k) <= 0.01 for k, begin in enumerate(begins))


def test_a_flash_that_begins_late_keeps_its_length():
    schedule = HostSchedule()
    schedule.start(PulseTrain(start_s=10.0, on_s=0.1, count=1))
    on, off = play(schedule, [10.03, *every(0.001, 11, 10.04)])
    # Asked every millisecond; 1e-9 for the sums of floats.
    assert 0.1 - 1e-9 <= off.time_s - on.time_s <= 0.101 + 1e-9


def test_a_flash_that_cannot_begin_in_time_is_left_out_and_written_down():
    schedule = HostSchedule()
    schedule.start(PulseTrain(start_s=10.0, period_s=1.0, on_s=0.1, count=3))
    edges = play(schedule, [10.0, 10.2, 11.0 + LATEST_S + 0.01, 12.01, 12.2])
    assert [(edge.pulse, edge.on) for edge in edges] == [(0, True), (0, False), (2, True), (2, False)]
    assert schedule.skipped == [1]
    assert schedule.next_s() is None
    assert schedule.report()["flashes"] == 2


def test_a_new_train_does_not_shorten_the_time_between_flashes():
    schedule = HostSchedule()
    edges = []
    for start_s in (10.0, 10.05, 10.1, 10.15, 10.2, 10.25):
        schedule.start(PulseTrain(start_s=start_s, on_s=0.02, count=1))
        edges += play(schedule, every(0.001, start_s + 0.05, start_s))
    assert sum(edge.on for edge in edges) == 3
    assert schedule.skipped == [0, 0, 0]


def test_what_is_lit_goes_out_though_its_train_was_dropped():
    schedule = HostSchedule()
    schedule.start(PulseTrain(start_s=10.0, on_s=0.1, count=5))
    play(schedule, [10.0])
    step = schedule.drop()
    assert step is not None
    assert not step.on
    assert schedule.next_s() == pytest.approx(10.1)
    schedule.done(step, 10.05, 10.05)
    assert schedule.next_s() is None
    assert schedule.drop() is None


def test_an_edge_comes_the_latency_after_its_command_with_the_spread_of_when_that_was_taken():
    schedule = HostSchedule(latency_s=0.1, jitter_s=0.003)
    schedule.start(PulseTrain(start_s=10.0, count=1))
    (edge,) = play(schedule, [10.0], takes_s=0.004)
    assert edge.time_s == pytest.approx(10.102)
    assert edge.sigma_s == pytest.approx(math.hypot(0.004 / math.sqrt(12), 0.003))


@settings(max_examples=60, deadline=None)
@given(
    st.lists(
        st.tuples(st.floats(0.0, 0.5), st.floats(0.01, 0.25), st.floats(SHORTEST_PERIOD_S, 0.6)),
        min_size=1,
        max_size=6,
    ),
    st.lists(st.floats(0.0, 0.2), min_size=20, max_size=200),
    st.floats(0.0, 0.01),
)
def test_never_more_than_three_flashes_in_a_second_nor_a_longer_one_than_asked_in_time(
    trains: list[tuple[float, float, float]], waits: list[float], takes_s: float
):
    schedule, now_s, edges, longest = HostSchedule(), 0.0, [], 0.0
    for number, wait in enumerate(waits):
        if number % 15 == 0:
            ahead, on_s, period_s = trains[number // 15 % len(trains)]
            schedule.start(PulseTrain(start_s=now_s + ahead, period_s=period_s, on_s=on_s, count=9))
            longest = max(longest, on_s)
        now_s += wait
        while (next_s := schedule.next_s()) is not None and next_s <= now_s:
            at_s = max(next_s, edges[-1].time_s + takes_s if edges else next_s)
            step = schedule.due(at_s)
            if step is not None:
                edges.append(schedule.done(step, at_s, at_s + takes_s))
    begins = [edge.time_s for edge in edges if edge.on]
    # 1e-9: sums of floats; the edges are the middles of commands that all take as long.
    assert all(later - earlier >= 1.0 - 1e-9 for earlier, later in zip(begins, begins[3:], strict=False))
    assert [edge.on for edge in edges] == [k % 2 == 0 for k in range(len(edges))]
    # The command off goes out when the time is up, after one command that may be under way.
    assert schedule.longest_on_s <= longest + 2 * takes_s + 1e-9
