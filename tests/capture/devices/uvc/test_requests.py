"""Requests for controls: where they go, what of the answers is believed, which values are sent."""

import pytest
from fake_usb import CAMERA_TERMINAL, PROCESSING_UNIT, FakeCamera, FakeControl, FakeUsb, video_control
from hypothesis import given
from hypothesis import strategies as st

from capture.devices.uvc.descriptors import parse_video_control
from capture.devices.uvc.requests import Limits, UvcControls
from capture.devices.uvc.usb_link import StalledError, UsbLink, find_cameras

CT, PU = CAMERA_TERMINAL, PROCESSING_UNIT


def controls_of(camera: FakeCamera) -> UvcControls:
    backend = FakeUsb([camera])
    (found,) = find_cameras(backend)
    link = UsbLink(backend, found)
    return UvcControls(link, parse_video_control(found.interface, found.specific))


def test_exposure_goes_to_the_camera_terminal_and_gain_to_the_processing_unit() -> None:
    camera = FakeCamera()
    camera.controls[CT, 0x02].cur = 1
    controls = controls_of(camera)
    controls.set("exposure_time_absolute", 50)
    controls.set("gain", 20)
    assert camera.writes == [(CT, 0x04, b"\x32\x00\x00\x00"), (PU, 0x04, b"\x14\x00")]


def test_a_half_of_a_control_is_set_with_the_other_half_as_it_is() -> None:
    camera = FakeCamera()
    pan, tilt = 3600, -7200
    camera.controls[CT, 0x0D].cur = pan | (tilt & 0xFFFFFFFF) << 32
    camera.controls[CT, 0x0D].low = None
    controls = controls_of(camera)
    assert (controls.get("pan_absolute"), controls.get("tilt_absolute")) == (pan, tilt)
    controls.set("pan_absolute", -3600)
    assert (controls.get("pan_absolute"), controls.get("tilt_absolute")) == (-3600, tilt)


def test_signed_values_are_signed() -> None:
    assert controls_of(FakeCamera()).get("brightness") == -5


def test_what_info_says_changes_with_the_automatic() -> None:
    camera = FakeCamera()
    controls = controls_of(camera)
    assert controls.state("exposure_time_absolute").disabled_by_auto
    camera.controls[CT, 0x02].cur = 1
    state = controls.state("exposure_time_absolute")
    assert (state.readable, state.settable, state.disabled_by_auto) == (True, True, False)


def test_what_is_not_announced_is_not_asked_for() -> None:
    camera = FakeCamera(specific=video_control(camera_controls=0x0A, processing_controls=0x0200))
    assert controls_of(camera).names == ["auto_exposure_mode", "exposure_time_absolute", "gain"]


def test_a_range_that_is_garbage_is_not_believed() -> None:
    camera = FakeCamera()
    camera.controls[PU, 0x04] = FakeControl(2, 64, low=10, high=0, step=1, default=0)
    assert controls_of(camera).limits("gain") == Limits(None, None, 1, 0)


def test_a_short_answer_is_a_refusal() -> None:
    camera = FakeCamera()
    camera.controls[CT, 0x04].size = 2
    controls = controls_of(camera)
    with pytest.raises(StalledError, match="with 2 bytes, not 4"):
        controls.get("exposure_time_absolute")


def test_a_refusal_carries_the_cameras_reason() -> None:
    with pytest.raises(StalledError, match="gain = 300: the value is out of range"):
        controls_of(FakeCamera()).set("gain", 300)


def test_a_value_that_its_bytes_cannot_hold_is_never_sent() -> None:
    camera = FakeCamera()
    with pytest.raises(ValueError, match=r"0\.\.65535"):
        controls_of(camera).set("gain", 70_000)
    assert camera.writes == []


ends = st.integers(-1000, 1000)


@given(value=st.floats(-1e6, 1e6), low=ends, width=st.integers(0, 2000), step=st.integers(0, 50))
def test_the_nearest_value_is_one_that_the_camera_takes(
    value: float, low: int, width: int, step: int
) -> None:
    chosen = Limits(low, low + width, step, low).nearest(value)
    assert low <= chosen <= low + width
    assert (chosen - low) % (step or 1) == 0
    inside = min(max(value, low), low + width)
    # Half a step by rounding; a whole one at the upper end, which need not be a step itself.
    assert abs(chosen - inside) <= (step or 1)


def test_without_limits_a_value_is_only_rounded() -> None:
    assert Limits().nearest(49.6) == 50
