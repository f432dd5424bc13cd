"""Device nodes: enumeration, errors in words, interrupted calls."""

import errno
import os
from contextlib import suppress

import pytest

from capture.devices.bench import Bench, VirtualClock
from capture.devices.table import open_camera
from capture.devices.v4l2 import structs as v4l2
from capture.devices.v4l2.controls import Control, Controls
from capture.devices.v4l2.fake_driver import FAKE_PATH, FakeKernel
from capture.devices.v4l2.fake_quirks import USB2_MODES, Quirks
from capture.devices.v4l2.kernel import LinuxKernel
from capture.devices.v4l2.node import VideoNode, translated
from capture.errors import CameraError, CameraGoneError


class Wrapped:
    """A kernel with something put in front of its ioctls."""

    def __init__(self, kernel, before):
        self._kernel, self._before = kernel, before

    def __getattr__(self, name):
        return getattr(self._kernel, name)

    def ioctl(self, descriptor, request, argument):
        self._before(request, argument)
        self._kernel.ioctl(descriptor, request, argument)


def kernel(**quirks):
    return FakeKernel(Quirks(**quirks), Bench(VirtualClock()))


def test_modes_are_listed_with_their_rates():
    node = VideoNode(kernel(modes=tuple(USB2_MODES.items())), FAKE_PATH)
    listed = {(mode.pixel_format, mode.width, mode.height): mode.rates for mode in node.modes()}
    assert listed[("YUYV", 1280, 720)] == (10.0, 5.0)
    assert listed[("MJPG", 1920, 1080)] == (30.0, 15.0)
    assert len(listed) == 8


def test_ranges_of_sizes_and_rates_are_listed_by_their_ends():
    def stepwise(request, argument):
        if request == v4l2.ENUM_FRAMESIZES:
            if argument.index:
                raise OSError(errno.EINVAL, "")
            argument.type = 3
            argument.size = v4l2.FrameSizeStepwise(16, 4096, 8, 16, 2160, 2)
            raise Done
        if request == v4l2.ENUM_FRAMEINTERVALS:
            argument.type = 2
            argument.interval.min = v4l2.Fraction(1, 120)
            raise Done

    class Done(Exception):
        pass

    class Answering(Wrapped):
        def ioctl(self, descriptor, request, argument):
            with suppress(Done):
                super().ioctl(descriptor, request, argument)

    node = VideoNode(Answering(kernel(), stepwise), FAKE_PATH)
    mode = node.modes()[0]
    assert (mode.width, mode.height, mode.rates, mode.stepwise) == (4096, 2160, (120.0,), True)


def test_controls_are_known_by_their_ids_on_old_and_new_kernels():
    old, new = (Controls(VideoNode(kernel(old_names=names), FAKE_PATH)).all() for names in (True, False))
    assert old.keys() == new.keys()
    assert old[v4l2.CID_EXPOSURE_ABSOLUTE].name == "Exposure (Absolute)"
    assert new[v4l2.CID_EXPOSURE_ABSOLUTE].name == "Exposure Time, Absolute"
    assert new[v4l2.CID_EXPOSURE_AUTO].menu == {1: "Manual Mode", 3: "Aperture Priority Mode"}
    assert new[v4l2.CID_EXPOSURE_ABSOLUTE].inactive


def test_the_nearest_value_that_a_control_can_take():
    control = Control(1, "", v4l2.CTRL_TYPE_INTEGER, 5, 500, 50, 5, 0)
    assert [control.nearest(value) for value in (-1, 5, 29, 31, 80, 499, 10**6)] == [
        5,
        5,
        5,
        55,
        105,
        455,
        455,
    ]
    menu = Control(1, "", v4l2.CTRL_TYPE_MENU, 0, 3, 1, 0, 0, {1: "one", 3: "three"})
    assert menu.nearest(0) == 1
    assert menu.nearest(3) == 3


def test_an_interrupted_call_is_made_again():
    interruptions = []

    def interrupt(request, argument):
        if len(interruptions) % 3 < 2:
            interruptions.append(request)
            raise InterruptedError(errno.EINTR, "interrupted")
        interruptions.append(request)

    node = VideoNode(Wrapped(kernel(), interrupt), FAKE_PATH)
    assert node.describe()["card"] == "Fake camera"
    assert interruptions.count(v4l2.QUERYCAP) == 3


@pytest.mark.parametrize(
    ("number", "kind", "words"),
    [
        (errno.ENODEV, CameraGoneError, "not there any more"),
        (errno.ENOENT, CameraGoneError, "does not exist"),
        (errno.EBUSY, CameraError, "close the program that has it"),
        (errno.EACCES, CameraError, "group video"),
        (errno.ENOSPC, CameraError, "no bandwidth"),
        (errno.EIO, CameraError, "link to the camera has failed"),
        (errno.EPROTO, CameraError, "EPROTO"),
        (errno.EINVAL, CameraError, "EINVAL"),
    ],
)
def test_an_error_number_becomes_a_sentence_that_says_what_to_do(number, kind, words):
    error = translated(OSError(number, os.strerror(number)), "/dev/video7", "start to stream")
    assert type(error) is kind
    assert words in str(error)
    assert "/dev/video7" in str(error)
    assert str(error).endswith(".")


def test_a_node_that_captures_no_video_is_refused_and_closed():
    fake = kernel()

    def metadata(request, argument):
        if request == v4l2.QUERYCAP:
            fake._query_capability(argument, 0)
            argument.device_caps = 0x800000  # V4L2_CAP_META_CAPTURE
            raise Done

    class Done(Exception):
        pass

    class Answering(Wrapped):
        def ioctl(self, descriptor, request, argument):
            with suppress(Done):
                super().ioctl(descriptor, request, argument)

    with pytest.raises(CameraError, match="captures no video"):
        VideoNode(Answering(fake, metadata), FAKE_PATH)
    assert not fake._opened


def test_a_node_that_is_closed_says_so():
    node = VideoNode(kernel(), FAKE_PATH)
    node.close()
    node.close()
    with pytest.raises(CameraError, match="is closed"):
        node.format()


def test_paths_that_are_no_camera_are_errors_of_the_real_kernel(tmp_path):
    with pytest.raises(CameraGoneError, match="does not exist"):
        open_camera("/dev/video987")
    with pytest.raises(CameraError, match="cannot be asked what it is"):
        VideoNode(LinuxKernel(), "/dev/null")
    plain = tmp_path / "plain"
    plain.write_bytes(b"")
    with pytest.raises(CameraError):
        VideoNode(LinuxKernel(), str(plain))
    with pytest.raises(CameraError, match="use a path"):
        open_camera("v4l2:webcam")


def test_the_real_kernel_waits_and_maps(tmp_path):
    linux = LinuxKernel()
    reader, writer = os.pipe()
    try:
        assert linux.wait(reader, 0.0) is False
        os.write(writer, b"x")
        assert linux.wait(reader, 1.0) is True
    finally:
        os.close(reader)
        os.close(writer)
    path = tmp_path / "memory"
    path.write_bytes(b"0123456789" * 1000)
    descriptor = linux.open(str(path))
    mapping = linux.mmap(descriptor, 8192, 0)
    assert mapping[8:12] == b"8901"
    mapping.close()
    linux.close(descriptor)
    assert linux.describe("/dev/null") == {}
