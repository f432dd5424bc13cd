"""Captures that go wrong, for measuring what the geometry makes of them: a result, or a refusal that helps.

    python -m benchmarks.geometry_scenes --out FOLDER [--quick] [--only NAME]   makes them, says what is lit

Two kinds. Simulated ones are filmed by the rig with one thing gone wrong, rendered as it would look, and
their truth is the rig's. Damaged ones take the training frames of a posed set that is there, such as
portrait_A (RELIGHT_PORTRAIT_A or ../shared/portrait_A), and do to the pictures what a bad capture does; their
truth is the set itself. Poses, cloud, masks and lens are always withheld. A head that moves cannot be made
truthfully out of a still one's pictures, so only the rig has that.
"""

from __future__ import annotations

import argparse
import os
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from capture.cameras import PosedFrame, PosedSet, load_posed_set, save_posed_set
from capture.errors import RelightError
from capture.images import read_image, write_png
from capture.importers import ImportOptions, import_source
from capture.session import Session
from capture.sim import RigConfig, simulate_posed_set, simulate_video
from capture.sim.camera_path import CameraPath
from capture.sim.decor import DecorConfig
from capture.sim.head_motion import HeadMotion
from capture.sim.lamp import LampConfig
from capture.sim.sensor import SensorConfig
from capture.sim.shake import ShakeConfig
from capture.transfer import to_display, to_linear

Outcome = Literal["result", "refusal", "either"]

ROOT = Path(__file__).resolve().parents[1]
GEOMETRY = frozenset({"poses", "points", "masks"})
SEED = 3  # of the simulated person, room and hand
FILM_S = 12.0
BLURRED_SHARE, BLUR_PX = 0.1, 14.0
MISSING_SHARE = 0.2
DRIFT = 0.4  # from the beginning to the end: 20 % to both sides of the middle


@dataclass(frozen=True)
class Made:
    """A scene on the disk.

    Attributes:
        session: imported, without poses, cloud and masks.
        truth: folder with a cameras.json and ground truth; its frames have the session's index or time.
    """

    session: Path
    truth: Path


@dataclass(frozen=True)
class Scene:
    """One capture.

    Attributes:
        name: for tables.
        what: what is wrong with it.
        expected: what should come of it. "either": a good result or a refusal; never a bad result.
        make: called with an empty folder and whether a small one will do. Raises a RelightError where already
            the import refuses, which is the refusal.
    """

    name: str
    what: str
    expected: Outcome
    make: Callable[[Path, bool], Made]


def scenes(portrait_a: Path | None = None) -> list[Scene]:
    """All scenes; those of portrait_A only where it is."""
    root = portrait_a or Path(os.environ.get("RELIGHT_PORTRAIT_A", ROOT.parent / "shared" / "portrait_A"))
    return [*simulated_scenes(), *(damaged_scenes(root) if (root / "cameras.json").is_file() else [])]


def simulated_scenes() -> list[Scene]:
    """Stills and films of the simulated rig."""
    arc, lamp, sensor = CameraPath(seed=SEED), LampConfig(seed=SEED), SensorConfig(seed=SEED)
    standing = replace(arc, sweep_deg=0.0, sway=0.2)
    tripod = replace(arc, sweep_deg=0.0, sway=0.0, tremor=0.0)
    chair = HeadMotion(turn_deg=150.0, seed=SEED)
    bare = DecorConfig(plain=True)
    stills: list[tuple[str, str, Outcome, dict[str, object]]] = [
        ("rig", "nothing is wrong", "result", {}),
        ("plain walls", "bare walls, nothing on them", "either", {"decor": bare}),
        (
            "markers on walls",
            "bare walls with printed markers of 0.15 m",
            "result",
            {"decor": DecorConfig(plain=True, markers="walls", marker_side_m=0.15)},
        ),
        (
            "markers on a screen",
            "a folding screen with printed markers of 0.07 m behind the head",
            "result",
            {"decor": DecorConfig(plain=True, markers="screen", marker_side_m=0.07)},
        ),
        (
            "turning chair",
            "the hand stands still, the chair turns by 150 degrees",
            "either",
            {"path": standing, "motion": chair},
        ),
        (
            "turning chair, plain walls",
            "the same before bare walls",
            "either",
            {"path": standing, "motion": chair, "decor": bare},
        ),
        (
            "head nods",
            "the head tips by 3 degrees and moves by 5 mm in the middle, and stays",
            "either",
            {"motion": HeadMotion(nod_deg=3.0, shift_m=(0.004, 0.0, -0.003))},
        ),
        (
            "head sways",
            "the head sways by 1 degree and 3 mm all the time",
            "either",
            {"motion": HeadMotion(sway_deg=1.0, sway_m=0.003, seed=SEED)},
        ),
        (
            "exposure drift",
            "exposure rises by 40 %",
            "result",
            {"sensor": replace(sensor, exposure_drift=DRIFT)},
        ),
        (
            "blurred tenth",
            f"a tenth of the frames is blurred over {BLUR_PX:g} pixels",
            "result",
            {"shake": ShakeConfig(BLURRED_SHARE, BLUR_PX, SEED)},
        ),
        (
            "two centimetres",
            "the camera moves by 2 cm in all",
            "refusal",
            {"path": replace(arc, sweep_deg=2.0, sway=0.0, tremor=0.2)},
        ),
        ("tripod", "the camera does not move at all", "refusal", {"path": tripod}),
        ("never lit", "the flash never fires", "refusal", {"flash_every": 0}),
        ("always lit", "the flash fires in every picture", "refusal", {"flash_every": 1}),
    ]
    films: list[tuple[str, str, Outcome, dict[str, object]]] = [
        ("film", "an mp4, nothing is wrong", "result", {}),
        ("film, never lit", "the lamp never lights", "refusal", {"lamp": replace(lamp, missed=1.0)}),
        ("film, always lit", "the lamp always burns", "refusal", {"lamp": replace(lamp, always_on=True)}),
        (
            "film, turning chair",
            "the hand stands still, the chair turns by 150 degrees",
            "either",
            {"path": standing, "motion": chair},
        ),
    ]
    return [
        *(Scene(name, what, expected, partial(_stills, changes)) for name, what, expected, changes in stills),
        *(Scene(name, what, expected, partial(_film, changes)) for name, what, expected, changes in films),
    ]


