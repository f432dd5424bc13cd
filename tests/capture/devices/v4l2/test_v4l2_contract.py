"""The contract of cameras, held by V4L2: on the fake driver with each of its faults, and on real cameras."""

import pytest
from camera_contract import CameraContract

from capture.devices.bench import Bench, VirtualClock
from capture.devices.camera import CameraProfile
from capture.devices.table import open_camera
from capture.devices.v4l2 import list_cameras

SMALL = CameraProfile(width=64, height=48, exposure_s=0.01, gain=40, white_balance_k=4000, focus=30)


class FakeContract(CameraContract):
    profile = SMALL
    description = "plain"

    @pytest.fixture
    def device(self):
        camera = open_camera(
            f"fake-v4l2:profile={self.description};width=64;height=48", Bench(VirtualClock())
        )
        yield camera
        camera.close()


class TestPlain(FakeContract):
    pass


class TestMotionJpeg(FakeContract):
    profile = CameraProfile(width=64, height=48, pixel_format="MJPG", exposure_s=0.01, gain=40)


class TestNv12(FakeContract):
    profile = CameraProfile(width=64, height=48, pixel_format="NV12", exposure_s=0.01, gain=40)


class TestRaw(FakeContract):
    profile = CameraProfile(width=64, height=48, pixel_format="RGGB", exposure_s=0.01, gain=40)


class TestDeepRaw(FakeContract):
    profile = CameraProfile(width=64, height=48, pixel_format="RG10", exposure_s=0.01, gain=40)


class TestEverythingLeftOpen(FakeContract):
    profile = CameraProfile(width=64, height=48, fps=30)


class TestC920(FakeContract):
    description = "c920"


class TestC270(FakeContract):
    description = "c270"


class TestLifecam(FakeContract):
    description = "lifecam"


class TestOldKernel(FakeContract):
    description = "old-kernel"


class TestNewKernel(FakeContract):
    description = "new-kernel"


class TestStaleCache(FakeContract):
    description = "stale-cache"


class TestForgetsManual(FakeContract):
    description = "forgets-manual"


class TestBadStamps(FakeContract):
    description = "bad-stamps"


class TestOwnClock(FakeContract):
    description = "own-clock"


class TestGaps(FakeContract):
    description = "gaps"
    loses_frames = True


class TestDamaged(FakeContract):
    description = "damaged"
    damages_frames = True


class TestFailsToStart(FakeContract):
    description = "fails-to-start"


class TestNoBandwidth(FakeContract):
    description = "no-bandwidth"


class TestBare(FakeContract):
    description = "bare"
    has_exposure = False


@pytest.mark.skipif(not list_cameras(), reason="no V4L2 camera on this machine")
class TestRealCamera(CameraContract):
    profile = CameraProfile(exposure_s=0.01)
    # A camera in use on a desk: what it can do is not known, and frames may be lost while tests run.
    has_exposure = False
    steady_rate = False
    loses_frames = True

    @pytest.fixture
    def device(self):
        camera = open_camera(list_cameras()[0])
        yield camera
        camera.restore()
        camera.close()
