"""A lock against the faults of real cameras and kernels, each on the fake driver."""

import errno
import os

import pytest

from capture.devices.bench import Bench, VirtualClock
from capture.devices.camera import CameraProfile
from capture.devices.light_check import linear_luma
from capture.devices.pixel_formats import decode_rgb
from capture.devices.v4l2 import structs as v4l2
from capture.devices.v4l2.camera import V4l2Camera
from capture.devices.v4l2.fake import open_camera, parse
from capture.devices.v4l2.fake_driver import FAKE_PATH, FakeKernel
from capture.devices.v4l2.settings import without_banding
from capture.errors import CameraError, CameraGoneError, CameraTimeoutError

PROFILE = CameraProfile(width=64, height=48, exposure_s=0.01, gain=40, white_balance_k=4000, focus=30)


@pytest.fixture
def make():
    """Camera and driver of a description."""
    cameras = []

    def make(description, clock=None):
        quirks, seed = parse(f"{description};width=64;height=48")
        bench = Bench(clock or VirtualClock())
        kernel = FakeKernel(quirks, bench, seed)
        cameras.append(V4l2Camera(kernel, FAKE_PATH, "fake-v4l2:", "fake-v4l2", bench.clock))
        return cameras[-1], kernel

    yield make
    for camera in cameras:
        camera.close()


def control(report, name):
    return next(control for control in report.controls if control.name == name)


def brightness(camera, frames=8):
    values = [float(linear_luma(camera.read(1.0), camera.format).mean()) for _ in range(frames)]
    return sum(values) / len(values)


def read_on(camera):
    for _ in range(400):
        camera.read(1.0)


def device(kernel, identity):
    return kernel.controls.device[identity]


@pytest.mark.parametrize(
    "description",
    ["plain", "c920", "old-kernel", "new-kernel", "stale-cache", "forgets-manual", "profile=bad-stamps"],
)
def test_the_device_and_not_only_the_driver_is_locked(make, description):
    camera, kernel = make(description if "=" in description else f"profile={description}")
    report = camera.lock(PROFILE)
    assert device(kernel, v4l2.CID_EXPOSURE_AUTO) == v4l2.EXPOSURE_MANUAL
    assert device(kernel, v4l2.CID_AUTO_WHITE_BALANCE) == 0
    assert device(kernel, v4l2.CID_FOCUS_AUTO) == 0
    assert device(kernel, v4l2.CID_EXPOSURE_AUTO_PRIORITY) == 0
    assert device(kernel, v4l2.CID_BACKLIGHT_COMPENSATION) == 0
    assert device(kernel, v4l2.CID_EXPOSURE_ABSOLUTE) == 100
    assert device(kernel, v4l2.CID_GAIN) == 40
    assert device(kernel, v4l2.CID_WHITE_BALANCE_TEMPERATURE) == 4000
    assert device(kernel, v4l2.CID_FOCUS_ABSOLUTE) == 30
    assert control(report, "exposure_s").verified is True
    assert report.value("exposure_s") == 0.01
    assert not report.warnings


def test_a_clamp_and_a_rounding_are_said(make):
    camera, _ = make("profile=lifecam")
    report = camera.lock(CameraProfile(width=64, height=48, exposure_s=0.0123, gain=1000))
    assert control(report, "exposure_s").read_back == pytest.approx(0.0105)
    assert "rounded to 0.0105" in control(report, "exposure_s").note
    assert control(report, "gain").read_back == 255
    assert "1000 is outside the device's 0..255; 255 was set" in control(report, "gain").note
    assert [warning.split(":")[0] for warning in report.warnings] == ["exposure_s", "gain"]


def test_a_control_that_the_camera_lacks_is_said(make):
    camera, _ = make("profile=bare")
    report = camera.lock(CameraProfile(width=64, height=48, exposure_s=0.01, white_balance_k=5000))
    assert report.value("exposure_s") is None
    assert len(report.warnings) == 2
    assert all("no control for it" in warning for warning in report.warnings)


