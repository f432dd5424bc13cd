"""A camera through OpenCV: what it says is read back and asked of the light; times, gaps, hangs, ends."""

import threading
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from fake_opencv import LyingCapture

from capture.devices import opencv
from capture.devices.bench import Bench, VirtualClock
from capture.devices.camera import CameraProfile, ControlReport, LockReport
from capture.devices.opencv import OpenCvCamera
from capture.devices.table import open_camera
from capture.errors import CameraEndedError, CameraError, CameraGoneError, CameraTimeoutError
from capture.video import VideoWriter

PROFILE = CameraProfile(exposure_s=0.005, gain=20, white_balance_k=5000, focus=0, settle_frames=3)


@pytest.fixture
def bench() -> Bench:
    return Bench(VirtualClock())


@pytest.fixture
def capture(bench: Bench) -> LyingCapture:
    return LyingCapture(bench)


@pytest.fixture
def camera(capture: LyingCapture, bench: Bench) -> Iterator[OpenCvCamera]:
    with OpenCvCamera("opencv:0", capture, bench) as camera:
        yield camera


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight frames, 25 a second, red from dark to bright."""
    path = tmp_path_factory.mktemp("opencv") / "film.mp4"
    with VideoWriter(path, 64, 48, crf=1, matrix="bt601", rotation_deg=90) as writer:
        for index in range(8):
            writer.write(np.full((48, 64, 3), (25 * index + 40, 20, 20), np.uint8), index / 25)
    return path


def control(report: LockReport, name: str) -> ControlReport:
    return next(control for control in report.controls if control.name == name)


def test_a_lock_sets_reads_back_and_asks_the_light(camera: OpenCvCamera, capture: LyingCapture) -> None:
    report = camera.lock(PROFILE)
    for name in ("exposure_s", "gain", "white_balance_k", "focus"):
        assert control(report, name).read_back == pytest.approx(getattr(PROFILE, name)), name
    assert control(report, "exposure_s").verified
    assert report.warnings == ()
    assert capture.values[cv2.CAP_PROP_AUTO_EXPOSURE] == 1
    assert capture.values[cv2.CAP_PROP_EXPOSURE] == 50


def test_v4l2s_automatic_is_never_given_a_fraction(camera: OpenCvCamera, capture: LyingCapture) -> None:
    camera.lock(PROFILE)
    given = {value for prop, value in capture.settings if prop == cv2.CAP_PROP_AUTO_EXPOSURE}
    assert given <= {1, 3}  # OpenCV would round 0.25 to 0, which is automatic


def test_a_clamp_that_opencv_keeps_quiet_about_is_said(camera: OpenCvCamera) -> None:
    report = camera.lock(CameraProfile(gain=999, exposure_s=1.0, settle_frames=0))
    assert control(report, "gain").note == "set to 999, but OpenCV says 255"
    assert control(report, "exposure_s").read_back == pytest.approx(0.2047)
    assert any(warning.startswith("gain: set to 999") for warning in report.warnings)


def test_an_automatic_that_stays_on_is_found_out_by_the_light(
    camera: OpenCvCamera, capture: LyingCapture
) -> None:
    capture.deaf = {cv2.CAP_PROP_AUTO_EXPOSURE}
    report = camera.lock(PROFILE)
    exposure = control(report, "exposure_s")
    assert "cannot say that the automatic is off" in exposure.note
    assert exposure.verified is not True
    assert any(warning.startswith("exposure_s") for warning in report.warnings)


def test_a_camera_whose_exposure_only_pretends_is_found_out(bench: Bench) -> None:
    with OpenCvCamera("opencv:0", LyingCapture(bench, colour=(90, 90, 90)), bench) as camera:
        report = camera.lock(PROFILE)
    assert control(report, "exposure_s").read_back == 0.005
    assert control(report, "exposure_s").verified is False
    assert any("does not expose as it says" in warning for warning in report.warnings)


def test_without_a_wish_the_values_stay_as_the_automatics_left_them(
    camera: OpenCvCamera, capture: LyingCapture
) -> None:
    report = camera.lock(CameraProfile(settle_frames=0))
    assert control(report, "exposure_s").read_back == pytest.approx(0.0333)
    assert capture.values[cv2.CAP_PROP_AUTO_EXPOSURE] == 1
    assert capture.values[cv2.CAP_PROP_WB_TEMPERATURE] == 4600


def test_directshow_takes_whole_powers_of_two(bench: Bench) -> None:
    capture = LyingCapture(bench, "DSHOW")
    with OpenCvCamera("opencv:0", capture, bench) as camera:
        report = camera.lock(PROFILE)
        assert camera.info.stamp_at == "arrival"
    assert capture.values[cv2.CAP_PROP_EXPOSURE] == -8  # 1/256 s is nearer to 5 ms than 1/128 s, in stops
    assert control(report, "exposure_s").read_back == 1 / 256
    assert control(report, "exposure_s").verified
    assert "nearest that can be asked for is 0.00390625" in control(report, "exposure_s").note
    assert any("no time stamps through DSHOW" in warning for warning in report.warnings)


def test_media_foundation_is_not_believed_and_its_automatic_not_touched(bench: Bench) -> None:
    capture = LyingCapture(bench, "MSMF")
    with OpenCvCamera("opencv:0", capture, bench) as camera:
        report = camera.lock(PROFILE)
        assert cv2.CAP_PROP_AUTO_EXPOSURE not in [prop for prop, _ in capture.settings]
        assert capture.values[cv2.CAP_PROP_AUTO_EXPOSURE] == 0  # the exposure has switched it off
        exposure = control(report, "exposure_s")
        assert (exposure.read_back, exposure.verified) == (None, True)
        assert "does not tell through MSMF" in exposure.note
        (problem,) = camera.restore()
        assert "automatic exposure and focus are switched on" in problem
    assert capture.values[cv2.CAP_PROP_AUTO_EXPOSURE] == 1


def test_avfoundation_sets_nothing_and_says_so(bench: Bench) -> None:
    capture = LyingCapture(bench, "AVFOUNDATION")
    with OpenCvCamera("opencv:0", capture, bench) as camera:
        report = camera.lock(PROFILE)
        assert camera.info.clock == "own"
    exposure = control(report, "exposure_s")
    assert (exposure.read_back, exposure.verified) == (None, None)
    assert exposure.note == "OpenCV cannot set it through AVFOUNDATION"


def test_controls_are_left_alone_on_request(bench: Bench, capture: LyingCapture) -> None:
    with OpenCvCamera("opencv:0", capture, bench, set_controls=False) as camera:
        report = camera.lock(PROFILE)
        assert camera.check() == ()
        assert camera.restore() == ()
    assert [control.name for control in report.controls] == ["fps"]
    assert cv2.CAP_PROP_EXPOSURE not in [prop for prop, _ in capture.settings]


def test_restore_puts_back_what_was_found(camera: OpenCvCamera, capture: LyingCapture) -> None:
    found = dict(capture.values)
    assert camera.restore() == ()
    camera.lock(PROFILE)
    assert camera.restore() == ()
    kept = (cv2.CAP_PROP_AUTO_EXPOSURE, cv2.CAP_PROP_GAIN, cv2.CAP_PROP_AUTO_WB, cv2.CAP_PROP_AUTOFOCUS)
    assert {prop: capture.values[prop] for prop in kept} == {prop: found[prop] for prop in kept}


def test_check_finds_what_another_program_changed(camera: OpenCvCamera, capture: LyingCapture) -> None:
    camera.lock(PROFILE)
    assert camera.check() == ()
    capture.values[cv2.CAP_PROP_GAIN] = 99
    (changed,) = camera.check()
    assert (changed.name, changed.requested, changed.read_back) == ("gain", 20, 99)


def test_a_longer_time_between_two_stamps_is_a_gap(camera: OpenCvCamera, capture: LyingCapture) -> None:
    camera.lock(CameraProfile(settle_frames=8))
    first = camera.read(1.0).sequence
    number = capture._number
    capture.lost = {number + 2, number + 5, number + 6}
    sequence = [camera.read(1.0).sequence - first for _ in range(5)]
    assert sequence == [1, 3, 4, 7, 8]


def test_a_stamp_that_cannot_be_is_estimated_and_says_so(camera: OpenCvCamera, capture: LyingCapture) -> None:
    camera.lock(CameraProfile(settle_frames=8))
    capture.repeated = {capture._number + 2}
    frames = [camera.read(1.0) for _ in range(4)]
    assert [frame.stamp_estimated for frame in frames] == [False, True, False, False]
    # The wall's frames are evenly spaced: the estimate is exact but for milliseconds kept in doubles.
    assert np.diff([frame.stamp_s for frame in frames]) == pytest.approx([1 / 30] * 3, abs=1e-9)
    assert np.diff([frame.sequence for frame in frames]).tolist() == [1, 1, 1]


def test_stamps_of_v4l2_are_the_hosts(camera: OpenCvCamera, bench: Bench) -> None:
    camera.lock(CameraProfile(settle_frames=0))
    frame = camera.read(1.0)
    assert camera.info.clock == "monotonic"
    # Milliseconds in a double: sure to a nanosecond at these times.
    assert frame.stamp_s == pytest.approx(bench.clock.now_s(), abs=1e-9)


def test_colours_are_rgb(bench: Bench) -> None:
    with OpenCvCamera("opencv:0", LyingCapture(bench, colour=(10, 20, 200)), bench) as camera:
        camera.lock(CameraProfile(settle_frames=0))
        assert tuple(camera.read(1.0).data[0, 0]) == (200, 20, 10)  # type: ignore[call-overload]


def test_a_camera_that_hangs_is_a_timeout_and_the_frame_comes_later(
    camera: OpenCvCamera, capture: LyingCapture
) -> None:
    camera.lock(CameraProfile(settle_frames=0))
    before = camera.read(1.0)
    capture.hangs = threading.Event()
    with pytest.raises(CameraTimeoutError, match=r"no frame within 0\.05 s"):
        camera.read(0.05)
    assert camera.check() == ()
    capture.hangs.set()
    assert camera.read(10.0).sequence == before.sequence + 1


def test_an_unplugged_camera_is_gone_and_close_goes_through(
    camera: OpenCvCamera, capture: LyingCapture
) -> None:
    camera.lock(CameraProfile(settle_frames=0))
    capture.unplugged = True
    with pytest.raises(CameraGoneError, match="unplugged"):
        camera.read(1.0)
    assert not camera.ended
    camera.close()
    camera.close()
    assert capture.released
    with pytest.raises(CameraGoneError, match="is closed"):
        camera.read(1.0)


def test_it_streams_only_after_the_lock(camera: OpenCvCamera) -> None:
    with pytest.raises(CameraError, match="lock it first"):
        camera.read(1.0)
    with pytest.raises(CameraError, match="lock it first"):
        _ = camera.format


def test_another_size_than_asked_is_said(camera: OpenCvCamera) -> None:
    report = camera.lock(CameraProfile(width=1920, height=1080, fps=60, settle_frames=0))
    assert any("delivers 32 x 24" in warning for warning in report.warnings)
    assert (camera.format.width, camera.format.height) == (32, 24)


def test_opencv_itself_plays_a_file_as_a_camera(film: Path, bench: Bench) -> None:
    with open_camera(f"opencv:{film}", bench) as camera:
        report = camera.lock(PROFILE)
        assert camera.info.clock == "own"
        assert control(report, "exposure_s").note == "OpenCV cannot set it through FFMPEG"
        assert control(report, "fps").read_back == pytest.approx(25)
        frames = [camera.read(5.0) for _ in range(8)]
        with pytest.raises(CameraEndedError, match="has ended"):
            camera.read(5.0)
        assert camera.ended  # type: ignore[attr-defined]
    assert [frame.sequence for frame in frames] == list(range(8))
    assert [frame.stamp_s for frame in frames] == pytest.approx([index / 25 for index in range(8)], abs=1e-3)
    assert frames[0].data.shape == (48, 64, 3)  # as the sensor stands, not turned upright
    # Limited-range codes and the encoder's step at crf 1, in a colour of three planes.
    assert np.abs(frames[4].data.astype(int).mean(axis=(0, 1)) - (140, 20, 20)).max() < 4


@pytest.mark.parametrize(
    ("rest", "sentence"),
    [
        ("film", "names no camera"),
        ("0;controls=set", "it is leave"),
        ("0;backend=none", "not in this OpenCV"),
        ("0;fps=3", "known are"),
    ],
)
def test_urls_that_are_not_understood_are_refused(rest: str, sentence: str) -> None:
    with pytest.raises(CameraError, match=sentence):
        opencv.open_camera(rest, Bench())


def test_a_camera_that_is_not_there_is_said_in_one_sentence(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(CameraError, match="cannot open opencv:97"):
        opencv.open_camera("97", Bench())
    assert capfd.readouterr().err == ""


def test_the_numbers_that_open_are_listed(monkeypatch: pytest.MonkeyPatch, bench: Bench) -> None:
    monkeypatch.setattr("sys.platform", "darwin")
    captures = [LyingCapture(bench), LyingCapture(bench), LyingCapture(bench)]
    captures[2].released = True
    monkeypatch.setattr(opencv, "_open", lambda target, backend, url: captures[target])
    assert opencv.list_cameras() == ("opencv:0", "opencv:1")
    assert all(capture.released for capture in captures)
