"""Everything about the rig that can be set, in one small frozen class."""

from __future__ import annotations

from dataclasses import dataclass, field

from capture.sim.camera_path import CameraPath
from capture.sim.decor import DecorConfig
from capture.sim.head_motion import HeadMotion
from capture.sim.lamp import LampConfig
from capture.sim.sensor import SensorConfig
from capture.sim.shake import ShakeConfig
from capture.sim.subject import Subject


@dataclass(frozen=True)
class RigConfig:
    """Everything that can be set. The defaults are the demo.

    Attributes:
        subject: who sits there.
        room_seed: of wallpaper, books and pictures.
        decor: what else the room looks like.
        width: of the upright picture, pixels.
        height: of the upright picture, pixels.
        focal_px: focal length, pixels.
        fps: nominal frame rate.
        path: the hand's motion; its duration is the recording's.
        motion: of the sitter.
        shake: frames blurred by the hand.
        lamp: the flash and its timer.
        sensor: rolling shutter, noise and drift.
        flash_offset_cam_m: [3] flash position in the axes of the stored pictures' camera.
        flash_color: [3] C_flash; a Lambertian pixel is albedo * C_flash / d^2 * cosine.
        room_level: radiance of a white surface that faces the front of the room.
        rotation_deg: clockwise turn from the stored picture to the upright one: 0, 90, 180, 270.
        posed_frames: number of frames of a posed set.
        flash_every: every so many frames of a posed set have the flash on; 1 = all, 0 = none.
        validation_views: extra cameras with ground truth beside a video.
        cloud_points: points in the simulated dense cloud.
        cell_mm: grid of the sculpted mesh; the face's is finer by 2 ** subdivisions.
        subdivisions: see `cell_mm`.
        strands: hair ribbons.
        shadow_directions: depth maps for the broad shadows of room and environments.
        supersampling: samples along each side of a pixel.
        codec: "h264" or "hevc".
        color_range: "limited" or "full".
        matrix: "bt601" or "bt709".
        start: local time in the video's name, yyyymmdd_hhmmss.
    """

    subject: Subject = field(default_factory=Subject)
    room_seed: int = 0
    decor: DecorConfig = field(default_factory=DecorConfig)
    width: int = 480
    height: int = 640
    focal_px: float = 690.0
    fps: float = 30.0
    path: CameraPath = field(default_factory=CameraPath)
    motion: HeadMotion = field(default_factory=HeadMotion)
    shake: ShakeConfig = field(default_factory=ShakeConfig)
    lamp: LampConfig = field(default_factory=LampConfig)
    sensor: SensorConfig = field(default_factory=SensorConfig)
    flash_offset_cam_m: tuple[float, float, float] = (0.013, -0.007, 0.0)
    flash_color: tuple[float, float, float] = (0.235, 0.228, 0.215)
    room_level: float = 0.55
    rotation_deg: int = 0
    posed_frames: int = 60
    flash_every: int = 5
    validation_views: int = 10
    cloud_points: int = 120_000
    cell_mm: float = 2.4
    subdivisions: int = 1
    strands: int = 8500
    shadow_directions: int = 128
    supersampling: int = 2
    codec: str = "h264"
    color_range: str = "limited"
    matrix: str = "bt709"
    start: str = "20261102_101530"

    def __post_init__(self) -> None:
        if self.rotation_deg not in (0, 90, 180, 270):
            raise ValueError(f"rotation_deg {self.rotation_deg} must be 0, 90, 180 or 270")
        if self.flash_every < 0:
            raise ValueError(f"flash_every {self.flash_every} must be 0 or more")
        if self.width % 2 or self.height % 2 or min(self.width, self.height) < 16:
            raise ValueError(f"{self.width} x {self.height}: both sides must be even and at least 16 pixels")

    @classmethod
    def from_seed(cls, seed: int) -> RigConfig:
        """Another person in another room, filmed by another hand; seed 0 is the default."""
        return cls(
            subject=Subject.from_seed(seed),
            room_seed=seed,
            path=CameraPath(seed=seed),
            lamp=LampConfig(seed=seed),
            sensor=SensorConfig(seed=seed),
        )

    @classmethod
    def small(cls) -> RigConfig:
        """A coarse head in small pictures: for tests, a few seconds in all."""
        return cls(
            width=128,
            height=160,
            focal_px=175.0,
            path=CameraPath(duration_s=1.7),
            posed_frames=12,
            validation_views=2,
            cloud_points=4000,
            cell_mm=5.0,
            subdivisions=0,
            strands=500,
            shadow_directions=24,
        )