def test_light_finds_an_exposure_that_is_not_obeyed(make):
    camera, _ = make("profile=ignores-exposure")
    report = camera.lock(PROFILE)
    assert control(report, "exposure_s").read_back == 0.01  # the driver says that all is well
    assert control(report, "exposure_s").verified is False
    assert any("does not expose as it says" in warning for warning in report.warnings)


def test_light_finds_an_exposure_that_rolls_over_to_dark(make):
    camera, _ = make("profile=c270")
    assert control(camera.lock(PROFILE), "exposure_s").verified is True
    # Half of 110 ms is below the value at which the camera rolls over: twice as bright, not half.
    bad = camera.lock(CameraProfile(width=64, height=48, exposure_s=0.110, gain=0))
    assert control(bad, "exposure_s").verified is not True
    assert bad.warnings


def test_light_finds_a_gain_that_an_automatic_still_moves(make):
    camera, _ = make("profile=creeping-gain")
    report = camera.lock(PROFILE)
    assert report.value("gain") == 40  # nobody is told
    assert control(report, "exposure_s").verified is False


def test_settings_left_open_are_found_by_the_automatics_and_frozen(make):
    camera, kernel = make("profile=plain")
    report = camera.lock(CameraProfile(width=64, height=48))
    exposure_s = report.value("exposure_s")
    assert 0.002 < exposure_s < 1 / 30
    # The fake's automatic aims at a mean of 0.18; the lock keeps its light within a sixth, and quantised
    # exposures cost less than another percent.
    assert brightness(camera) == pytest.approx(0.18, rel=0.2)
    assert control(report, "exposure_s").requested is None
    assert device(kernel, v4l2.CID_EXPOSURE_AUTO) == v4l2.EXPOSURE_MANUAL
    before = [device(kernel, one) for one in (v4l2.CID_EXPOSURE_ABSOLUTE, v4l2.CID_GAIN)]
    for _ in range(40):
        camera.read(1.0)
    assert [device(kernel, one) for one in (v4l2.CID_EXPOSURE_ABSOLUTE, v4l2.CID_GAIN)] == before


def test_a_driver_that_answers_from_memory_is_corrected_by_the_light(make):
    camera, _ = make("profile=stale-cache")
    report = camera.lock(CameraProfile(width=64, height=48))
    assert brightness(camera) == pytest.approx(0.18, rel=0.2)  # as above
    assert "matched to the light" in control(report, "exposure_s").note
    assert not report.warnings


@pytest.mark.parametrize("mains_hz", [50, 60])
def test_a_found_exposure_is_a_multiple_of_the_mains_half_period(make, mains_hz):
    camera, kernel = make("profile=plain")
    report = camera.lock(CameraProfile(width=64, height=48, mains_hz=mains_hz))
    periods = report.value("exposure_s") * 2 * mains_hz
    assert periods == pytest.approx(round(periods), abs=0.01)  # steps of 100 us in a period of 8.33 ms
    assert report.value("mains_hz") == mains_hz
    assert device(kernel, v4l2.CID_POWER_LINE_FREQUENCY) == {50: 1, 60: 2}[mains_hz]


def test_exposures_without_banding():
    assert without_banding(0.024, 50) == 0.02
    assert without_banding(0.01, 50) == 0.01
    assert without_banding(0.004, 50) == 0.004  # shorter than one period: nothing helps
    assert without_banding(0.024, None) == 0.024


def test_a_second_lock_sets_only_what_is_different(make):
    camera, kernel = make("profile=plain")
    camera.lock(PROFILE)
    sequence = camera.read(1.0).sequence
    written = []
    original = kernel.controls.set
    kernel.controls.set = lambda identity, value, frame: (
        written.append(identity) or original(identity, value, frame)
    )
    report = camera.lock(PROFILE)
    assert written == []
    assert control(report, "exposure_s").verified is True
    camera.lock(CameraProfile(width=64, height=48, exposure_s=0.01, gain=60, white_balance_k=4000, focus=30))
    assert set(written) == {v4l2.CID_GAIN}
    assert camera.read(1.0).sequence > sequence  # the stream went on


