"""The rig put together: a sitter in a room, a phone that moves, a lamp that blinks.

Frames are made as they are asked for:

rig = Rig.build(RigConfig())
for frame in rig.frames():
    frame.pts_s, frame.rgb, frame.truth
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from capture.cameras import Camera
from capture.sim.ahead import computed_ahead
from capture.sim.bust import Bust, build_bust
from capture.sim.config import RigConfig
from capture.sim.environment import Environment, SoftBox, studio_map
from capture.sim.lamp import PulseTrain
from capture.sim.room import PANORAMA_ROWS, Room
from capture.sim.shading import (
    draw_layer,
    environment_diffuse,
    environment_gloss,
    facing_vertices,
    point_light,
)
from capture.sim.visibility import BroadShadows

Progress = Callable[[str, float], None]

# Novel lights for measuring, in the units of the room: white in the room's light is about
# `RigConfig.room_level`.
_STUDIO = studio_map(
    (0.10, 0.11, 0.13),
    (0.05, 0.045, 0.04),
    (
        SoftBox((0.9, 0.45, 0.5), 0.42, (3.4, 3.1, 2.7)),
        SoftBox((-1.0, 0.2, 0.1), 0.30, (0.7, 0.95, 1.5)),
        SoftBox((0.1, 0.3, -1.0), 0.35, (1.2, 1.2, 1.2)),
    ),
)
_SUNSET = studio_map(
    (0.22, 0.27, 0.42),
    (0.10, 0.07, 0.05),
    (SoftBox((-0.8, 0.25, 0.75), 0.33, (4.6, 2.4, 1.0)), SoftBox((0.3, 0.9, 0.2), 0.8, (0.12, 0.16, 0.26))),
)


@dataclass(frozen=True)
class _Exposure:
    """A frame that is to be taken: its place in the file, the sensor's count, its start, losses before it."""

    index: int
    tick: int
    start_s: float
    dropped_before: int


@dataclass(frozen=True)
class FrameTruth:
    """What really happened in a frame.

    Attributes:
        index: position in the file.
        pts_s: start of the first row's exposure.
        flash: F: 1 = every row fully lit, 0 = none lit, None = in part.
        lit_fraction: mean over the rows of the light caught, 0 .. 1.
        lit_min: of the least lit row.
        lit_max: of the most lit row.
        on_s: when the pulse that lights it begins; None without one.
        off_s: when that pulse ends.
        dropped_before: frames lost just before this one.
    """

    index: int
    pts_s: float
    flash: int | None
    lit_fraction: float
    lit_min: float
    lit_max: float
    on_s: float | None
    off_s: float | None
    dropped_before: int


@dataclass(frozen=True, eq=False)
class RigFrame:
    """A frame as the phone stores it, and the truth about it.

    Attributes:
        pts_s: time stamp, seconds.
        rgb: [H, W, 3] uint8, in the sensor's transfer.
        camera: pose and intrinsics.
        lit: [H] lit fraction of each row.
        truth: the flag and its causes.
    """

    pts_s: float
    rgb: np.ndarray
    camera: Camera
    lit: np.ndarray
    truth: FrameTruth


@dataclass(frozen=True, eq=False)
class Layers:
    """The two lights of a picture apart, noise-free: frame = room + a * flash.

    Attributes:
        room: [H, W, 3] radiance under the room's light.
        flash: [H, W, 3] radiance that a fully lit frame adds; None when not asked for.
        coverage: [H, W] of the sitter, 0 .. 1.
    """

    room: np.ndarray
    flash: np.ndarray | None
    coverage: np.ndarray


