"""The simulated rig as a device: `sim:`, `sim:seed=3`, `sim:coarse`; camera and flash are one.

Beyond a real device it knows its poses and a point cloud, so that its sessions can be fitted as they are.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from capture.errors import DeviceError
from capture.ply import PointCloud
from capture.rig_devices import CapturedFrame, RigDescription
from capture.sim.cloud import stereo_cloud
from capture.sim.config import RigConfig
from capture.sim.rig import Rig


def open_rig(camera: str, flash: str, duration_s: float) -> SimulatedRig:
    """The rig of `sim:CAMERA` and `sim:FLASH`; the flash has no settings of its own."""
    if flash:
        raise DeviceError(f"sim:{flash} is not understood; the simulated flash is sim: without settings.")
    config = _config(camera)
    return SimulatedRig(replace(config, path=replace(config.path, duration_s=duration_s)))


class SimulatedRig:
    """Records from the simulated rig."""

    def __init__(self, config: RigConfig) -> None:
        """Builds the scene, which takes some seconds."""
        self._rig = Rig.build(config)
        camera = self._rig.camera(0.0, "0000")
        self.description = RigDescription(
            width=camera.width,
            height=camera.height,
            transfer=config.sensor.transfer,
            rotation_deg=config.rotation_deg,
            device={
                "name": "simulated rig",
                "exposure_s": config.sensor.exposure_s,
                "readout_s": config.sensor.readout_s,
            },
            flash_schedule={"period_s": config.lamp.period_s, "on_s": config.lamp.on_s},
            duration_s=config.path.duration_s,
            flash_offset_cam_m=config.flash_offset_cam_m,
            cloud=self._cloud(),
        )

    def _cloud(self) -> PointCloud:
        """What dense stereo along the path would find."""
        config = self._rig.config
        cameras = [
            self._rig.camera(part * config.path.duration_s, "stereo") for part in np.linspace(0.03, 0.97, 9)
        ]
        rng = np.random.default_rng([config.subject.seed, 404])
        return stereo_cloud(self._rig.bust, cameras, config.cloud_points, rng)

    def frames(self) -> Iterator[CapturedFrame]:
        """The frames, made as they are asked for."""
        sequence = 0
        for frame in self._rig.frames():
            sequence += frame.truth.dropped_before
            yield CapturedFrame(frame.pts_s, sequence, frame.rgb, frame.camera)
            sequence += 1


def _config(settings: str) -> RigConfig:
    """The configuration of "seed=3", "coarse", or both with a semicolon between."""
    config = RigConfig()
    coarse = False
    for setting in filter(None, settings.split(";")):
        key, _, value = setting.partition("=")
        if key == "seed" and value.isdecimal():
            config = RigConfig.from_seed(int(value))
        elif setting == "coarse":
            coarse = True
        else:
            raise DeviceError(f"sim:{settings} is not understood; known are seed=NUMBER and coarse.")
    if coarse:
        return replace(RigConfig.small(), subject=config.subject, room_seed=config.room_seed)
    return config