def test_another_format_restarts_the_stream(make):
    camera, _ = make("profile=plain")
    camera.lock(PROFILE)
    camera.lock(CameraProfile(width=64, height=48, pixel_format="MJPG", exposure_s=0.01))
    assert camera.format.pixel_format == "MJPG"
    assert decode_rgb(camera.read(1.0).data, camera.format).shape == (48, 64, 3)


@pytest.mark.parametrize("description", ["plain", "new-kernel", "forgets-manual"])
def test_everything_is_put_back_as_it_was(make, description):
    camera, kernel = make(f"profile={description}")
    found = dict(kernel.controls._cache)
    camera.lock(PROFILE)
    assert camera.restore() == ()
    held_by_automatics = {
        v4l2.CID_EXPOSURE_ABSOLUTE,
        v4l2.CID_WHITE_BALANCE_TEMPERATURE,
        v4l2.CID_FOCUS_ABSOLUTE,
        v4l2.CID_GAIN,
    }
    for identity, value in found.items():
        if identity not in held_by_automatics:
            assert kernel.controls._cache[identity] == value, kernel.controls.specs[identity].name
    for _ in range(5):  # the control latency
        camera.read(1.0)
    assert device(kernel, v4l2.CID_EXPOSURE_AUTO) == v4l2.EXPOSURE_APERTURE_PRIORITY
    assert device(kernel, v4l2.CID_AUTO_WHITE_BALANCE) == 1


def test_a_manual_exposure_is_put_back_too(make):
    camera, kernel = make("profile=new-kernel")
    for identity, value in [(v4l2.CID_EXPOSURE_AUTO, 1), (v4l2.CID_EXPOSURE_ABSOLUTE, 77)]:
        kernel.controls.set(identity, value, 0)
    camera.lock(PROFILE)
    assert camera.restore() == ()
    assert kernel.controls.get(v4l2.CID_EXPOSURE_ABSOLUTE) == 77
    assert kernel.controls.get(v4l2.CID_EXPOSURE_AUTO) == 1


def test_another_program_that_meddles_is_found_by_check(make):
    camera, _ = make("profile=meddler")
    camera.lock(PROFILE)
    assert camera.check() == ()
    while camera.read(1.0).sequence < 305:
        pass
    (drifted,) = camera.check()
    assert drifted.name == "exposure_s"
    assert drifted.read_back == 0.03
    assert drifted.note == "changed from 0.01 to 0.03 behind our back"


def test_a_change_that_was_taken_back_is_found_by_its_event(make):
    camera, kernel = make("profile=plain")
    camera.lock(PROFILE)
    kernel._meddle()
    kernel.controls.meddle(v4l2.CID_EXPOSURE_ABSOLUTE, 100)
    (drifted,) = camera.check()
    assert drifted.note == "was changed to 0.03 and back"
    assert camera.check() == ()


def test_an_unplugged_camera_says_so_and_can_be_closed(make):
    camera, _ = make("profile=unplugged")
    camera.lock(PROFILE)
    with pytest.raises(CameraGoneError, match="not there any more"):
        read_on(camera)
    with pytest.raises(CameraGoneError):
        camera.check()
    (said,) = camera.restore()
    assert "could not be put back" in said
    camera.close()
    camera.close()


def test_a_stream_that_the_driver_gives_up_is_an_error_that_says_what_to_do(make):
    camera, _ = make("profile=broken")
    camera.lock(PROFILE)
    with pytest.raises(
        CameraError, match=r"link to the camera has failed \(EIO\); plug it in again"
    ) as failed:
        read_on(camera)
    assert not isinstance(failed.value, CameraGoneError)


