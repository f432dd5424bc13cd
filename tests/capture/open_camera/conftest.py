"""A small film of a flat scene under a blinking flash, with a rolling shutter, for import tests."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from capture.transfer import to_display
from capture.video import VideoWriter

WIDTH, HEIGHT = 192, 112


@dataclass(frozen=True)
class Film:
    """What is filmed; light in units of white clip, times in seconds."""

    seconds: float = 6.0
    rate_hz: float = 30.0
    start_s: float = 0.0
    first_flash_s: float = 0.41
    period_s: float = 1.01
    on_s: float = 0.1
    exposure_s: float = 0.005
    readout_s: float = 0.02
    room: float = 0.25
    flash_gain: float = 0.9
    transfer: str = "rec709"

    def times_s(self) -> NDArray[np.float64]:
        """Start of each frame, wandering by up to 4 ms as a phone's do."""
        count = round(self.seconds * self.rate_hz)
        wander = np.random.default_rng(5).uniform(0.0, 0.004, count)
        return self.start_s + np.arange(count) / self.rate_hz + wander

    def pulses_s(self) -> NDArray[np.float64]:
        """Start of each pulse, on the film's time axis."""
        return np.arange(self.first_flash_s, self.start_s + self.seconds + 0.2, self.period_s)

    def lit_rows(self) -> NDArray[np.float64]:
        """[frames, rows] share of the exposure that the flash lit."""
        start = self.times_s()[:, None] + np.arange(HEIGHT) / HEIGHT * self.readout_s
        lit = np.zeros_like(start)
        for on_s in self.pulses_s():
            overlap = np.minimum(start + self.exposure_s, on_s + self.on_s) - np.maximum(start, on_s)
            lit += np.clip(overlap / self.exposure_s, 0.0, 1.0)
        return lit

    def labels(self) -> list[int | None]:
        """1, 0 or None = partial, by the rule of the product: 0.98 and 0.02 over all rows."""
        lit = self.lit_rows()
        return [1 if row.min() >= 0.98 else 0 if row.max() <= 0.02 else None for row in lit]

    def write(self, path: Path, **options: object) -> Path:
        """Films it: a textured scene that sways by a few pixels, with noise."""
        rng = np.random.default_rng(7)
        coarse = rng.uniform(0.2, 1.0, (9, 13, 3)).astype(np.float32)
        fine = rng.uniform(0.7, 1.0, (70, 110, 3)).astype(np.float32)
        canvas = (WIDTH + 16, HEIGHT + 16)
        scene = cv2.resize(coarse, canvas, interpolation=cv2.INTER_CUBIC)
        scene *= cv2.resize(fine, canvas, interpolation=cv2.INTER_LINEAR)
        with VideoWriter(path, WIDTH, HEIGHT, crf=14, **options) as writer:  # type: ignore[arg-type]
            for pts_s, lit in zip(self.times_s(), self.lit_rows(), strict=True):
                x = 8 + 6 * np.sin(1.3 * pts_s)
                y = 8 + 4 * np.sin(0.9 * pts_s)
                view = np.array([[1, 0, x], [0, 1, y]])
                flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
                albedo = cv2.warpAffine(scene, view, (WIDTH, HEIGHT), flags=flags)
                light = self.room * (1.0 + self.flash_gain * lit)
                linear = albedo * light[:, None, None] + rng.normal(0, 0.002, albedo.shape)
                writer.write(np.rint(255 * to_display(linear, self.transfer)).astype(np.uint8), float(pts_s))
        return path


@pytest.fixture(scope="session")
def film() -> Film:
    """The film that most tests import."""
    return Film()


@pytest.fixture(scope="session")
def video(film: Film, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its file, named by Open Camera's rule, without sidecars."""
    return film.write(tmp_path_factory.mktemp("film") / "VID_20261102_101530.mp4", rotation_deg=90)


@pytest.fixture(scope="session")
def flash_list(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Says that frame 13 is lit and no other: spares the tagging where a test is about something else."""
    path = tmp_path_factory.mktemp("list") / "flash.txt"
    path.write_text("000013\n")
    return path
