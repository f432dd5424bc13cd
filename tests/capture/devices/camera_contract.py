"""What every camera back end must do: subclass `CameraContract` and give it a camera.

class TestMyCamera(CameraContract):
    profile = CameraProfile(width=160, height=120, exposure_s=0.005)

    @pytest.fixture
    def device(self):
        camera = open_camera("my:...", Bench(VirtualClock()))
        yield camera
        camera.close()
"""

import json
from contextlib import suppress
from itertools import pairwise
from statistics import median

import cv2
import numpy as np
import pytest

from capture.devices.camera import CameraProfile
from capture.devices.pixel_formats import FrameDataError, decode_rgb, picture_file, small_planes
from capture.errors import CameraError, CameraTimeoutError

STAMPS = {"start of exposure", "end of frame", "arrival", "unknown"}


class CameraContract:
    """Tests of one back end.

    Attributes:
        profile: That the camera can be locked to.
        frames: How many may be read after a lock, at least.
        has_exposure: It has an exposure control.
        verified_by_light: Its lock asks the light whether the exposure is obeyed.
        needs_lock: It gives no frames before it is locked.
        steady_rate: Frames come at the rate that it promises.
        loses_frames: Gaps in the sequence are expected.
        damages_frames: Damaged frames are expected.
        drifts: `check` may find something.
        timeout_s: In which a frame must come.
    """

    profile = CameraProfile()
    frames = 30
    has_exposure = True
    verified_by_light = True
    needs_lock = True
    steady_rate = True
    loses_frames = False
    damages_frames = False
    drifts = False
    timeout_s = 5.0

    @pytest.fixture
    def device(self):
        """An open camera, not locked."""
        raise NotImplementedError

    @pytest.fixture
    def locked(self, device):
        device.lock(self.profile)
        return device

    def read(self, camera, count):
        return [camera.read(self.timeout_s) for _ in range(count)]

    def test_it_says_who_it_is_in_plain_values(self, device):
        info = device.info
        assert info.url
        assert info.name
        assert info.back_end
        assert info.clock in ("monotonic", "own")
        assert info.stamp_at in STAMPS
        assert json.loads(json.dumps(dict(info.details))) == dict(info.details)

    def test_it_gives_no_frames_before_it_is_locked(self, device):
        if not self.needs_lock:
            pytest.skip("this camera streams from the start")
        with pytest.raises(CameraError):
            device.read(0.1)

    def test_a_lock_reports_every_control_in_plain_values(self, device):
        report = device.lock(self.profile)
        names = [control.name for control in report.controls]
        assert len(names) == len(set(names))
        for control in report.controls:
            assert json.loads(json.dumps(control.to_json()))["name"] == control.name
        assert all(isinstance(warning, str) and warning for warning in report.warnings)
        for name in ("exposure_s", "gain", "white_balance_k", "focus"):
            asked = getattr(self.profile, name)
            control = next((one for one in report.controls if one.name == name), None)
            if asked is not None and (control is None or control.read_back != pytest.approx(asked)):
                # Whatever is not as asked is said in words, in a note or a warning.
                assert (control is not None and control.note) or any(name in one for one in report.warnings)
        if self.has_exposure and self.profile.exposure_s is not None:
            assert report.value("exposure_s") is not None

    def test_the_frames_are_pictures_of_the_format(self, locked):
        format = locked.format
        assert format.width > 0
        assert format.height > 0
        sound = 0
        for frame in self.read(locked, min(12, self.frames)):
            try:
                picture = decode_rgb(frame.data, format)
            except FrameDataError:
                assert self.damages_frames
                continue
            sound += not frame.damaged
            assert picture.shape == (format.height, format.width, 3)
            assert picture.dtype in (np.uint8, np.uint16)
            file, suffix = picture_file(frame.data, format)
            assert suffix in (".jpg", ".png")
            assert cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_UNCHANGED).shape[:2] == (
                format.height,
                format.width,
            )
            small, _ = small_planes(frame.data, format)
            assert small.shape[0] <= format.height
        assert sound > 0

    def test_frames_come_in_order_and_lost_ones_are_counted(self, locked):
        frames = self.read(locked, self.frames)
        stamps = np.array([frame.stamp_s for frame in frames])
        sequence = np.array([frame.sequence for frame in frames])
        arrivals = np.array([frame.arrival_s for frame in frames])
        assert (np.diff(stamps) > 0).all()
        assert (np.diff(sequence) > 0).all()
        assert (np.diff(arrivals) >= 0).all()
        if not self.loses_frames:
            assert (np.diff(sequence) == 1).all()
        if not self.damages_frames:
            assert not any(frame.damaged for frame in frames)
        if locked.info.clock == "monotonic":
            # A millisecond: drivers' and our clock readings are rounded to microseconds at best.
            assert (arrivals - stamps > -1e-3).all()

    def test_the_rate_is_the_one_that_it_promises(self, locked):
        if not self.steady_rate or not locked.format.fps:
            pytest.skip("this camera promises no steady rate")
        frames = self.read(locked, self.frames)
        interval_s = median(
            (later.stamp_s - earlier.stamp_s) / (later.sequence - earlier.sequence)
            for earlier, later in pairwise(frames)
        )
        # Real cameras' quartz and rounding of 30 to 29.97: two in a hundred.
        assert interval_s * locked.format.fps == pytest.approx(1.0, rel=0.02)

    def test_controls_that_nobody_touched_have_not_drifted(self, locked):
        self.read(locked, min(10, self.frames))
        drifted = locked.check()
        assert not drifted or self.drifts, drifted
        assert all(control.note for control in drifted)

    def test_a_second_lock_of_the_same_goes_on_with_the_stream(self, locked):
        format, before = locked.format, locked.read(self.timeout_s)
        locked.lock(self.profile)
        after = locked.read(self.timeout_s)
        assert locked.format == format
        assert after.sequence > before.sequence
        assert after.stamp_s > before.stamp_s

    def test_the_light_is_what_verifies_the_exposure(self, device):
        if not self.has_exposure or not self.verified_by_light:
            pytest.skip("this camera has no exposure control that the light could follow")
        report = device.lock(self.profile)
        exposure = next(control for control in report.controls if control.name == "exposure_s")
        assert exposure.verified is True, exposure
        assert exposure.read_back is not None

    def test_restoring_says_in_words_what_would_not_go(self, locked):
        assert locked.restore() == ()
        assert locked.restore() == ()

    def test_restoring_what_was_never_locked_is_harmless(self, device):
        assert device.restore() == ()

    def test_a_wait_ends_in_time_and_loses_nothing(self, locked):
        before = locked.read(self.timeout_s)
        early = []
        with suppress(CameraTimeoutError):
            early.append(locked.read(1e-4))
        after = (early + self.read(locked, 1))[0]
        assert after.sequence - before.sequence >= 1
        if not self.loses_frames:
            assert after.sequence - before.sequence <= 2

    def test_closing_twice_is_harmless_and_ends_it(self, locked):
        locked.close()
        locked.close()
        with pytest.raises(CameraError):
            locked.read(0.1)

    def test_it_closes_itself_as_a_context(self, device):
        with device as camera:
            assert camera is device
            camera.lock(self.profile)
            camera.read(self.timeout_s)
        with pytest.raises(CameraError):
            camera.read(0.1)
