"""A camera whose controls go over USB: the order of a lock, what it reports, and what goes wrong in words."""

import errno
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fake_usb import (
    CAMERA_TERMINAL,
    PROCESSING_UNIT,
    FakeCamera,
    FakeControl,
    FakeUsb,
    SeeingStream,
    video_control,
)

from capture.devices import uvc
from capture.devices.bench import Bench, VirtualClock
from capture.devices.camera import CameraDevice, CameraProfile
from capture.devices.uvc.camera import UvcCamera
from capture.devices.uvc.requests import Limits
from capture.errors import CameraError, CameraGoneError

CT, PU = CAMERA_TERMINAL, PROCESSING_UNIT
PROFILE = CameraProfile(
    exposure_s=0.005, gain=20, white_balance_k=5000, focus=0, mains_hz=50, fps=30, settle_frames=3
)


@pytest.fixture
def camera() -> FakeCamera:
    return FakeCamera()


@pytest.fixture
def opened(camera: FakeCamera, monkeypatch: pytest.MonkeyPatch) -> Iterator[UvcCamera]:
    with open_fake(camera, monkeypatch) as device:
        yield device


def open_fake(
    camera: FakeCamera, monkeypatch: pytest.MonkeyPatch, rest: str = "046d:082d;stream=wall:", **stream: Any
) -> UvcCamera:
    bench = Bench(VirtualClock())

    def open_wall(url: str, bench: Bench) -> CameraDevice:
        return SeeingStream(bench, camera, **stream)

    monkeypatch.setattr("capture.devices.table.open_camera", open_wall)
    return uvc.open_uvc(rest, bench, FakeUsb([camera]), "linux")


def values(camera: FakeCamera) -> dict[tuple[int, int], int]:
    return {place: control.cur for place, control in camera.controls.items()}


def test_a_lock_sets_what_was_asked_and_reads_it_back(opened: UvcCamera, camera: FakeCamera) -> None:
    report = opened.lock(PROFILE)
    assert camera.cur(CT, 0x04) == 50
    assert camera.cur(PU, 0x04) == 20
    for name in ("exposure_s", "gain", "white_balance_k", "focus", "mains_hz", "fps"):
        control = next(control for control in report.controls if control.name == name)
        assert control.read_back == getattr(PROFILE, name), name
        assert name == "exposure_s" or control.note == ""
    assert report.warnings == ()


def test_the_light_confirms_the_exposure(opened: UvcCamera, camera: FakeCamera) -> None:
    report = opened.lock(PROFILE)
    assert [control.name for control in report.controls if control.verified is not None] == ["exposure_s"]
    assert next(control for control in report.controls if control.name == "exposure_s").verified
    assert camera.cur(CT, 0x04) == 50
    camera.writes.clear()
    again = opened.lock(PROFILE)
    assert next(control for control in again.controls if control.name == "exposure_s").verified
    assert camera.writes == [], "an exposure that is verified and stays is not tried again"


def test_the_stream_of_another_camera_is_found_out_by_the_light(
    camera: FakeCamera, monkeypatch: pytest.MonkeyPatch
) -> None:
    device = open_fake(camera, monkeypatch)
    device._stream = SeeingStream(Bench(VirtualClock()), None)  # nothing here changes its light
    report = device.lock(PROFILE)
    assert next(control for control in report.controls if control.name == "exposure_s").verified is False
    assert any("is this very camera" in warning for warning in report.warnings)
    assert camera.cur(CT, 0x04) == 50


def test_every_automatic_is_off_before_a_value_is_set(opened: UvcCamera, camera: FakeCamera) -> None:
    opened.lock(PROFILE)
    order = [(unit, selector) for unit, selector, _ in camera.writes]
    assert order[0] == (0, 0), "the stream starts before anything is set"
    for automatic, value in [((CT, 2), (CT, 4)), ((PU, 0x0B), (PU, 0x0A)), ((CT, 8), (CT, 6))]:
        assert order.index(automatic) < order.index(value)
    assert camera.cur(CT, 0x02) == 1
    assert [camera.cur(*place) for place in ((CT, 3), (CT, 8), (PU, 0x0B))] == [0, 0, 0]


