"""A camera through OpenCV keeps the contract of every camera, whichever back end OpenCV has under it."""

import pytest
from camera_contract import CameraContract
from fake_opencv import LyingCapture

from capture.devices.bench import Bench, VirtualClock
from capture.devices.camera import CameraProfile
from capture.devices.opencv import OpenCvCamera


class Lying(CameraContract):
    profile = CameraProfile(exposure_s=0.005, gain=20, white_balance_k=5000, focus=0, fps=30, settle_frames=8)
    back_end = ""

    @pytest.fixture
    def device(self):
        bench = Bench(VirtualClock())
        with OpenCvCamera("opencv:0", LyingCapture(bench, self.back_end), bench) as camera:
            yield camera


class TestVideo4Linux(Lying):
    back_end = "V4L2"


class TestDirectShow(Lying):
    back_end = "DSHOW"


class TestAvFoundation(Lying):
    back_end = "AVFOUNDATION"
    has_exposure = False
