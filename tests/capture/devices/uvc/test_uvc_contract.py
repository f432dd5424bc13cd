"""A camera with its controls over USB keeps the contract of every camera."""

import pytest
from camera_contract import CameraContract
from fake_usb import FakeCamera, FakeUsb, SeeingStream

from capture.devices import uvc
from capture.devices.bench import Bench, VirtualClock
from capture.devices.camera import CameraProfile


class TestUvcCamera(CameraContract):
    profile = CameraProfile(
        exposure_s=0.005, gain=20, white_balance_k=5000, focus=0, mains_hz=50, fps=30, settle_frames=3
    )
    forgets = False

    @pytest.fixture
    def device(self, monkeypatch):
        model = FakeCamera()
        monkeypatch.setattr(
            "capture.devices.table.open_camera",
            lambda url, bench: SeeingStream(bench, model, forgets=self.forgets),
        )
        with uvc.open_uvc("046d:082d;stream=wall:", Bench(VirtualClock()), FakeUsb([model])) as camera:
            yield camera


class TestUvcCameraThatForgetsItsModeAsItStarts(TestUvcCamera):
    forgets = True