def test_without_a_wish_what_the_automatics_found_stays(opened: UvcCamera, camera: FakeCamera) -> None:
    report = opened.lock(CameraProfile(settle_frames=0))
    assert report.value("exposure_s") == pytest.approx(0.0333)
    assert (report.value("white_balance_k"), report.value("focus")) == (4600, 30)
    assert next(control for control in report.controls if control.name == "exposure_s").requested is None


def test_what_shapes_the_tones_is_neutralised_and_the_rest_is_recorded(
    opened: UvcCamera, camera: FakeCamera
) -> None:
    camera.controls[PU, 0x03].cur = 200  # left by another program
    report = opened.lock(PROFILE)
    neutral = {
        "backlight_compensation": 0,
        "sharpness": 0,
        "brightness": 0,
        "contrast": 128,
        "saturation": 128,
    }
    assert {name: report.value(name) for name in neutral} == neutral
    assert (camera.cur(PU, 0x01), camera.cur(PU, 0x03)) == (0, 128)
    recorded = {control.name: control.read_back for control in report.controls if control.requested is None}
    assert recorded == {"zoom_absolute": 100, "pan_absolute": 0, "tilt_absolute": 0}


def test_a_value_out_of_range_is_clamped_before_it_is_sent_and_said(
    opened: UvcCamera, camera: FakeCamera
) -> None:
    report = opened.lock(CameraProfile(exposure_s=1.0, gain=999, focus=33, settle_frames=0))
    assert camera.cur(CT, 0x04) == 2047
    exposure = next(control for control in report.controls if control.name == "exposure_s")
    assert exposure.read_back == pytest.approx(0.2047)
    assert "takes 3..2047" in exposure.note
    assert report.value("gain") == 255
    assert report.value("focus") == 35  # steps of 5
    assert any("gain: asked for 999" in warning for warning in report.warnings)
    assert any("longer than the 0.03333 s" in warning for warning in report.warnings)


def test_a_camera_that_clamps_by_itself_is_found_out_by_the_read_back(
    opened: UvcCamera, camera: FakeCamera
) -> None:
    camera.controls[PU, 0x04] = FakeControl(2, 64, 0, 15, clamps=True)
    opened._controls._controls._limits["gain"] = Limits(0, 255, 1, 0)  # it said 255
    report = opened.lock(CameraProfile(gain=200, settle_frames=0))
    gain = next(control for control in report.controls if control.name == "gain")
    assert (gain.read_back, gain.note) == (15, "set to 200, but the camera says 15")


def test_manual_mode_is_reached_by_way_of_automatic(
    camera: FakeCamera, monkeypatch: pytest.MonkeyPatch
) -> None:
    camera.controls[CT, 0x02].cur = 1  # it says manual, and forgets it as the stream starts
    device = open_fake(camera, monkeypatch, forgets=True)
    device.lock(PROFILE)
    for _ in range(3):
        frame = device.read(1.0)
    # 5 ms on a wall that clips at 50 ms is a tenth: sRGB code 89 by IEC 61966-2-1.
    assert frame.data[0, 0, 0] == 89  # type: ignore[call-overload]


def test_a_second_lock_sets_only_what_is_different(opened: UvcCamera, camera: FakeCamera) -> None:
    opened.lock(PROFILE)
    camera.writes.clear()
    opened.lock(CameraProfile(**{**vars(PROFILE), "gain": 21}))
    assert [write for write in camera.writes if write[0]] == [(PU, 0x04, b"\x15\x00")]


def test_a_control_that_is_announced_but_refused_is_missing_and_not_fatal(
    camera: FakeCamera, monkeypatch: pytest.MonkeyPatch
) -> None:
    camera.refusals = {(PU, 0x04)}
    device = open_fake(camera, monkeypatch)
    assert device.info.details["announced_but_refused"] == ["gain"]
    report = device.lock(PROFILE)
    gain = next(control for control in report.controls if control.name == "gain")
    assert (gain.read_back, gain.note) == (None, "the camera has no such control")


