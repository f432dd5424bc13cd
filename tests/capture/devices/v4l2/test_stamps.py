"""Times of frames where the driver's stamps cannot be."""

import numpy as np
import pytest

from capture.devices.v4l2 import structs as v4l2
from capture.devices.v4l2.stamps import Stamps
from capture.devices.v4l2.stream import RawFrame

MONOTONIC = v4l2.BUF_FLAG_TIMESTAMP_MONOTONIC
INTERVAL_S = 1 / 30


def frame(sequence, stamp_s=None, flags=MONOTONIC, late_s=0.03):
    true_s = 50.0 + sequence * INTERVAL_S
    return RawFrame(b"x", true_s if stamp_s is None else stamp_s, flags, sequence, true_s + late_s)


def test_sound_stamps_pass_as_they_are():
    stamps = Stamps(INTERVAL_S)
    for sequence in range(10):
        raw = frame(sequence)
        assert stamps.time_s(raw) == (raw.stamp_s, False)


@pytest.mark.parametrize("error_s", [-0.5, -1.5 * INTERVAL_S, 0.5, 1e6])
def test_a_stamp_that_cannot_be_is_estimated_from_those_before(error_s):
    stamps = Stamps(INTERVAL_S)
    for sequence in range(10):
        stamps.time_s(frame(sequence))
    time_s, estimated = stamps.time_s(frame(10, 50.0 + 10 * INTERVAL_S + error_s))
    assert estimated
    assert time_s == pytest.approx(50.0 + 10 * INTERVAL_S, abs=1e-6)
    assert stamps.time_s(frame(11)) == (50.0 + 11 * INTERVAL_S, False)


def test_lost_frames_count_in_the_estimate():
    stamps = Stamps(None)
    for sequence in range(20):
        stamps.time_s(frame(sequence))
    time_s, estimated = stamps.time_s(frame(25, 0.0))
    assert estimated
    # The interval was learnt from the frames: 20 of them leave a share of 0.9^20 of the first guess's error.
    assert time_s == pytest.approx(50.0 + 25 * INTERVAL_S, abs=0.002)


def test_stamps_of_another_clock_give_way_to_the_arrival():
    stamps = Stamps(INTERVAL_S)
    raw = frame(0, 3.25, v4l2.BUF_FLAG_TIMESTAMP_COPY)
    assert stamps.time_s(raw) == (raw.arrival_s, False)


def test_times_increase_whatever_the_driver_says():
    rng = np.random.default_rng(0)
    stamps = Stamps(None)
    last_s = -1.0
    for sequence in range(500):
        wild = 50.0 + sequence * INTERVAL_S + rng.normal(0, 0.1) if rng.random() < 0.5 else None
        time_s, _ = stamps.time_s(frame(sequence, wild))
        assert time_s > last_s
        last_s = time_s
    assert last_s == pytest.approx(50.0 + 500 * INTERVAL_S, abs=0.1)  # and stay with the clock
