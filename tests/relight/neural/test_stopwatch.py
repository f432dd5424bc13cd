"""A stopwatch tells what is left, calls at its marks, and does not count what is done there."""

import math

from relight.neural.stopwatch import Stopwatch


class Clock:
    """Goes when it is told to."""

    def __init__(self):
        self.now_s = 100.0

    def __call__(self):
        return self.now_s


def test_time_is_left_until_the_limit():
    clock = Clock()
    watch = Stopwatch(10.0, clock=clock)
    clock.now_s += 4.0
    assert (watch.elapsed_s, watch.left_s) == (4.0, 6.0)
    assert Stopwatch(clock=clock).left_s == math.inf


def test_at_marks_the_portrait_of_that_time_is_handed_over_and_the_clock_stands():
    clock, calls = Clock(), []

    def at_mark(mark_s, portrait):
        calls.append((mark_s, portrait))
        clock.now_s += 50.0  # measuring takes its time

    def make():
        clock.now_s += 5.0  # as does making a portrait
        return clock.now_s

    watch = Stopwatch(30.0, marks_s=[1.0, 2.0, 3.0, 20.0], at_mark=at_mark, clock=clock)
    watch.look(make)
    assert calls == []
    clock.now_s += 2.5
    watch.look(make)  # two have passed; one portrait stands for both
    assert calls == [(2.0, 107.5)]
    assert watch.elapsed_s == 2.5
    watch.look(make)
    assert len(calls) == 1
    clock.now_s += 18.0
    watch.look(make)
    assert [mark for mark, _ in calls] == [2.0, 20.0]
    assert watch.elapsed_s == 20.5
    watch.look(make)
    assert len(calls) == 2
