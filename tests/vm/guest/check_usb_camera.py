"""A camera on USB behind the kernel's uvcvideo: what our back ends ask is what the camera gets.

The camera is a program (`uvc_camera.py`); the driver, its clamps, its buffers and its requests are real.
"""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest
import uvc_camera
from kernel import load, unload, until
from usb_bus import plugged
from uvc_camera import UvcCamera
from v4l2_controls import another_program

from capture.devices.bench import Bench
from capture.devices.camera import CameraProfile, mean_linear
from capture.devices.pixel_formats import decode_rgb
from capture.devices.table import open_camera
from capture.errors import CameraError, CameraGoneError

PROFILE = CameraProfile(
    width=160,
    height=120,
    fps=15,
    pixel_format="YUYV",
    exposure_s=0.005,
    gain=16,
    white_balance_k=5000,
    focus=50,
    mains_hz=50,
    settle_frames=2,
)
PATIENCE_S = 10.0


@pytest.fixture(scope="module", autouse=True)
def driver():
    load("uvcvideo")
    yield
    unload("uvcvideo")


@pytest.fixture
def model():
    return UvcCamera()


@pytest.fixture
def node(model):
    with plugged(model.device) as pull:
        model.pull = pull
        yield until(lambda: next(iter(sorted(Path("/dev").glob("video*"))), None), "a camera").as_posix()


@pytest.fixture
def camera(node):
    with open_camera(node) as camera:
        yield camera


def frames(camera, count):
    return [camera.read(PATIENCE_S) for _ in range(count)]


def picture(camera):
    return decode_rgb(camera.read(PATIENCE_S).data, camera.format)


def test_the_camera_gets_every_setting_of_the_lock_and_the_automatics_are_off_before(model, camera):
    report = camera.lock(PROFILE)
    wanted = {
        uvc_camera.AE_MODE: uvc_camera.MANUAL,
        uvc_camera.AE_PRIORITY: 0,
        uvc_camera.EXPOSURE: 50,
        uvc_camera.GAIN: 16,
        uvc_camera.AUTO_WHITE_BALANCE: 0,
        uvc_camera.WHITE_BALANCE: 5000,
        uvc_camera.AUTO_FOCUS: 0,
        uvc_camera.FOCUS: 50,
        uvc_camera.POWER_LINE: 1,
    }
    assert {key: model.value(key) for key in wanted} == wanted
    order = [key for key, _, _ in model.received]
    assert order.index(uvc_camera.AE_MODE) < order.index(uvc_camera.EXPOSURE)
    assert order.index(uvc_camera.AUTO_WHITE_BALANCE) < order.index(uvc_camera.WHITE_BALANCE)
    assert order.index(uvc_camera.AUTO_FOCUS) < order.index(uvc_camera.FOCUS)
    assert report.value("exposure_s") == pytest.approx(0.005)
    assert report.value("gain") == 16
    assert report.value("white_balance_k") == 5000
    assert not [control for control in report.controls if control.verified is False]


def test_frames_come_in_order_and_show_the_exposure_time(model, camera):
    camera.lock(PROFILE)
    got = frames(camera, 12)
    assert all(one.sequence < other.sequence for one, other in pairwise(got))
    assert all(one.stamp_s < other.stamp_s for one, other in pairwise(got))
    long = mean_linear(picture(camera), camera.format.transfer)
    camera.lock(replace(PROFILE, exposure_s=0.0025))
    frames(
        camera, uvc_camera.LATENCY_FRAMES + 6
    )  # as many as may be waiting in buffers, and the camera's own
    short = mean_linear(picture(camera), camera.format.transfer)
    # 8 bits of the darkest grey (0.05 / 4 of white): half a code is 3 % of its light.
    assert long / short == pytest.approx(2.0, rel=0.04)


