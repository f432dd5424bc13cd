"""The V4L2 back end on vivid, the kernel's own test camera: real buffers, and faults to order.

vivid has a gain with an automatic, brightness and its kin, but neither exposure time nor white balance in
kelvin, as many a cheap camera. When a frame comes and how many are lost depends on the machine's speed: only
order, counts and content are judged.
"""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from camera_contract import CameraContract
from kernel import loaded, until
from v4l2_controls import another_program

from capture.devices.camera import CameraProfile
from capture.devices.pixel_formats import decode_rgb
from capture.devices.table import open_camera
from capture.errors import CameraError, CameraGoneError

NODE = "/dev/video0"
PROFILE = CameraProfile(width=320, height=180, pixel_format="YUYV", fps=30, settle_frames=2)
PATIENCE_S = 10.0


@pytest.fixture(scope="module", autouse=True)
def driver():
    with loaded("vivid", n_devs=1, node_types="0x1", input_types="0x0"):
        until(Path(NODE).exists, NODE)
        yield


@pytest.fixture
def camera():
    with open_camera(NODE) as camera:
        yield camera


@pytest.fixture
def other():
    with another_program(NODE) as controls:
        yield controls


def frames(camera, count):
    return [camera.read(PATIENCE_S) for _ in range(count)]


def test_it_is_listed_with_its_driver():
    from capture.devices.v4l2 import list_cameras

    assert any(url.endswith(NODE) for url in list_cameras())
    with open_camera(NODE) as camera:
        assert "vivid" in str(camera.info.details)
        assert (camera.info.back_end, camera.info.clock) == ("v4l2", "monotonic")


def test_opening_changes_nothing(other):
    other.set("Gain", 77)
    names = sorted(other.names & {"Gain", "Gain, Automatic", "Brightness", "Contrast", "Saturation", "Hue"})
    before = [other.get(name) for name in names if name != "Gain"]
    with open_camera(NODE):
        pass
    assert [other.get(name) for name in names if name != "Gain"] == before


def test_what_it_does_not_have_is_said_and_the_rest_is_locked(camera, other):
    other.set("Gain, Automatic", 1)
    report = camera.lock(
        CameraProfile(
            **(PROFILE.__dict__ | {"exposure_s": 0.005, "gain": 40, "white_balance_k": 5000, "focus": 10})
        )
    )
    said = " ".join(report.warnings)
    assert "exposure" in said
    assert "white balance" in said or "white_balance" in said
    assert other.get("Gain, Automatic") == 0
    assert other.get("Gain") == report.value("gain") == 40
    assert (camera.format.width, camera.format.height, camera.format.pixel_format) == (320, 180, "YUYV")


def test_a_gain_beyond_the_range_is_clamped_by_the_kernel_and_that_is_said(camera, other):
    report = camera.lock(CameraProfile(**(PROFILE.__dict__ | {"gain": 1000})))
    assert report.value("gain") == other.get("Gain") == 255
    gain = next(control for control in report.controls if control.name == "gain")
    assert gain.note
    assert any("gain" in warning for warning in report.warnings)


def test_frames_come_in_order_stamped_by_the_clock_of_the_host(camera):
    camera.lock(PROFILE)
    got = frames(camera, 20)
    assert all(one.sequence < other.sequence for one, other in pairwise(got))
    assert all(one.stamp_s < other.stamp_s for one, other in pairwise(got))
    assert all(0 <= frame.arrival_s - frame.stamp_s < PATIENCE_S for frame in got)
    assert not any(frame.damaged for frame in got)


def test_the_pattern_is_seen_in_its_colours(camera, other):
    other.set("Test Pattern", 6)  # white
    other.set("OSD Text Mode", 2)  # nothing written into it
    camera.lock(PROFILE)
    frames(camera, 6)
    white = decode_rgb(camera.read(PATIENCE_S).data, camera.format)
    other.set("Test Pattern", 1)  # bars of full colours
    frames(camera, 6)
    bars = decode_rgb(camera.read(PATIENCE_S).data, camera.format)
    assert white.shape == bars.shape == (180, 320, 3)
    # vivid's colours are of 8 bits in Y'CbCr, chroma at half width: within 3 codes of what they were.
    assert np.abs(white.astype(int) - white[90, 160]).max() <= 3
    middle = bars[90, 20::40].astype(int)  # eight bars: white, yellow, cyan, green, magenta, red, blue, black
    assert [tuple(bar > 128) for bar in middle[:7]] == [
        (True, True, True),
        (True, True, False),
        (False, True, True),
        (False, True, False),
        (True, False, True),
        (True, False, False),
        (False, False, True),
    ]


