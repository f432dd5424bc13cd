import numpy as np
import pytest

from capture.controller.time_axis import TimeAxis
from capture.devices.camera import CapturedFrame


def frame(stamp_s, sequence, arrival_s=None):
    return CapturedFrame(
        stamp_s=stamp_s, sequence=sequence, data=b"", arrival_s=stamp_s if arrival_s is None else arrival_s
    )


def test_the_first_frame_is_the_origin_of_frames_and_flash_alike():
    axis = TimeAxis("monotonic", 1 / 30)
    assert axis.from_host(5.0) is None
    assert axis.pts_s(frame(1000.0, 7)) == (0.0, True)
    assert axis.pts_s(frame(1000.5, 8)) == (0.5, True)
    assert axis.from_host(1000.25) == pytest.approx(0.25, abs=1e-9)  # float64 at 1000 s resolves 1e-13


def test_a_capture_that_is_taken_up_again_lies_behind_what_there_is():
    axis = TimeAxis("monotonic", 1 / 30, begin_s=12.0)
    assert axis.pts_s(frame(3.0, 0))[0] == 12.0
    assert axis.from_host(4.0) == 13.0


@pytest.mark.parametrize("stamp_s", [10.0, 9.0, 10.00001])
def test_a_stamp_that_does_not_advance_is_set_by_the_frame_rate_and_said_so(stamp_s):
    axis = TimeAxis("monotonic", 0.04)
    axis.pts_s(frame(10.0, 0))
    pts_s, sound = axis.pts_s(frame(stamp_s, 2))
    assert (pts_s, sound) == (pytest.approx(0.08), False)
    assert axis.pts_s(frame(10.12, 3)) == (pytest.approx(0.12), True)


def test_the_flash_is_found_on_the_axis_of_a_camera_with_its_own_clock():
    """The camera's clock is 500 s off and 50 ppm fast; frames arrive 4 ms late at least, most much more."""
    rng = np.random.default_rng(3)
    axis = TimeAxis("own", 1 / 30)
    for k in range(900):
        true_s = k / 30
        late_s = 0.004 + rng.exponential(0.02)
        axis.pts_s(frame(500.0 + true_s * (1 + 50e-6), k, 80.0 + true_s + late_s))
    on_axis = axis.from_host(80.0 + 30.0)
    # What is left is the least lateness (a constant of the camera), what 300 draws of it miss, about
    # 0.02 / 300 s, and 50 ppm of the ten seconds that are remembered.
    assert on_axis == pytest.approx(30.0 - 0.004, abs=0.0025)