def test_a_camera_without_exposure_control_says_so(
    camera: FakeCamera, monkeypatch: pytest.MonkeyPatch
) -> None:
    camera.specific = video_control(camera_controls=0x027A20)  # as an Insta360 Link announces
    report = open_fake(camera, monkeypatch).lock(CameraProfile(settle_frames=0))
    assert any("has no exposure time" in warning for warning in report.warnings)


def test_a_refusal_is_reported_with_the_cameras_own_reason(opened: UvcCamera, camera: FakeCamera) -> None:
    camera.controls[PU, 0x04].follows = (PU, 0x05)  # an automatic gain that nothing turns off
    camera.controls[PU, 0x04].automatic_values = (0, 1, 2)
    report = opened.lock(PROFILE)
    gain = next(control for control in report.controls if control.name == "gain")
    assert gain.read_back is None
    assert "an automatic has it" in gain.note
    assert "not in its present state" in gain.note


def test_an_exposure_that_is_refused_while_the_light_is_asked_is_no_failure(
    opened: UvcCamera, camera: FakeCamera
) -> None:
    camera.controls[CT, 0x04].low = 40  # though it said 3: the half of 5 ms is refused
    opened._controls._controls._limits["exposure_time_absolute"] = Limits(3, 2047, 1, 250)
    report = opened.lock(PROFILE)
    exposure = next(control for control in report.controls if control.name == "exposure_s")
    assert (exposure.read_back, camera.cur(CT, 0x04)) == (0.005, 50)
    assert exposure.verified  # from 10 ms to 5


def test_a_shut_shutter_is_said(camera: FakeCamera, monkeypatch: pytest.MonkeyPatch) -> None:
    camera.specific = video_control(camera_controls=0x060A2E)
    camera.controls[CT, 0x11] = FakeControl(1, 1)
    report = open_fake(camera, monkeypatch).lock(PROFILE)
    assert "The shutter of the USB camera 046d:082d is shut; open it." in report.warnings


def test_check_finds_what_another_program_changed(opened: UvcCamera, camera: FakeCamera) -> None:
    opened.lock(PROFILE)
    assert opened.check() == ()
    camera.controls[CT, 0x02].cur = 8
    camera.controls[CT, 0x04].cur = 333
    changed = {control.name: control for control in opened.check()}
    assert set(changed) == {"auto_exposure_mode", "exposure_s"}
    assert (changed["exposure_s"].requested, changed["exposure_s"].read_back) == (0.005, 0.0333)


def test_restore_puts_everything_back_and_leaves_what_an_automatic_has(
    opened: UvcCamera, camera: FakeCamera
) -> None:
    found = values(camera)
    opened.lock(PROFILE)
    assert opened.restore() == ()
    now = values(camera)
    governed = {(CT, 0x04), (CT, 0x06), (PU, 0x0A)}
    assert {place: now[place] for place in now if place not in governed} == {
        place: found[place] for place in found if place not in governed
    }
    camera.writes.clear()
    assert opened.restore() == ()
    assert camera.writes == []


def test_restore_without_a_lock_changes_nothing(opened: UvcCamera, camera: FakeCamera) -> None:
    assert opened.restore() == ()
    assert camera.writes == []


def test_opening_changes_nothing(opened: UvcCamera, camera: FakeCamera) -> None:
    assert camera.writes == []
    assert opened.info.name == "HD Pro Webcam C920"
    assert opened.info.details["serial"] == "5D3A9F2E"


def test_unplugged_is_gone_and_close_goes_through(opened: UvcCamera, camera: FakeCamera) -> None:
    opened.lock(PROFILE)
    camera.unplugged = True
    with pytest.raises(CameraGoneError):
        opened.read(1.0)
    with pytest.raises(CameraGoneError, match="plug it in again"):
        opened.check()
    (problem,) = opened.restore()
    assert "not there any more" in problem
    opened.close()
    opened.close()
    assert camera.opened == 0


