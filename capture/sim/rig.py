"""The rig put together: a sitter in a room, a phone that moves, a lamp that blinks.

Frames are made as they are asked for:

rig = Rig.build(RigConfig())
for frame in rig.frames():
    frame.pts_s, frame.rgb, frame.truth
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np

from capture.cameras import Camera
from capture.sim.ahead import computed_ahead
from capture.sim.bust import Bust, build_bust
from capture.sim.config import RigConfig
from capture.sim.environment import Environment, SoftBox, TurnedEnvironment, studio_map
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
class Exposure:
    """A frame that is to be taken.

    Attributes:
        index: its place in the file.
        tick: the sensor's count.
        start_s: of its first row.
        dropped_before: frames lost just before it.
    """

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
        shaken: the hand jerked during the exposure.
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
    shaken: bool = False


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
        passed: what arrives past the sitter's own body of room_light, studio and sunset: [V, 3] each, the
            chair not turned.
        passed_turned: [V, 3] the same of room_light for each of the chair's `key_angles_deg`; empty when
            it does not turn.
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
    passed_turned: tuple[np.ndarray, ...] = ()

    @classmethod
    def build(cls, config: RigConfig, progress: Progress | None = None) -> Rig:
        """Sculpt the sitter, furnish the room, trace the broad shadows."""
        say = progress or (lambda step, part: None)
        say("furnish the room", 0.0)
        room = Room.build(config.room_seed, config.room_level, config.decor)
        room_light = Environment.from_map(room.panorama(PANORAMA_ROWS))
        studio, sunset = Environment.from_map(_STUDIO), Environment.from_map(_SUNSET)
        say("sculpt the head", 0.2)
        bust = build_bust(config.subject, config.cell_mm, config.subdivisions, config.strands)
        say("trace shadows", 0.7)
        motion = config.motion
        turned = [TurnedEnvironment(room_light, motion.chair(angle)) for angle in motion.key_angles_deg()]
        lights: list[Environment | TurnedEnvironment] = [room_light, studio, sunset]
        lights += turned if motion.turn_deg else []
        passed = BroadShadows.trace(bust, lights, config.shadow_directions).passed
        diffuse = environment_diffuse(bust, room_light, passed[0])
        pulses = PulseTrain.schedule(config.lamp, config.path.duration_s)
        say("rig ready", 1.0)
        return cls(config, bust, room, room_light, studio, sunset, passed[:3], diffuse, pulses, passed[3:])

    def camera(self, time_s: float, name: str, flash: int | None = None) -> Camera:
        """The phone's camera at a time of the recording, that of the stored picture, in the head's axes."""
        return self.camera_at(self.upright_pose(time_s), name, flash)

    def upright_pose(self, time_s: float) -> np.ndarray:
        """[4, 4] cam_from_head at a time of the recording, of the upright picture."""
        cam_from_room = self.config.path.cam_from_world(time_s)
        room_from_head = self.room_from_head(time_s)
        return cam_from_room if room_from_head is None else cam_from_room @ room_from_head

    def room_from_head(self, time_s: float) -> np.ndarray | None:
        """[4, 4] where the head is at a time of the recording; None = where the room was built around it."""
        if self.config.motion.still:
            return None
        return self.config.motion.room_from_head(time_s / self.config.path.duration_s)

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

    def layers(self, camera: Camera, flash: bool, room_from_head: np.ndarray | None = None) -> Layers:
        """Noise-free pictures of the room's light and, if wanted, of the flash.

        Args:
            camera: in the head's axes.
            flash: whether the flash's part is wanted.
            room_from_head: [4, 4] where the head is; None = where the room was built around it.
        """
        c, bust = self.config, self.bust
        eye, lamp = camera.centre_world, self.flash_position(camera)
        chosen = facing_vertices(bust, eye)
        in_room, turn, passed = camera, None, self.passed[0]
        radiance = self.room_diffuse.copy()
        if room_from_head is not None:
            in_room = replace(camera, cam_from_world=camera.cam_from_world @ np.linalg.inv(room_from_head))
            turn, passed = room_from_head[:3, :3], self._passed_at(room_from_head)
            radiance = environment_diffuse(bust, self.room_light, passed, turn)
        radiance[chosen] += environment_gloss(bust, self.room_light, passed, eye, chosen, turn)
        sitter = draw_layer(bust, camera, radiance, c.supersampling)
        behind, behind_flash = self.room.draw(in_room, self.flash_position(in_room) if flash else None)
        through = 1.0 - sitter.coverage[..., None]
        room = sitter.radiance + through * self._defocus(behind)
        if behind_flash is None:
            return Layers(room, None, sitter.coverage)
        color = np.array(c.flash_color, dtype=np.float32)
        radiance = np.zeros_like(self.room_diffuse)
        radiance[chosen] = point_light(bust, lamp, color, chosen, eye)
        lit = draw_layer(bust, camera, radiance, c.supersampling)
        return Layers(room, lit.radiance + through * self._defocus(behind_flash) * color, sitter.coverage)

    def _passed_at(self, room_from_head: np.ndarray) -> np.ndarray:
        """[V, 3] of the room's light that arrives: between those of the nearest angles of the chair.

        That the head tips by some degrees changes it little, and is left out.
        """
        if not self.passed_turned:
            return self.passed[0]
        angle = np.degrees(np.arctan2(room_from_head[0, 2], room_from_head[2, 2]))
        keys = self.config.motion.key_angles_deg()
        place = float(np.interp(angle, keys, np.arange(len(keys))))
        low = min(int(place), len(keys) - 2)
        weight = np.float32(place - low)
        return (1 - weight) * self.passed_turned[low] + weight * self.passed_turned[low + 1]

    def expose(self, radiance: np.ndarray, camera: Camera, time_s: float, index: int) -> np.ndarray:
        """[H, W, 3] uint8: the stored picture of a frame's radiance, shaken, with the exposure of its time.

        Args:
            radiance: [H, W, 3] noise-free.
            camera: of the frame.
            time_s: of the middle of its exposure.
            index: of its noise and its shake.
        """
        gains = self.config.sensor.gains(time_s / self.config.path.duration_s)
        shaken = self.config.shake.blur(radiance, camera, index)
        return self.config.sensor.develop((shaken * gains).astype(np.float32), index)

    def _defocus(self, picture: np.ndarray) -> np.ndarray:
        """The room, out of focus by a pixel or so as it is behind a head at half a metre."""
        sigma = self.config.focal_px / 900.0
        return cv2.GaussianBlur(picture, (0, 0), sigma)

    def frames(self) -> Iterator[RigFrame]:
        """The recording's frames, in order, made as they are asked for; lost ones are not among them."""
        c, sensor = self.config, self.config.sensor
        rng = np.random.default_rng([sensor.seed, 5])
        exposures: list[Exposure] = []
        dropped = 0
        for tick in range(round(c.path.duration_s * c.fps)):
            start_s = max(0.0, tick / c.fps + sensor.timestamp_jitter_s * float(np.clip(rng.normal(), -4, 4)))
            if tick > 0 and rng.random() < sensor.dropped:
                dropped += 1
                continue
            exposures.append(Exposure(len(exposures), tick, start_s, dropped))
            dropped = 0
        yield from computed_ahead(self._expose, exposures)

    def _expose(self, exposure: Exposure) -> RigFrame:
        return self.take(exposure, self.pulses)

    def unlit(self, start_s: float) -> Layers:
        """The layers without flash of a frame that starts at this time, to be made beforehand."""
        middle_s = self._middle_s(start_s)
        return self.layers(self.camera(middle_s, "unlit"), False, self.room_from_head(middle_s))

    def _middle_s(self, start_s: float) -> float:
        return start_s + 0.5 * (self.config.sensor.readout_s + self.config.sensor.exposure_s)

    def take(
        self,
        exposure: Exposure,
        pulses: PulseTrain,
        *,
        sensitivity: float = 1.0,
        unlit: Layers | None = None,
    ) -> RigFrame:
        """One frame.

        Args:
            exposure: when.
            pulses: the lamp's.
            sensitivity: factor on the signal, of exposure and gain.
            unlit: what `unlit` gave for its start, to save the time.
        """
        c, sensor = self.config, self.config.sensor
        index, start_s = exposure.index, exposure.start_s
        middle_s = self._middle_s(start_s)
        camera = self.camera(middle_s, f"{index:04d}")
        lit = pulses.lit_fraction(start_s, camera.height, sensor.readout_s, sensor.exposure_s)
        flash = pulses.flag(lit)
        if unlit is not None and lit.max() == 0:
            layers = unlit
        else:
            layers = self.layers(camera, bool(lit.max() > 0), self.room_from_head(middle_s))
        radiance = layers.room * sensor.row_flicker(start_s, camera.height)[:, None, None]
        if layers.flash is not None:
            radiance = radiance + lit[:, None, None] * layers.flash
        end_s = start_s + sensor.readout_s + sensor.exposure_s
        near = [p for p in pulses.pulses if p.on_s < end_s and p.off_s + c.lamp.fall_s > start_s]
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
            shaken=c.shake.blurs(exposure.tick),
        )
        rgb = self.expose(radiance * np.float32(sensitivity), camera, middle_s, exposure.tick)
        return RigFrame(start_s, rgb, camera, lit, truth)