def test_a_camera_that_is_unplugged_during_the_lock_ends_the_lock(make):
    for frame in (1, 10, 30, 60, 80):
        camera, _ = make(f"profile=plain;unplugged_at={frame}")
        with pytest.raises(CameraGoneError):
            camera.lock(PROFILE)
        camera.close()


def test_a_camera_whose_stream_does_not_start_twice_is_an_error(make):
    camera, _ = make("profile=plain;fails_to_start=1")
    camera.lock(PROFILE)
    camera.close()
    camera, _ = make("profile=plain;fails_to_start=9")
    with pytest.raises(CameraError, match="cannot start to stream"):
        camera.lock(PROFILE)


def test_no_bandwidth_takes_a_lesser_mode_and_says_so():
    camera = open_camera("profile=no-bandwidth", Bench(VirtualClock()))
    with camera:
        report = camera.lock(CameraProfile(exposure_s=0.01))
        assert camera.format.pixel_format == "MJPG"
        assert any("no bandwidth for 1280 x 720 YUYV" in warning for warning in report.warnings)
    camera = open_camera("profile=no-bandwidth", Bench(VirtualClock()))
    with camera, pytest.raises(CameraError, match="no bandwidth"):
        camera.lock(CameraProfile(width=1280, height=720, pixel_format="YUYV"))


def test_automatic_priority_slows_the_camera_down_until_it_is_locked(make):
    camera, kernel = make("profile=c920")
    # Dark: a small gain and a room at a tenth of its light would need 100 ms.
    kernel.controls.device[v4l2.CID_GAIN] = 0.0
    camera.lock(PROFILE)
    stamps = [camera.read(1.0).stamp_s for _ in range(10)]
    assert (stamps[-1] - stamps[0]) / 9 == pytest.approx(1 / 30, rel=1e-3)


def test_an_exposure_beyond_the_frame_interval_is_warned_of(make):
    camera, _ = make("profile=plain")
    report = camera.lock(CameraProfile(width=64, height=48, fps=30, exposure_s=0.1, gain=0))
    assert any("longer than the 0.03333 s" in warning for warning in report.warnings)


def test_a_camera_that_gives_no_frames_times_out(make):
    camera, kernel = make("profile=plain")
    camera.lock(PROFILE)
    kernel._queued.clear()
    kernel._done.clear()
    clock = kernel._bench.clock
    before_s = clock.now_s()
    with pytest.raises(CameraTimeoutError, match=r"no frame within 0.7 s"):
        camera.read(0.7)
    assert clock.now_s() - before_s == pytest.approx(0.7, abs=0.002)  # and one pause


class Mute:
    """A kernel whose driver takes values and tells none."""

    def __init__(self, kernel):
        self._kernel = kernel

    def __getattr__(self, name):
        return getattr(self._kernel, name)

    def ioctl(self, descriptor, request, argument):
        if request == v4l2.G_EXT_CTRLS:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        self._kernel.ioctl(descriptor, request, argument)


@pytest.mark.parametrize("exposure_s", [0.01, None])
def test_a_driver_that_tells_no_values_is_locked_by_the_light(exposure_s):
    quirks, _ = parse("width=64;height=48")
    bench = Bench(VirtualClock())
    kernel = FakeKernel(quirks, bench)
    with V4l2Camera(Mute(kernel), FAKE_PATH, "fake-v4l2:", "fake-v4l2", bench.clock) as camera:
        report = camera.lock(CameraProfile(width=64, height=48, exposure_s=exposure_s))
        exposure = control(report, "exposure_s")
        assert exposure.read_back is None
        assert exposure.verified is True
        assert "does not tell" in exposure.note
        assert device(kernel, v4l2.CID_EXPOSURE_AUTO) == v4l2.EXPOSURE_MANUAL
        if exposure_s is None:
            assert brightness(camera) == pytest.approx(0.18, rel=0.2)  # the automatic's
        else:
            assert device(kernel, v4l2.CID_EXPOSURE_ABSOLUTE) == 100
        assert camera.check() == ()
