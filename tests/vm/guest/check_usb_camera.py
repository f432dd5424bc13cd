"""A camera on USB behind the kernel's uvcvideo: what our V4L2 back end asks is what the camera gets.

The camera is a program (`uvc_camera.py`); the driver, its clamps, its buffers and its requests are real. One
camera goes through the tests in their order, because a lock with its look at the light takes many frames.
"""

from contextlib import suppress
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import pytest
import uvc_camera
from kernel import loaded, until
from usb_bus import plugged
from uvc_camera import UvcCamera, video_node
from v4l2_controls import another_program

from capture.devices.camera import CameraProfile
from capture.devices.light_check import linear_luma
from capture.devices.pixel_formats import decode_rgb
from capture.devices.table import open_camera
from capture.errors import CameraError, CameraGoneError

PROFILE = CameraProfile(
    width=160,
    height=120,
    fps=30,
    pixel_format="YUYV",
    exposure_s=0.005,
    gain=16,
    white_balance_k=5000,
    focus=50,
    mains_hz=50,
    settle_frames=2,
)
PATIENCE_S = 10.0
#: Between a change and a picture that shows it: the camera's own delay, and as many as may wait in buffers.
IN_FLIGHT = uvc_camera.LATENCY_FRAMES + 8


@pytest.fixture(scope="module")
def desk():
    """The camera's model, its node, how to pull it out, what it had before; it is in the bus, and opened."""
    model = UvcCamera()
    with loaded("uvcvideo"), plugged(model.device) as pull:
        node = until(video_node, "a camera")
        before = model.settings()
        with open_camera(node) as camera:
            yield SimpleNamespace(model=model, node=node, pull=pull, before=before, camera=camera)


def frames(camera, count):
    return [camera.read(PATIENCE_S) for _ in range(count)]


def picture(camera):
    return decode_rgb(camera.read(PATIENCE_S).data, camera.format)


def light(camera):
    return linear_luma(camera.read(PATIENCE_S), camera.format).mean()


def test_opening_changes_nothing(desk):
    assert desk.model.received == []
    assert desk.camera.info.details["driver"] == "uvcvideo"
    assert desk.camera.info.details["usb_id"] == "1209:0002"


def test_the_camera_gets_every_setting_of_the_lock_and_its_automatics_are_off_before(desk):
    report = desk.camera.lock(PROFILE)
    assert desk.model.settings() == uvc_camera.LOCKED
    order = [key for key, _, _ in desk.model.received]
    assert order.index(uvc_camera.AE_MODE) < order.index(uvc_camera.EXPOSURE)
    assert order.index(uvc_camera.AUTO_WHITE_BALANCE) < order.index(uvc_camera.WHITE_BALANCE)
    assert order.index(uvc_camera.AUTO_FOCUS) < order.index(uvc_camera.FOCUS)
    assert desk.model.refused == []
    assert report.value("exposure_s") == pytest.approx(0.005)
    assert report.value("gain") == 16
    assert report.value("white_balance_k") == 5000
    exposure = next(control for control in report.controls if control.name == "exposure_s")
    assert exposure.verified is True  # by the light of the camera's own pictures


def test_frames_come_in_order_stamped_by_the_clock_of_the_host(desk):
    got = frames(desk.camera, 12)
    assert all(one.sequence < other.sequence for one, other in pairwise(got))
    assert all(one.stamp_s < other.stamp_s for one, other in pairwise(got))
    assert all(0 <= frame.arrival_s - frame.stamp_s < PATIENCE_S for frame in got)
    assert {len(frame.data) for frame in got} == {160 * 120 * 2}


def test_a_frame_that_the_camera_marks_is_never_taken_for_a_whole_one(desk):
    """The driver itself drops damaged frames without compression; the gap in its count remains."""
    first = frames(desk.camera, 3)[-1].sequence
    desk.model.break_frames(4, 6)
    whole = [frame.sequence for frame in frames(desk.camera, 14) if not frame.damaged]
    assert whole[-1] - first > len(whole)


def test_what_another_program_sets_is_noticed(desk):
    assert desk.camera.check() == ()
    with another_program(desk.node) as other:
        other.set("Gain", 60)
    assert desk.model.value(uvc_camera.GAIN) == 60
    assert [(control.name, control.read_back) for control in desk.camera.check()] == [("gain", 60)]


def test_half_the_exposure_time_is_half_the_light(desk):
    desk.camera.lock(PROFILE)
    frames(desk.camera, IN_FLIGHT)
    long = light(desk.camera)
    desk.camera.lock(replace(PROFILE, exposure_s=0.0025))
    frames(desk.camera, IN_FLIGHT)
    short = light(desk.camera)
    # 8 bits of the darkest grey (0.05 / 4 of white): half a code is 3 % of its light.
    assert long / short == pytest.approx(2.0, rel=0.04)


def test_motion_jpeg_comes_as_jpeg_and_an_exposure_beyond_the_range_is_clamped(desk):
    report = desk.camera.lock(replace(PROFILE, pixel_format="MJPG", exposure_s=0.5))
    assert desk.model.value(uvc_camera.EXPOSURE) == 2047
    assert report.value("exposure_s") == pytest.approx(0.2047)
    assert any("exposure" in warning for warning in report.warnings)
    desk.camera.lock(replace(PROFILE, pixel_format="MJPG"))
    assert desk.camera.format.pixel_format == "MJPG"
    frames(desk.camera, IN_FLIGHT)
    frame = desk.camera.read(PATIENCE_S)
    assert bytes(frame.data[:2]) == b"\xff\xd8"
    rgb = decode_rgb(frame.data, desk.camera.format)
    assert rgb.shape == (120, 160, 3)
    assert rgb[60, 150].astype(int).mean() > rgb[60, 10].astype(int).mean() + 50  # the wedge


def test_the_camera_is_left_as_it_was(desk):
    assert desk.camera.restore() == ()
    assert desk.model.settings() == desk.before


def test_a_camera_pulled_out_of_the_bus_is_gone_and_can_be_closed(desk):
    frames(desk.camera, 2)
    desk.pull()
    with pytest.raises(CameraGoneError):
        frames(desk.camera, 20)
    with suppress(CameraGoneError):
        desk.camera.restore()
    desk.camera.close()
    desk.camera.close()
    with pytest.raises(CameraError):
        open_camera(desk.node)
