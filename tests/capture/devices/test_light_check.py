"""The light's verdict on an exposure control, with cameras of a few lines."""

import numpy as np
import pytest

from capture.devices.camera import CapturedFrame, StreamFormat
from capture.devices.light_check import (
    LATENCY_FRAMES,
    linear_luma,
    mean_light,
    skip_latency,
    verify_exposure,
)
from capture.errors import CameraError
from capture.transfer import to_display

FORMAT = StreamFormat(width=16, height=12, pixel_format="RGB3", fps=30)


class Scene:
    """A wedge of greys, exposed."""

    def __init__(self, tone=lambda linear: linear, room=lambda frame: 1.0, low=0.0, high=1.0):
        self.exposure_s = 0.01
        self.frame = 0
        self.asked = []
        self.low, self.high, self.tone, self.room = low, high, tone, room

    def set(self, exposure_s):
        self.asked.append(exposure_s)
        self.exposure_s = min(max(exposure_s, self.low), self.high)
        return self.exposure_s

    def light(self):
        wedge = np.linspace(0.05, 0.5, 16) * self.exposure_s / 0.01 * self.room(self.frame)
        return np.clip(np.tile(wedge[None, :, None], (12, 1, 3)), 0, 1)

    def read(self):
        self.frame += 1
        rgb = np.rint(255 * to_display(self.tone(self.light()))).astype(np.uint8)
        stamp_s = self.frame / 30
        return CapturedFrame(stamp_s=stamp_s, sequence=self.frame, data=rgb, arrival_s=stamp_s + 0.01)

    def verify(self):
        return verify_exposure(self.read, lambda: FORMAT, self.set, self.exposure_s)


def test_a_camera_that_obeys_is_verified_and_left_as_it_was():
    scene = Scene()
    check = scene.verify()
    assert check.verified is True
    assert check.expected == 0.5
    assert check.measured == pytest.approx(0.5, abs=0.01)  # codes of 8 bits, half a percent of light each
    assert scene.exposure_s == 0.01


@pytest.mark.parametrize("gamma", [0.7, 0.8, 1.25, 1.5])
def test_a_tone_curve_that_is_not_quite_the_named_one_is_no_failure(gamma):
    assert Scene(tone=lambda linear: linear**gamma).verify().verified is True


def test_a_camera_that_takes_no_notice_fails():
    scene = Scene()
    scene.light = lambda: np.full((12, 16, 3), 0.3)
    assert scene.verify().verified is False


def test_an_exposure_that_makes_it_brighter_fails():
    scene = Scene()
    scene.light = lambda: np.full((12, 16, 3), 0.2 if scene.exposure_s >= 0.01 else 0.5)
    assert scene.verify().verified is False


def test_an_automatic_that_fills_up_what_was_taken_fails():
    scene = Scene()
    gain = {"value": 1.0}

    def light():
        level = 0.3 * scene.exposure_s / 0.01 * gain["value"]
        gain["value"] *= (0.3 / level) ** 0.05  # a time constant of 20 frames
        return np.full((12, 16, 3), min(level, 1.0))

    scene.light = light
    check = scene.verify()
    assert check.verified is False
    assert "automatic" in check.note


def test_light_that_changes_by_itself_is_no_verdict():
    check = Scene(room=lambda frame: 1.0 if frame < 56 else 1.3).verify()  # a cloud goes
    assert check.verified is None
    assert "by itself" in check.note


@pytest.mark.parametrize("level", [1e-4, 1e4])
def test_darkness_and_glare_are_no_verdict(level):
    check = Scene(room=lambda frame: level).verify()
    assert check.verified is None
    assert check.measured is None


def test_glare_at_this_exposure_is_tried_at_a_shorter_one():
    check = Scene(room=lambda frame: 4.0).verify()
    assert check.verified is True


def test_a_shortest_exposure_that_cannot_be_halved_is_tried_doubled():
    scene = Scene(low=0.01)
    assert scene.verify().verified is True
    assert max(scene.asked) == 0.02


def test_an_exposure_that_cannot_be_changed_is_no_verdict():
    check = Scene(low=0.01, high=0.01).verify()
    assert check.verified is None
    assert "does not take" in check.note


def test_the_exposure_is_set_back_when_the_camera_fails():
    scene = Scene()

    def read():
        if scene.frame > 20:
            raise CameraError("it fails")
        return Scene.read(scene)

    with pytest.raises(CameraError, match="it fails"):
        verify_exposure(read, lambda: FORMAT, scene.set, 0.01)
    assert scene.exposure_s == 0.01


def test_frames_that_waited_in_buffers_are_not_taken_for_new_ones():
    """Eight old frames come at once, then new ones at their rate."""
    count = 0

    def read():
        nonlocal count
        count += 1
        arrival_s = 1.0 + 0.001 * count if count <= 8 else 1.0 + count / 30
        return CapturedFrame(stamp_s=count / 30, sequence=count, data=b"", arrival_s=arrival_s)

    skip_latency(read)
    assert count - 8 >= LATENCY_FRAMES - 1
    count = 100  # nothing waits: not more than is needed
    skip_latency(read)
    assert count == 100 + LATENCY_FRAMES


def test_limited_range_luma_is_linear_light():
    format = StreamFormat(width=16, height=12, pixel_format="GREY", fps=None)
    frame = CapturedFrame(stamp_s=0.0, sequence=0, data=bytes([188]) * 192, arrival_s=0.0)
    assert linear_luma(frame, format) == pytest.approx(0.5, abs=0.005)  # sRGB 188 = 0.503
    yuyv = StreamFormat(width=16, height=12, pixel_format="YUYV", fps=None)
    frame = CapturedFrame(stamp_s=0.0, sequence=0, data=bytes([235, 128]) * 192, arrival_s=0.0)
    assert linear_luma(frame, yuyv) == pytest.approx(1.0)


def test_damaged_frames_are_left_out_of_the_mean_and_only_damaged_ones_are_an_error():
    scene = Scene()

    def every_other():
        frame = scene.read()
        half = frame.data[:3] if frame.sequence % 2 else frame.data
        return CapturedFrame(stamp_s=0, sequence=0, data=half, arrival_s=0)

    assert mean_light(every_other, lambda: FORMAT).mean() == pytest.approx(0.275, abs=0.01)
    nothing = CapturedFrame(stamp_s=0, sequence=0, data=b"", arrival_s=0, damaged=True)
    with pytest.raises(CameraError, match="only 0 were whole"):
        mean_light(lambda: nothing, lambda: FORMAT)