def test_lost_frames_are_gaps_in_the_sequence(camera, other):
    camera.lock(PROFILE)
    other.set("Percentage of Dropped Buffers", 50)
    got = frames(camera, 24)  # none lost has a probability of 2^-24
    other.set("Percentage of Dropped Buffers", 0)
    steps = [after.sequence - before.sequence for before, after in pairwise(got)]
    assert min(steps) >= 1
    assert max(steps) > 1


def test_a_buffer_with_the_error_flag_is_a_damaged_frame(camera, other):
    camera.lock(PROFILE)
    frames(camera, 4)
    other.press("Inject V4L2_BUF_FLAG_ERROR")
    assert sum(frame.damaged for frame in frames(camera, 12)) == 1


@pytest.mark.parametrize("step", ["VIDIOC_REQBUFS", "VIDIOC_QBUF", "VIDIOC_STREAMON"])
def test_a_stream_that_does_not_start_is_an_error_and_the_next_one_does(step, other):
    with open_camera(NODE) as camera:
        other.press(f"Inject {step} Error")
        with pytest.raises(CameraError) as raised:
            camera.lock(PROFILE)
        assert NODE in str(raised.value)
    with open_camera(NODE) as camera:
        camera.lock(PROFILE)
        frames(camera, 2)


def test_a_fatal_error_of_the_stream_is_a_camera_error(other):
    with open_camera(NODE) as camera:
        camera.lock(PROFILE)
        frames(camera, 2)
        other.press("Inject Fatal Streaming Error")
        with pytest.raises(CameraError):
            frames(camera, 20)  # those that were filled before may still come
    with open_camera(NODE) as camera:
        camera.lock(PROFILE)
        frames(camera, 2)


def test_a_control_that_somebody_else_changes_is_noticed(camera, other):
    camera.lock(CameraProfile(**(PROFILE.__dict__ | {"gain": 40})))
    assert camera.check() == ()
    other.set("Gain", 90)
    frames(camera, 2)
    assert [(control.name, control.read_back) for control in camera.check()] == [("gain", 90)]


def test_the_controls_are_put_back(other):
    other.set("Gain, Automatic", 0)
    other.set("Gain", 33)
    other.set("Gain, Automatic", 1)
    other.set("Brightness", 99)
    with open_camera(NODE) as camera:
        camera.lock(CameraProfile(**(PROFILE.__dict__ | {"gain": 40})))
        assert other.get("Gain, Automatic") == 0
        assert camera.restore() == ()
    assert other.get("Gain, Automatic") == 1
    assert other.get("Brightness") == 99


def test_a_camera_in_use_is_refused_in_one_sentence(camera):
    camera.lock(PROFILE)
    with pytest.raises(CameraError, match=r"use|busy"), open_camera(NODE) as second:
        second.lock(PROFILE)
    frames(camera, 2)


class TestContract(CameraContract):
    """What every camera must do; this machine is slow, so that frames are lost and their rate is not kept."""

    profile = PROFILE
    has_exposure = verified_by_light = steady_rate = False
    loses_frames = True
    timeout_s = PATIENCE_S

    @pytest.fixture
    def device(self, camera):
        return camera


def test_a_camera_that_is_pulled_out_is_gone_and_can_be_closed(other):
    with open_camera(NODE) as camera:
        camera.lock(PROFILE)
        frames(camera, 2)
        other.press("Disconnect")
        with pytest.raises(CameraGoneError):
            frames(camera, 20)
        with pytest.raises(CameraGoneError):
            camera.read(1.0)
        camera.close()
        camera.close()
