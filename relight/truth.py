"""A folder with ground truth: posed views, what a perfect portrait gives there, and lights to measure under.

    cameras_val.json       views to measure; else those of cameras.json with split "val"
    lights.json            lights, named as the pictures in relight/
    mask/XXXX.png          coverage of the head
    linear/XXXX.exr        the captured frame, linear; else the frame itself is compared
    gt/albedo_XXXX.exr     linear albedo
    gt/normal_XXXX.exr     unit normals, world
    relight/NAME_XXXX.exr  linear radiance under the light NAME

XXXX is the name of a view's camera. Whatever is absent is not measured; only the cameras must be there.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture.cameras import Camera, PosedFrame, load_posed_set
from capture.images import read_image
from capture.transfer import to_display, to_linear
from relight.errors import TruthError
from relight.light_spec import load_lights
from relight.lighting import CapturedLight, Light

# Pixels whose true mask is at least this, of 255, count: edges mix the head with its background.
FULL_COVERAGE = 254


@dataclass(frozen=True, eq=False)
class TruthView:
    """One view of the truth; each part is read when it is asked for and None when its file is absent."""

    frame: PosedFrame
    root: Path
    transfer: str

    @property
    def camera(self) -> Camera:
        """The view's camera; its name is part of the names of its files."""
        return self.frame.camera

    def mask(self) -> NDArray[np.float64] | None:
        """Coverage of the head [H, W], 0..1."""
        codes = self._picture(self.frame.mask or self.root / "mask" / f"{self.camera.name}.png")
        if codes is None:
            return None
        largest = np.iinfo(codes.dtype).max if codes.dtype in (np.uint8, np.uint16) else 1
        return (codes if codes.ndim == 2 else codes[..., 0]) / np.float64(largest)

    def captured_srgb(self) -> NDArray[np.float32] | None:
        """The captured frame [H, W, 3], display-referred, 0..1: sRGB(clip(linear))."""
        linear = self._colour(self.frame.linear or self.root / "linear" / f"{self.camera.name}.exr")
        if linear is None and self.frame.file is not None:
            stored = self._colour(self.frame.file)
            linear = None if stored is None else to_linear(stored, self.transfer)
        return None if linear is None else to_display(linear)

    def albedo(self) -> NDArray[np.float32] | None:
        """Albedo [H, W, 3], linear."""
        return self._colour(self.root / "gt" / f"albedo_{self.camera.name}.exr")

    def normals_world(self) -> NDArray[np.float32] | None:
        """Normals [H, W, 3], unit, world; 0 off the head."""
        return self._colour(self.root / "gt" / f"normal_{self.camera.name}.exr")

    def radiance(self, name: str) -> NDArray[np.float32] | None:
        """Radiance [H, W, 3] under a light, linear."""
        return self._colour(self._light_path(name))

    def has_light(self, name: str) -> bool:
        """Whether there is a picture of the view under a light."""
        return self._light_path(name).is_file()

    def _light_path(self, name: str) -> Path:
        return self.root / "relight" / f"{name}_{self.camera.name}.exr"

    def _colour(self, path: Path) -> NDArray[Any] | None:
        picture = self._picture(path)
        if picture is not None and picture.ndim != 3:
            raise TruthError(f"{path} is grey; three channels are needed to measure with it.")
        return picture

    def _picture(self, path: Path) -> NDArray[Any] | None:
        if not path.is_file():
            return None
        picture = read_image(path)
        height, width = picture.shape[:2]
        if (width, height) != (self.camera.width, self.camera.height):
            raise TruthError(
                f"{path} has {width} x {height} pixels, its camera "
                f"{self.camera.width} x {self.camera.height}; remove the picture or correct the camera."
            )
        return picture


@dataclass(frozen=True, eq=False)
class Truth:
    """A folder with ground truth.

    Attributes:
        name: what the set is called.
        views: the views to measure, in the file's order.
        lights: lights to measure under besides that of the capture, by name.
        notes: sentences about what the folder lacks.
    """

    name: str
    views: tuple[TruthView, ...]
    lights: dict[str, Light]
    notes: tuple[str, ...]


def load_truth(path: Path) -> Truth:
    """Opens a folder with ground truth; its pictures are read later.

    Raises:
        TruthError: no folder, or no cameras in it.
        SourceError, LightError: its cameras or lights are malformed.
    """
    if not path.is_dir():
        raise TruthError(f"{path} is no folder; a truth is a folder with a cameras.json.")
    files = [path / name for name in ("cameras_val.json", "cameras.json") if (path / name).is_file()]
    if not files:
        raise TruthError(f"{path} has no cameras.json; it says which views to measure.")
    notes = []
    posed = load_posed_set(files[0])
    # A cameras_val.json lists validation views alone: a video's are none of its own frames.
    held_out = files[0].name == "cameras_val.json"
    frames = [frame for frame in posed.frames if held_out or frame.split == "val"]
    if not frames:
        notes.append(
            f"{files[0].name} names no validation views (split val); all {len(posed.frames)} are measured, "
            "which flatters a portrait that was fitted to them."
        )
        frames = list(posed.frames)
    lights = {}
    if (path / "lights.json").is_file():
        lights = load_lights(path / "lights.json")
    else:
        notes.append("There is no lights.json: no new light is measured.")
    return Truth(
        name=posed.name,
        views=tuple(TruthView(frame, posed.root, posed.transfer) for frame in frames),
        lights={name: light for name, light in lights.items() if not isinstance(light, CapturedLight)},
        notes=tuple(notes),
    )