def test_an_exposure_beyond_the_range_is_clamped_by_the_driver_and_that_is_said(model, camera):
    report = camera.lock(replace(PROFILE, exposure_s=0.5, fps=None))
    assert model.value(uvc_camera.EXPOSURE) == 2047
    assert report.value("exposure_s") == pytest.approx(0.2047)
    assert any("exposure" in warning for warning in report.warnings)


def test_a_frame_that_the_camera_marks_is_never_taken_for_a_whole_one(model, camera):
    """The driver itself drops damaged frames without compression; the gap in its count remains."""
    camera.lock(PROFILE)
    first = frames(camera, 3)[-1].sequence
    now = next(model._streaming.frames)
    model.broken.update({now + 4, now + 6})
    got = frames(camera, 14)
    whole = [frame.sequence for frame in got if not frame.damaged]
    assert len(got[0].data) == 160 * 120 * 2
    assert whole[-1] - first > len(whole)


def test_motion_jpeg_comes_as_jpeg(camera):
    camera.lock(replace(PROFILE, pixel_format="MJPG"))
    assert camera.format.pixel_format == "MJPG"
    frames(camera, 4)
    frame = camera.read(PATIENCE_S)
    assert bytes(frame.data[:2]) == b"\xff\xd8"
    rgb = decode_rgb(frame.data, camera.format)
    assert rgb.shape == (120, 160, 3)
    assert rgb[60, 150].astype(int).mean() > rgb[60, 10].astype(int).mean() + 50  # the wedge


def test_what_another_program_sets_is_noticed(model, node, camera):
    camera.lock(PROFILE)
    with another_program(node) as other:
        other.set("Gain", 60)
        assert model.value(uvc_camera.GAIN) == 60
        frames(camera, 2)
        assert [(control.name, control.read_back) for control in camera.check()] == [("gain", 60)]


def test_the_camera_is_left_as_it_was(model, node):
    before = {key: control.value for key, control in model._control.controls.items()}
    with open_camera(node) as camera:
        camera.lock(PROFILE)
        assert camera.restore() == ()
    automatic = {uvc_camera.EXPOSURE, uvc_camera.WHITE_BALANCE, uvc_camera.FOCUS}  # the camera's own affair
    after = {key: control.value for key, control in model._control.controls.items()}
    assert {key: value for key, value in after.items() if key not in automatic} == {
        key: value for key, value in before.items() if key not in automatic
    }


def test_a_camera_pulled_out_of_the_bus_is_gone_and_can_be_closed(model, node):
    with open_camera(node) as camera:
        camera.lock(PROFILE)
        frames(camera, 2)
        model.pull()
        with pytest.raises(CameraGoneError):
            frames(camera, 20)
        camera.restore()
        camera.close()
    with pytest.raises(CameraError):
        open_camera(node)


def test_by_light_the_exposure_time_is_what_it_says(camera):
    from capture.devices.light_check import verify_exposure

    report = camera.lock(PROFILE)
    assert report.value("exposure_s") == pytest.approx(0.005)
    verify_exposure  # noqa: B018


class TestByRequestsOfOurOwn:
    """Without the kernel's driver: the requests that our own UVC back end makes through libusb."""

    @pytest.fixture
    def camera(self, model):
        unload("uvcvideo")
        try:
            with plugged(model.device) as pull:
                model.pull = pull
                with open_camera("uvc:1209:0002;stream=sim:", Bench()) as camera:
                    yield camera
        finally:
            load("uvcvideo")

    def test_the_camera_gets_every_setting(self, model, camera):
        report = camera.lock(PROFILE)
        assert model.value(uvc_camera.AE_MODE) == uvc_camera.MANUAL
        assert model.value(uvc_camera.EXPOSURE) == 50
        assert model.value(uvc_camera.GAIN) == 16
        assert model.value(uvc_camera.WHITE_BALANCE) == 5000
        assert report.value("exposure_s") == pytest.approx(0.005)
        lengths = {key: length for key, _, length in model.received}
        assert lengths[uvc_camera.EXPOSURE] == 4
        assert lengths[uvc_camera.GAIN] == 2
