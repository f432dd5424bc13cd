"""A film of the simulated rig, and a flat make-believe room whose motion is exactly known."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest

from capture.sim import Rig, RigConfig
from capture.sim.camera_path import CameraPath
from capture.sim.lamp import LampConfig
from capture.sim.rig import RigFrame

WIDTH, HEIGHT, FOCAL_PX = 320, 240, 280.0


@dataclass(frozen=True)
class Film:
    """Frames with their truth, and the focal length."""

    frames: list[RigFrame]
    config: RigConfig

    def azimuths_deg(self) -> np.ndarray:
        centres = np.array([frame.camera.centre_world for frame in self.frames])
        return np.degrees(np.arctan2(centres[:, 0], centres[:, 2]))


@pytest.fixture(scope="session")
def walked_film() -> Film:
    """Two and a half seconds, 30 degrees around a coarse head, three flashes."""
    config = replace(
        RigConfig.small(),
        width=240,
        height=320,
        focal_px=345.0,
        fps=24.0,
        path=CameraPath(duration_s=2.5, sweep_deg=30.0, seed=3),
        lamp=LampConfig(first_s=0.35, period_s=0.8, on_s=0.12, seed=3),
        supersampling=1,
    )
    return Film(list(Rig.build(config).frames()), config)


class FlatRoom:
    """A camera turns within a papered cylinder; before it hangs a textured head that can be shifted."""

    def __init__(self, *, wall: bool = True) -> None:
        rng = np.random.default_rng(5)
        texture = rng.uniform(60, 160, (HEIGHT // 8, WIDTH // 2)).astype(np.float32)
        self._wall = cv2.resize(texture, None, fx=8, fy=8, interpolation=cv2.INTER_NEAREST)
        if not wall:
            self._wall[:] = 110
        skin = rng.uniform(100, 200, (HEIGHT // 8, WIDTH // 8)).astype(np.float32)
        self._head = cv2.resize(skin, (WIDTH, HEIGHT), interpolation=cv2.INTER_NEAREST)
        disc = np.zeros((HEIGHT, WIDTH), np.float32)
        cv2.ellipse(disc, (WIDTH // 2, HEIGHT // 2), (52, 72), 0, 0, 360, 1.0, -1)
        self._disc = cv2.GaussianBlur(disc, (0, 0), 2)
        self._rng = rng
        columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
        angles = np.arctan((columns - WIDTH / 2) / FOCAL_PX)
        self._around_px = (FOCAL_PX * angles + 1.5 * WIDTH).astype(np.float32)
        self._up_px = ((rows - HEIGHT / 2) * np.cos(angles) + HEIGHT / 2).astype(np.float32)

    def picture(self, turn_px: float, head_px: tuple[float, float] = (0.0, 0.0), gain: float = 1.0):
        """[h, w] uint8 luma.

        Args:
            turn_px: turn of the wall to the right, in pixels of the picture's middle.
            head_px: shift of the head, pixels.
            gain: of the codes.
        """

        def shifted(image, x, y):
            matrix = np.array([[1.0, 0.0, x], [0.0, 1.0, y]])
            return cv2.warpAffine(image, matrix, (WIDTH, HEIGHT), borderMode=cv2.BORDER_REFLECT)

        around = self._around_px - np.float32(turn_px)
        behind = cv2.remap(self._wall, around, self._up_px, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        head, disc = shifted(self._head, *head_px), shifted(self._disc, *head_px)
        picture = behind * (1 - disc) + head * disc + self._rng.normal(0, 1.0, behind.shape)
        return np.clip(picture * gain, 0, 255).round().astype(np.uint8)


@pytest.fixture
def flat_room() -> FlatRoom:
    return FlatRoom()


@pytest.fixture
def bare_room() -> FlatRoom:
    return FlatRoom(wall=False)