def damaged_scenes(root: Path) -> list[Scene]:
    """The training frames of a posed set, damaged."""
    name = root.name
    cases: list[tuple[str, str, Outcome, Damage]] = [
        ("as it is", "nothing is wrong", "result", _unharmed),
        ("blurred tenth", f"a tenth of the frames is blurred over {BLUR_PX:g} pixels", "result", _blurred),
        ("fifth missing", "a fifth of the frames is missing, here and there", "result", _missing),
        ("gap", "a fifth of the frames is missing, in one piece", "either", _gap),
        ("exposure drift", "exposure rises by 40 %", "result", _drifting),
        ("plain background", "what is not head is painted in one colour", "either", _painted),
        ("only lit", "all frames without flash are missing", "refusal", partial(_only, 1)),
        ("only unlit", "all frames with flash are missing", "refusal", partial(_only, 0)),
    ]
    return [
        Scene(f"{name}, {case}", what, expected, partial(_damaged, root, damage))
        for case, what, expected, damage in cases
    ]


def _config(quick: bool, changes: dict[str, object]) -> RigConfig:
    config = replace(RigConfig.from_seed(SEED), posed_frames=100, **changes)  # type: ignore[arg-type]
    if not quick:
        return config
    return replace(
        config,
        width=240,
        height=320,
        focal_px=345.0,
        posed_frames=40,
        cell_mm=4.0,
        subdivisions=0,
        strands=1500,
        shadow_directions=32,
        cloud_points=20_000,
        validation_views=2,
    )


def _stills(changes: dict[str, object], folder: Path, quick: bool) -> Made:
    """A posed set of the rig, imported with its flash flags and nothing else."""
    truth = folder / "truth"
    simulate_posed_set(truth, _config(quick, changes))
    import_source([truth], folder / "session", ImportOptions(without=GEOMETRY))
    return Made(folder / "session", truth)


def _film(changes: dict[str, object], folder: Path, quick: bool) -> Made:
    """A film of the rig, imported with nothing beside it."""
    config, truth = _config(quick, changes), folder / "truth"
    config = replace(config, path=replace(config.path, duration_s=FILM_S / 2 if quick else FILM_S))
    import_source([simulate_video(truth, config)], folder / "session", ImportOptions())
    return Made(folder / "session", truth)


@dataclass(frozen=True, eq=False)
class Still:
    """A frame of a posed set while it is damaged.

    Attributes:
        frame: camera, flash, mask.
        radiance: [H, W, 3] linear picture, made when asked for; None = as the file is.
    """

    frame: PosedFrame
    radiance: Callable[[], np.ndarray] | None = None


Damage = Callable[[list[PosedFrame], str], list[Still]]


def _damaged(root: Path, damage: Damage, folder: Path, quick: bool) -> Made:
    """A set's training frames, damaged and imported with their flash flags and nothing else."""
    posed = load_posed_set(root)
    training = [frame for frame in posed.frames if frame.split != "val" and frame.file is not None]
    source = folder / "source"
    source.mkdir(parents=True)
    stills = damage(training, posed.transfer)
    frames = [_written(still, posed, source, 0.5 if quick else 1.0) for still in stills]
    save_posed_set(replace(posed, frames=tuple(frames), root=source), source / "cameras.json")
    import_source([source], folder / "session", ImportOptions(without=GEOMETRY))
    return Made(folder / "session", root)


