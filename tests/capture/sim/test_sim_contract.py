"""The contract of cameras, held by the simulated one."""

from dataclasses import replace

import pytest
from camera_contract import CameraContract

from capture.devices.bench import Bench, VirtualClock
from capture.devices.camera import CameraProfile
from capture.devices.table import open_camera
from capture.sim.rig import Rig


class TestSimulatedCamera(CameraContract):
    profile = CameraProfile(exposure_s=0.008, gain=1.0)
    frames = 12  # each is rendered
    verified_by_light = False  # sixty rendered frames, for a control that is right by construction
    needs_lock = False

    @pytest.fixture
    def device(self, small_rig, monkeypatch):
        monkeypatch.setattr(Rig, "build", lambda config: replace(small_rig, config=config))
        with open_camera("sim:coarse", Bench(VirtualClock())) as camera:
            yield camera
