"""A USB camera without V4L2: our requests through libusb and the kernel's usbfs, and its pictures by OpenCV.

Where uvcvideo has the camera libusb must be sent away, and OpenCV's V4L2 back end is what is tried instead.
"""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import usb.backend.libusb1
import uvc_camera
from kernel import load, unload, until
from usb_bus import plugged
from uvc_camera import UvcCamera

from capture.devices import uvc
from capture.devices.bench import Bench
from capture.devices.camera import (
    CameraInfo,
    CameraProfile,
    CapturedFrame,
    LockReport,
    StreamFormat,
)
from capture.devices.table import open_camera
from capture.devices.uvc.usb_link import find_cameras, libusb
from capture.errors import CameraError, CameraGoneError

URL = "1209:0002;stream=wedge:"
PROFILE = CameraProfile(
    exposure_s=0.005, gain=20, white_balance_k=5000, focus=50, mains_hz=50, settle_frames=3
)
WANTED = {
    uvc_camera.AE_MODE: uvc_camera.MANUAL,
    uvc_camera.AE_PRIORITY: 0,
    uvc_camera.EXPOSURE: 50,
    uvc_camera.GAIN: 20,
    uvc_camera.AUTO_WHITE_BALANCE: 0,
    uvc_camera.WHITE_BALANCE: 5000,
    uvc_camera.AUTO_FOCUS: 0,
    uvc_camera.FOCUS: 50,
    uvc_camera.POWER_LINE: 1,
}


def fresh_libusb():
    """A libusb that looks at the bus anew: without udevd it hears of nothing that is plugged in later."""
    usb.backend.libusb1._lib_object = None
    return libusb()


class Wedge:
    """What the camera sees, without a bus: the stream half of another back end."""

    format = StreamFormat(width=160, height=120, pixel_format="RGB3", fps=30.0)
    info = CameraInfo(
        url="wedge:", name="wedge", back_end="wedge", details={}, clock="own", stamp_at="unknown"
    )

    def __init__(self, model):
        self._model, self._sequence = model, -1

    def lock(self, profile):
        return LockReport(controls=())

    def read(self, timeout_s):
        self._sequence += 1
        start_s = self._sequence / 30
        rgb = np.ascontiguousarray(self._model._picture(start_s))
        return CapturedFrame(stamp_s=start_s, sequence=self._sequence, data=rgb, arrival_s=start_s)

    def check(self):
        return ()

    def restore(self):
        return ()

    def close(self):
        pass


@pytest.fixture(autouse=True)
def _needs_libusb():
    try:
        libusb()
    except CameraError as error:
        pytest.skip(str(error))


@pytest.fixture
def model():
    return UvcCamera()


@pytest.fixture
def pull(model):
    """The camera is in the bus, and libusb sees it."""
    with plugged(model.device) as pull:
        until(lambda: find_cameras(fresh_libusb()), "a camera for libusb")
        yield pull


@pytest.fixture
def camera(model, pull, monkeypatch):
    monkeypatch.setattr("capture.devices.table.open_camera", lambda url, bench: Wedge(model))
    with uvc.open_camera(URL, Bench()) as camera:
        yield camera


def values(model):
    return {key: model.value(key) for key in WANTED}


def test_libusb_lists_the_camera_where_v4l2_has_none(pull):
    assert uvc.list_uvc(libusb()) == ("uvc:1209:0002",)


def test_opening_reads_who_it_is_and_sets_nothing(model, camera):
    assert camera.info.name == "Grey Wedge"
    assert camera.info.details["serial"] == "0001"
    assert {"exposure_time_absolute", "gain", "focus_absolute"} <= set(camera.info.details["controls"])
    assert model.received == []


def test_the_camera_gets_every_setting_and_none_that_it_refuses(model, camera):
    report = camera.lock(PROFILE)
    assert values(model) == WANTED
    assert model.refused == []
    exposure = next(control for control in report.controls if control.name == "exposure_s")
    assert (exposure.read_back, exposure.verified) == (0.005, True)
    assert report.value("gain") == 20


def test_a_change_behind_our_back_is_found_and_everything_is_put_back(model, camera):
    found = values(model)
    camera.lock(PROFILE)
    assert camera.check() == ()
    model.turn(uvc_camera.GAIN, 3)
    (changed,) = camera.check()
    assert (changed.name, changed.read_back) == ("gain", 3)
    assert camera.restore() == ()
    automatic = (uvc_camera.EXPOSURE, uvc_camera.WHITE_BALANCE, uvc_camera.FOCUS)
    now = values(model)
    assert {key: now[key] for key in now if key not in automatic} == {
        key: found[key] for key in found if key not in automatic
    }


def test_a_camera_that_is_pulled_out_is_gone(camera, pull):
    camera.lock(PROFILE)
    pull()
    with pytest.raises(CameraGoneError, match="not there any more"):
        camera.check()
    (problem,) = camera.restore()
    assert "could not be put back" in problem


@pytest.fixture
def node(model):
    load("uvcvideo")
    with plugged(model.device):
        yield until(_video_node, "a camera")
    unload("uvcvideo")


def _video_node():
    for entry in Path("/sys/class/video4linux").glob("video*"):
        if "Grey Wedge" in (entry / "name").read_text() and (entry / "index").read_text() == "0\n":
            return entry.name
    return None


def test_a_camera_that_uvcvideo_has_is_sent_to_v4l2_and_keeps_its_driver(model, node):
    until(lambda: find_cameras(fresh_libusb()), "a camera for libusb")
    with pytest.raises(CameraError, match=r"uvcvideo.*v4l2:/dev/videoN"):
        uvc.open_camera(URL, Bench())
    assert _video_node() == node
    assert uvc.list_cameras() == ()


def test_opencv_sets_reads_back_and_streams_by_v4l2(model, node):
    number = node.removeprefix("video")
    with open_camera(f"opencv:{number}") as camera:
        report = camera.lock(CameraProfile(exposure_s=0.005, gain=20, white_balance_k=5000, focus=50))
        assert camera.info.details["opencv_backend"] == "V4L2"
        assert values(model) | {uvc_camera.AE_PRIORITY: 0, uvc_camera.POWER_LINE: 1} == WANTED
        exposure = next(control for control in report.controls if control.name == "exposure_s")
        assert (exposure.read_back, exposure.verified) == (0.005, True)
        frames = [camera.read(10.0) for _ in range(5)]
        assert all(one.stamp_s < other.stamp_s for one, other in pairwise(frames))
        # Stamps are CLOCK_MONOTONIC: not later than the arrival, and not older than the buffers' few frames.
        assert all(0 <= frame.arrival_s - frame.stamp_s < 10 for frame in frames)
        assert camera.restore() == ()
    assert model.value(uvc_camera.AE_MODE) == uvc_camera.APERTURE_PRIORITY