@dataclass(frozen=True, eq=False)
class Rig:
    """A built scene.

    Attributes:
        config: what it was built from.
        bust: the sitter.
        room: the room.
        room_light: the room as seen from the head.
        studio: the first novel environment ("env1").
        sunset: the second ("env2").
        passed: what arrives past the sitter's own body of room_light, studio and sunset: [V, 3] each.
        room_diffuse: [V, 3] diffuse radiance of the sitter under the room's light.
        pulses: the lamp's pulses.
    """

    config: RigConfig
    bust: Bust
    room: Room
    room_light: Environment
    studio: Environment
    sunset: Environment
    passed: tuple[np.ndarray, ...]
    room_diffuse: np.ndarray
    pulses: PulseTrain

    @classmethod
    def build(cls, config: RigConfig, progress: Progress | None = None) -> Rig:
        """Sculpt the sitter, furnish the room, trace the broad shadows."""
        say = progress or (lambda step, part: None)
        say("furnish the room", 0.0)
        room = Room.build(config.room_seed, config.room_level)
        room_light = Environment.from_map(room.panorama(PANORAMA_ROWS))
        studio, sunset = Environment.from_map(_STUDIO), Environment.from_map(_SUNSET)
        say("sculpt the head", 0.2)
        bust = build_bust(config.subject, config.cell_mm, config.subdivisions, config.strands)
        say("trace shadows", 0.7)
        shadows = BroadShadows.trace(bust, [room_light, studio, sunset], config.shadow_directions)
        diffuse = environment_diffuse(bust, room_light, shadows.passed[0])
        pulses = PulseTrain.schedule(config.lamp, config.path.duration_s)
        say("rig ready", 1.0)
        return cls(config, bust, room, room_light, studio, sunset, shadows.passed, diffuse, pulses)

    def camera(self, time_s: float, name: str, flash: int | None = None) -> Camera:
        """The phone's camera at a time of the recording, that of the stored picture."""
        return self.camera_at(self.config.path.cam_from_world(time_s), name, flash)

    def camera_at(self, upright_cam_from_world: np.ndarray, name: str, flash: int | None = None) -> Camera:
        """The phone's camera at an upright pose [4, 4]."""
        c = self.config
        turns = c.rotation_deg // 90
        quarter = np.array(
            [[0.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
        )
        pose = np.linalg.matrix_power(quarter, turns) @ upright_cam_from_world
        width, height = (c.height, c.width) if turns % 2 else (c.width, c.height)
        K = np.array([[c.focal_px, 0.0, width / 2], [0.0, c.focal_px, height / 2], [0.0, 0.0, 1.0]])
        return Camera(name, width, height, K, pose, flash=flash)

    def flash_position(self, camera: Camera) -> np.ndarray:
        """[3] world position of the flash when the phone is at `camera`."""
        return camera.centre_world + camera.cam_from_world[:3, :3].T @ np.array(
            self.config.flash_offset_cam_m
        )

    def layers(self, camera: Camera, flash: bool) -> Layers:
        """Noise-free pictures of the room's light and, if wanted, of the flash."""
        c, bust = self.config, self.bust
        eye, lamp = camera.centre_world, self.flash_position(camera)
        chosen = facing_vertices(bust, eye)
        radiance = self.room_diffuse.copy()
        radiance[chosen] += environment_gloss(bust, self.room_light, self.passed[0], eye, chosen)
        sitter = draw_layer(bust, camera, radiance, c.supersampling)
        behind, behind_flash = self.room.draw(camera, lamp if flash else None)
        through = 1.0 - sitter.coverage[..., None]
        room = sitter.radiance + through * self._defocus(behind)
        if behind_flash is None:
            return Layers(room, None, sitter.coverage)
        color = np.array(c.flash_color, dtype=np.float32)
        radiance = np.zeros_like(self.room_diffuse)
        radiance[chosen] = point_light(bust, lamp, color, chosen, eye)
        lit = draw_layer(bust, camera, radiance, c.supersampling)
        return Layers(room, lit.radiance + through * self._defocus(behind_flash) * color, sitter.coverage)

    def _defocus(self, picture: np.ndarray) -> np.ndarray:
        """The room, out of focus by a pixel or so as it is behind a head at half a metre."""
        sigma = self.config.focal_px / 900.0
        return cv2.GaussianBlur(picture, (0, 0), sigma)

    def frames(self) -> Iterator[RigFrame]:
        """The recording's frames, in order, made as they are asked for; lost ones are not among them."""
        c, sensor = self.config, self.config.sensor
        rng = np.random.default_rng([sensor.seed, 5])
        exposures: list[_Exposure] = []
        dropped = 0
        for tick in range(round(c.path.duration_s * c.fps)):
            start_s = max(0.0, tick / c.fps + sensor.timestamp_jitter_s * float(np.clip(rng.normal(), -4, 4)))
            if tick > 0 and rng.random() < sensor.dropped:
                dropped += 1
                continue
            exposures.append(_Exposure(len(exposures), tick, start_s, dropped))
            dropped = 0
        yield from computed_ahead(self._expose, exposures)

    def _expose(self, exposure: _Exposure) -> RigFrame:
        c, sensor = self.config, self.config.sensor
        index, start_s = exposure.index, exposure.start_s
        middle_s = start_s + 0.5 * (sensor.readout_s + sensor.exposure_s)
        camera = self.camera(middle_s, f"{index:04d}")
        lit = self.pulses.lit_fraction(start_s, camera.height, sensor.readout_s, sensor.exposure_s)
        flash = self.pulses.flag(lit)
        layers = self.layers(camera, bool(lit.max() > 0))
        radiance = layers.room * sensor.row_flicker(start_s, camera.height)[:, None, None]
        if layers.flash is not None:
            radiance = radiance + lit[:, None, None] * layers.flash
        radiance = radiance * sensor.gains(middle_s / c.path.duration_s)
        end_s = start_s + sensor.readout_s + sensor.exposure_s
        near = [p for p in self.pulses.pulses if p.on_s < end_s and p.off_s + c.lamp.fall_s > start_s]
        pulse = near[0] if near and lit.max() > 0 else None
        truth = FrameTruth(
            index=index,
            pts_s=start_s,
            flash=flash,
            lit_fraction=float(lit.mean()),
            lit_min=float(lit.min()),
            lit_max=float(lit.max()),
            on_s=pulse.on_s if pulse else None,
            off_s=pulse.off_s if pulse else None,
            dropped_before=exposure.dropped_before,
        )
        return RigFrame(
            start_s, sensor.develop(radiance.astype(np.float32), exposure.tick), camera, lit, truth
        )
