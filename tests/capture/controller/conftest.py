"""A simulated desk on which a capture takes seconds."""

from dataclasses import dataclass
from pathlib import Path

import pytest

from capture.controller.config import CaptureConfig
from capture.controller.run import run_capture
from capture.devices.table import open_bench, open_camera, open_flash
from capture.sim.lamp import Pulse, PulseTrain
from capture.sim.rig import Rig


@dataclass
class Desk:
    """A camera and a flash, and what really happened between them."""

    rig: Rig
    folder: Path

    def capture(self, camera="sim:coarse", flash="sim:", *, watch=None, resume=False, out=None, **settings):
        settings = {"duration_s": 6.0} | settings
        config = CaptureConfig(**settings)
        bench = open_bench(camera, flash, config.duration_s)
        self.bench = bench
        with open_flash(flash, bench) as lamp, open_camera(camera, bench) as eye:
            self.camera, self.flash = eye, lamp
            return run_capture(eye, lamp, bench, out or self.folder / "S", config, watch=watch, resume=resume)

    def truth(self, session):
        """By frame index: 1, 0 or None for partial, from the lamp's real light and the sensor's rows."""
        sensor = self.rig.config.sensor
        pulses = tuple(Pulse(on_s, off_s) for on_s, off_s in self.bench.light.pulses)
        train = PulseTrain(self.rig.config.lamp, pulses)
        flags = {}
        for record in session.frames:
            start_s = record.device_timestamp_ns * 1e-9
            rows = train.lit_fraction(start_s, record.height, sensor.readout_s, record.exposure_s)
            flags[record.index] = train.flag(rows)
        return flags

    @property
    def dark(self):
        """Whether the lamp is out from now on."""
        now_s = self.bench.clock.now_s()
        return all(off_s <= now_s + 1e-9 for _, off_s in self.bench.light.pulses)


@pytest.fixture
def desk(one_rig, tmp_path):
    return Desk(one_rig, tmp_path)