def _written(still: Still, posed: PosedSet, source: Path, scale: float) -> PosedFrame:
    """The frame with its picture written, byte for byte where nothing was done to it."""
    frame = still.frame
    assert frame.file is not None
    if still.radiance is None and scale == 1.0:
        file = source / frame.file.name
        file.write_bytes(frame.file.read_bytes())
        return replace(frame, file=file, mask=None, linear=None)
    radiance = _radiance(frame, posed.transfer) if still.radiance is None else still.radiance()
    camera = frame.camera.scaled(scale)
    if scale != 1.0:
        radiance = cv2.resize(radiance, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    stored = to_display(np.clip(radiance, 0.0, 1.0).astype(np.float32), posed.transfer)
    file = source / f"{frame.file.stem}.png"
    write_png(file, np.round(255 * stored).astype(np.uint8))
    return replace(frame, file=file, mask=None, linear=None, camera=camera)


def _radiance(frame: PosedFrame, transfer: str) -> np.ndarray:
    assert frame.file is not None
    return np.asarray(to_linear(read_image(frame.file), transfer))


def _unharmed(frames: list[PosedFrame], transfer: str) -> list[Still]:
    return [Still(frame) for frame in frames]


def _blurred(frames: list[PosedFrame], transfer: str) -> list[Still]:
    shake = ShakeConfig(1.0, BLUR_PX, SEED)
    chosen = set(_some(len(frames), BLURRED_SHARE))

    def blur(frame: PosedFrame) -> np.ndarray:
        return shake.blur(_radiance(frame, transfer), frame.camera, frame.index)

    return [Still(f, partial(blur, f) if k in chosen else None) for k, f in enumerate(frames)]


def _missing(frames: list[PosedFrame], transfer: str) -> list[Still]:
    chosen = set(_some(len(frames), MISSING_SHARE))
    return [Still(frame) for k, frame in enumerate(frames) if k not in chosen]


def _gap(frames: list[PosedFrame], transfer: str) -> list[Still]:
    first = round(0.4 * len(frames))
    gap = range(first, first + round(MISSING_SHARE * len(frames)))
    return [Still(frame) for k, frame in enumerate(frames) if k not in gap]


def _drifting(frames: list[PosedFrame], transfer: str) -> list[Still]:
    def gained(frame: PosedFrame, gain: float) -> np.ndarray:
        return gain * _radiance(frame, transfer)

    gains = np.linspace(1 - DRIFT / 2, 1 + DRIFT / 2, len(frames))
    return [Still(f, partial(gained, f, float(gain))) for f, gain in zip(frames, gains, strict=True)]


def _painted(frames: list[PosedFrame], transfer: str) -> list[Still]:
    """What is not head becomes a wall far away, to which the flash adds a tenth."""
    wall = np.array([0.16, 0.155, 0.145], np.float32)

    def paint(frame: PosedFrame) -> np.ndarray:
        assert frame.mask is not None
        cover = (read_image(frame.mask).astype(np.float32) / 255)[..., None]
        return cover * _radiance(frame, transfer) + (1 - cover) * wall * (1.1 if frame.flash else 1.0)

    return [Still(frame, partial(paint, frame)) for frame in frames]


def _only(flash: int, frames: list[PosedFrame], transfer: str) -> list[Still]:
    return [Still(frame) for frame in frames if frame.flash == flash]


def _some(count: int, share: float) -> list[int]:
    return [int(k) for k in np.random.default_rng(SEED).choice(count, round(share * count), replace=False)]


def main() -> None:
    """Makes scenes and says what is in them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="folder to make them in")
    parser.add_argument("--quick", action="store_true", help="small pictures")
    parser.add_argument("--only", action="append", help="names of scenes (default: all)")
    args = parser.parse_args()
    for scene in scenes():
        if args.only and scene.name not in args.only:
            continue
        folder = args.out / scene.name.replace(", ", "_").replace(" ", "_")
        folder.mkdir(parents=True, exist_ok=True)
        try:
            made = scene.make(folder, args.quick)
        except RelightError as refusal:
            print(f"{scene.name:28} {scene.expected:8} refused: {refusal}", flush=True)
            continue
        records = Session.open(made.session).frames
        counts = Counter(record.flash for record in records if record.file is not None)
        print(f"{scene.name:28} {scene.expected:8} {counts[1]} lit, {counts[0]} unlit", flush=True)


if __name__ == "__main__":
    main()