def test_everything_is_given_back_at_the_end(camera: FakeCamera, monkeypatch: pytest.MonkeyPatch) -> None:
    with open_fake(camera, monkeypatch):
        assert camera.claimed
    assert (camera.claimed, camera.opened) == (False, 0)


@pytest.mark.parametrize(
    ("number", "platform", "sentence"),
    [
        (errno.EACCES, "linux", "udev rule"),
        (errno.EACCES, "darwin", "use opencv:"),
        (errno.ENOSYS, "win32", "Zadig"),
        (errno.ENODEV, "linux", "plug it in again"),
        (errno.EIO, "linux", "check its cable"),
    ],
)
def test_why_a_camera_cannot_be_opened_is_said(
    camera: FakeCamera, number: int, platform: str, sentence: str
) -> None:
    camera.open_errno = number
    with pytest.raises(CameraError, match=sentence):
        uvc.open_uvc("046d:082d;stream=wall:", Bench(), FakeUsb([camera]), platform)


def test_a_camera_that_the_kernel_has_is_sent_to_v4l2(camera: FakeCamera) -> None:
    camera.claim_errno = errno.EBUSY
    with pytest.raises(CameraError, match=r"uvcvideo.*v4l2:/dev/videoN"):
        uvc.open_uvc("046d:082d;stream=wall:", Bench(), FakeUsb([camera]), "linux")
    assert camera.opened == 0


def test_nothing_is_claimed_on_macos(camera: FakeCamera, monkeypatch: pytest.MonkeyPatch) -> None:
    camera.claim_errno = errno.EACCES
    monkeypatch.setattr("capture.devices.table.open_camera", lambda url, bench: SeeingStream(bench, camera))
    with uvc.open_uvc("046d:082d", Bench(VirtualClock()), FakeUsb([camera]), "darwin") as device:
        device.lock(PROFILE)
    assert camera.cur(CT, 0x04) == 50


def test_on_linux_a_source_of_pictures_must_be_named(camera: FakeCamera) -> None:
    with pytest.raises(CameraError, match=r"no pictures.*modprobe uvcvideo"):
        uvc.open_uvc("046d:082d", Bench(), FakeUsb([camera]), "linux")
    assert camera.opened == 0


@pytest.mark.parametrize(
    ("rest", "sentence"),
    [
        ("046d", "uvc:VID:PID"),
        ("1234:5678;stream=wall:", "plugged in: uvc:046d:082d"),
        ("046d:082d;serial=NONE;stream=wall:", "No camera fits"),
        ("046d:082d;gain=3", "not understood"),
        ("046d:082d;stream=uvc:046d:082d", "no source of pictures"),
    ],
)
def test_urls_that_name_no_camera_are_refused(camera: FakeCamera, rest: str, sentence: str) -> None:
    with pytest.raises(CameraError, match=sentence):
        uvc.open_uvc(rest, Bench(), FakeUsb([camera]), "linux")


def test_two_of_a_kind_are_told_apart_by_their_serial_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = FakeCamera(), FakeCamera(strings=("HD Pro Webcam C920", "AB12"))
    bus = FakeUsb([first, second])
    assert uvc.list_uvc(bus) == ("uvc:046d:082d;serial=5D3A9F2E", "uvc:046d:082d;serial=AB12")
    with pytest.raises(CameraError, match="2 cameras fit"):
        uvc.open_uvc("046d:082d;stream=wall:", Bench(), bus, "linux")
    monkeypatch.setattr("capture.devices.table.open_camera", lambda url, bench: SeeingStream(bench))
    with uvc.open_uvc("046d:082d;serial=AB12;stream=wall:", Bench(), bus, "linux"):
        assert (first.opened, second.opened) == (0, 1)


def test_libusb_that_is_missing_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("usb.backend.libusb1.get_backend", lambda: None)
    with pytest.raises(CameraError, match=r"needs libusb 1\.0"):
        uvc.open_camera("046d:082d", Bench())


def test_without_libusb_nothing_is_listed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("usb.backend.libusb1.get_backend", lambda: None)
    monkeypatch.setattr(Path, "is_dir", lambda self: False)
    assert uvc.list_cameras() == ()
