"""Times of stages, by a clock that the test sets."""

import pytest

from relight.stages import Stages, no_progress, peak_memory_mb


class Clock:
    """Seconds that pass only when told."""

    def __init__(self):
        self.now_s = 100.0

    def __call__(self):
        return self.now_s


def test_a_stage_that_runs_twice_adds_up():
    clock = Clock()
    stages = Stages(clock)
    for seconds in (2.0, 3.0):
        with stages.stage("read"):
            clock.now_s += seconds
    assert stages.seconds == {"read": 5.0}
    assert stages.total_s == 5.0


def test_a_stage_that_fails_is_timed_all_the_same():
    clock = Clock()
    stages = Stages(clock)

    def work():
        with stages.stage("solve"):
            clock.now_s += 1.0
            raise KeyError

    with pytest.raises(KeyError):
        work()
    assert stages.seconds == {"solve": 1.0}


def test_following_times_each_stage_until_the_next_is_named():
    clock = Clock()
    stages = Stages(clock)
    told = []
    with stages.follow(lambda stage, fraction: told.append((stage, fraction))) as progress:
        clock.now_s += 0.5  # before the first name
        progress("cloud", 0.0)
        clock.now_s += 1.0
        progress("cloud", 1.0)
        clock.now_s += 2.0
        progress("solve", 0.5)
        clock.now_s += 4.0
    assert stages.seconds == {"cloud": 3.5, "solve": 4.0}
    assert told == [("cloud", 0.0), ("cloud", 1.0), ("solve", 0.5)]


def test_following_what_names_nothing_times_nothing():
    stages = Stages(Clock())
    with stages.follow(no_progress):
        pass
    assert stages.seconds == {}
    assert stages.total_s == 0


def test_the_peak_of_memory_is_that_of_a_python_with_torch():
    peak = peak_memory_mb()
    assert peak is None or 50 < peak < 1e6  # a wrong unit would be off by a thousand
