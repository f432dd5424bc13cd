"""Any call to the driver may fail, at any time, with any number: errors for the user come out, no others."""

import errno
import os

import numpy as np
import pytest

from capture.devices.bench import Bench, VirtualClock
from capture.devices.camera import CameraProfile
from capture.devices.v4l2.camera import V4l2Camera
from capture.devices.v4l2.fake_driver import FAKE_PATH, FakeKernel
from capture.devices.v4l2.fake_quirks import Quirks
from capture.errors import CameraError, CameraGoneError

PROFILE = CameraProfile(width=64, height=48, exposure_s=0.01, settle_frames=2)
SIZES = (("YUYV", (((64, 48), (30.0,)),)), ("MJPG", (((64, 48), (30.0,)),)))
NUMBERS = (
    errno.EIO,
    errno.EPROTO,
    errno.EACCES,
    errno.EBUSY,
    errno.EINVAL,
    errno.ENOMEM,
    errno.ENOSPC,
    errno.ETIMEDOUT,
    errno.EREMOTEIO,
)


class Failing:
    """A kernel whose n-th call fails, once or from then on."""

    def __init__(self, kernel, call, number, lasting):
        self._kernel, self._call, self._number, self._lasting = kernel, call, number, lasting
        self.calls = 0
        self.open_descriptors = set()

    def open(self, path):
        self._count()
        descriptor = self._kernel.open(path)
        self.open_descriptors.add(descriptor)
        return descriptor

    def close(self, descriptor):
        self.open_descriptors.discard(descriptor)
        self._kernel.close(descriptor)

    def ioctl(self, descriptor, request, argument):
        self._count()
        self._kernel.ioctl(descriptor, request, argument)

    def mmap(self, descriptor, length, offset):
        self._count()
        return self._kernel.mmap(descriptor, length, offset)

    def wait(self, descriptor, timeout_s):
        self._count()
        return self._kernel.wait(descriptor, timeout_s)

    def describe(self, path):
        return {}

    def _count(self):
        self.calls += 1
        if self.calls == self._call or (self._lasting and self.calls > self._call):
            raise OSError(self._number, os.strerror(self._number))


def use(call, number, lasting):
    """A camera's life with a failure in it: (kernel, the error that came out or None)."""
    bench = Bench(VirtualClock())
    kernel = Failing(FakeKernel(Quirks(modes=SIZES), bench), call, number, lasting)
    camera = failure = None
    try:
        camera = V4l2Camera(kernel, FAKE_PATH, "fake:", "fake-v4l2", bench.clock)
        camera.lock(PROFILE)
        for _ in range(5):
            camera.read(1.0)
        camera.check()
        camera.restore()
    except CameraError as error:
        failure = error
    finally:
        if camera is not None:
            camera.close()
            camera.close()
    return kernel, failure


@pytest.fixture(scope="module")
def calls():
    kernel, failure = use(0, 0, lasting=False)
    assert failure is None
    return kernel.calls


@pytest.mark.parametrize("part", range(8))
def test_a_call_that_fails_once_leaves_no_other_error_and_nothing_open(calls, part):
    rng = np.random.default_rng([1, part])
    for _ in range(3):
        call, number = int(rng.integers(1, calls + 1)), int(rng.choice(NUMBERS))
        kernel, failure = use(call, number, lasting=False)
        assert not kernel.open_descriptors, (call, number)
        assert failure is None or str(failure).endswith("."), (call, number)


@pytest.mark.parametrize("part", range(8))
def test_a_camera_that_goes_away_at_any_call_is_gone(calls, part):
    rng = np.random.default_rng([2, part])
    for _ in range(3):
        call = int(rng.integers(1, calls - 100))  # the last put the controls back, which says it in words
        kernel, failure = use(call, errno.ENODEV, lasting=True)
        assert isinstance(failure, CameraGoneError), call
        assert not kernel.open_descriptors


def test_a_frame_that_is_too_short_is_damaged_though_the_driver_does_not_say_so():
    bench = Bench(VirtualClock())
    kernel = FakeKernel(Quirks(modes=SIZES), bench)
    with V4l2Camera(kernel, FAKE_PATH, "fake:", "fake-v4l2", bench.clock) as camera:
        camera.lock(PROFILE)
        encode = kernel._sensor.encode
        kernel._sensor.encode = lambda light, name: encode(light, name)[:-1]
        assert [camera.read(1.0).damaged for _ in range(3)] == [True] * 3
