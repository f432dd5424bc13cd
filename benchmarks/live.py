"""The live display: what a frame costs, and how true its gauges are on the simulated rig.

    python -m benchmarks.live --out benchmarks/results/live.json
    python -m benchmarks.live --only timing --out timing.json

Timing: milliseconds of CPU a frame of 640 x 480 RGB, of the whole and of its parts, beside the JPEG decoding
of the same frame as a yardstick (one thread). Gauges: walks around several heads in several rooms; the span
of the azimuth and of the elevation against the poses; labels against the lamp; restlessness of heads at rest
and of heads that move; sharpness of frames in which the hand jerked.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.record import spread, write_record
from capture.live import LiveMonitor
from capture.live.coverage import surroundings_turn
from capture.live.flow import FlowTracker
from capture.live.live_tags import LiveTagger
from capture.live.meters import LightMeter, SharpnessGauge
from capture.sim import Rig, RigConfig
from capture.sim.camera_path import CameraPath
from capture.sim.decor import DecorConfig
from capture.sim.head_motion import HeadMotion
from capture.sim.rig import FrameTruth
from capture.sim.shake import ShakeConfig

DURATION_S = 14.0
SWAYING = HeadMotion(sway_deg=3.0, sway_m=0.01, seed=9)
STANDING = CameraPath(duration_s=8.0, sweep_deg=0.0, sway=0.3, seed=10)
WIDE = {"width": 640, "height": 480, "focal_px": 560.0}


def rig(seed: int, **changes: Any) -> RigConfig:
    """A rig with a head coarse enough to be filmed in half a minute."""
    config = replace(
        RigConfig.from_seed(seed), cell_mm=3.0, strands=4000, shadow_directions=32, supersampling=1
    )
    return replace(config, **({"path": replace(config.path, duration_s=DURATION_S)} | changes))


SCENES: dict[str, RigConfig] = {
    "walk, seed 0": rig(0),
    "walk, seed 1": rig(1),
    "walk, seed 2, wide": rig(2, **WIDE),
    "walk, seed 12, wide": rig(12, **WIDE),
    "walk, seed 8, from above at 0.75 m, 100 degrees": rig(
        8,
        **WIDE,
        path=CameraPath(duration_s=DURATION_S, sweep_deg=100, seed=8, distance_m=0.75, elevation_deg=15),
    ),
    "walk, seed 7, one frame in eight jerked": rig(7, shake=ShakeConfig(share=0.12, length_px=14, seed=7)),
    "walk, bare walls": rig(3, decor=DecorConfig(plain=True)),
    "walk, the head nods by 12 degrees": rig(4, motion=HeadMotion(nod_deg=12)),
    "walk, the head sways": rig(5, motion=SWAYING),
    "chair turns by 120 degrees, camera stands": rig(
        6, motion=HeadMotion(turn_deg=120), path=replace(STANDING, duration_s=DURATION_S)
    ),
    "camera stands, head at rest": rig(10, path=STANDING),
    "camera stands, the head sways": rig(11, motion=SWAYING, path=STANDING),
}


class Watcher:
    """Watches a film and keeps what the gauges said beside the truth."""

    def __init__(self, config: RigConfig, focal_px: float | None) -> None:
        self._monitor = LiveMonitor(
            config.width,
            config.height,
            config.sensor.transfer,
            config.fps,
            config.lamp.period_s,
            config.path.duration_s,
            focal_px=focal_px,
        )
        self._truths: list[FrameTruth] = []
        self._labels: list[str] = []
        self._motions: list[float] = []
        self._sharpness: list[tuple[bool, float]] = []
        self._errors: list[float] = []
        self._azimuths: list[float] = []
        self._elevations: list[float] = []

    def add(self, picture: np.ndarray, pts_s: float, centre: np.ndarray, truth: FrameTruth) -> None:
        """A frame, where its camera was in the head's axes, and what happened in it."""
        label = self._monitor.add(picture, pts_s, len(self._labels))
        self._labels.append(label)
        self._truths.append(truth)
        x, y, z = centre
        self._azimuths.append(float(np.degrees(np.arctan2(x, z))))
        self._elevations.append(float(np.degrees(np.arctan2(y, np.hypot(x, z)))))
        if label != "unlit":
            return
        state = self._monitor.snapshot()
        self._sharpness.append((truth.shaken, state.sharpness))
        if state.motion is not None:
            self._motions.append(state.motion)
        if state.coverage.span_deg is not None and pts_s > 2.0:
            self._errors.append(abs(state.coverage.span_deg - float(np.ptp(self._azimuths))))

    def row(self) -> dict[str, Any]:
        """The film as a whole."""
        state = self._monitor.snapshot()
        names = {1: "lit", 0: "unlit", None: "partial"}
        pairs = list(zip([names[truth.flash] for truth in self._truths], self._labels, strict=True))
        jerked = [value for shaken, value in self._sharpness if shaken]
        steady = [value for shaken, value in self._sharpness if not shaken]
        return {
            "span_deg": state.coverage.span_deg,
            "true_span_deg": float(np.ptp(self._azimuths)),
            "at_least": state.coverage.at_least,
            "largest_error_after_2s_deg": max(self._errors, default=None),
            "elevation_span_deg": state.coverage.elevation_span_deg,
            "true_elevation_span_deg": float(np.ptp(self._elevations)),
            "labels_right": float(np.mean([true == told for true, told in pairs])),
            "lit_told_unlit": pairs.count(("lit", "unlit")),
            "unlit_told_lit": pairs.count(("unlit", "lit")),
            "partial_told_unlit": pairs.count(("partial", "unlit")),
            "partial_told_lit": pairs.count(("partial", "lit")),
            "lit_told_partial": pairs.count(("lit", "partial")),
            "pulses_seen": state.pulses_seen,
            "pulses": len({truth.on_s for truth in self._truths} - {None}),
            "restless_median": float(np.median(self._motions)) if self._motions else None,
            "restless_most": max(self._motions, default=None),
            "sharpness_steady_least_2_percent": float(np.percentile(steady, 2)),
            "sharpness_jerked_median": float(np.median(jerked)) if jerked else None,
            "last_advice": state.advice,
        }


def measure_gauges(only: str) -> dict[str, Any]:
    """The scenes whose name holds `only`, with the true focal length and with the one taken without any."""
    results = {}
    for name, config in SCENES.items():
        if only not in name:
            continue
        known, guessed = Watcher(config, config.focal_px), Watcher(config, None)
        for frame in Rig.build(config).frames():
            for watcher in (known, guessed):
                watcher.add(frame.rgb, frame.pts_s, frame.camera.centre_world, frame.truth)
        results[name] = known.row() | {"span_deg_without_focal_length": guessed.row()["span_deg"]}
        _say(name, results[name])
    return results


def _say(name: str, row: dict[str, Any]) -> None:
    span = "cannot tell" if row["span_deg"] is None else f"{row['span_deg']:.0f}"
    restless = (
        "cannot tell"
        if row["restless_most"] is None
        else f"{row['restless_median']:.2f} ({row['restless_most']:.2f})"
    )
    print(
        f"{name:52s} span {span:>11s} of {row['true_span_deg']:5.0f}  "
        f"labels {100 * row['labels_right']:5.1f} %, "
        f"lit<>unlit {row['lit_told_unlit']}+{row['unlit_told_lit']}, "
        f"pulses {row['pulses_seen']}/{row['pulses']}  restless {restless}",
        flush=True,
    )


def measure_time(repeats: int) -> dict[str, Any]:
    """CPU milliseconds a frame, and their ratios to the decoding of a JPEG of the frame."""
    config = rig(2, **WIDE, path=CameraPath(duration_s=2.5, sweep_deg=30, seed=2))
    frames = list(Rig.build(config).frames())
    pictures = [frame.rgb for frame in frames]
    stamps = [frame.pts_s for frame in frames]
    lumas = [cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) for picture in pictures]
    unlit = [k for k, frame in enumerate(frames) if frame.truth.flash == 0]
    smalls = [cv2.resize(lumas[k], (320, 240), interpolation=cv2.INTER_AREA) for k in unlit]
    jpegs = [cv2.imencode(".jpg", picture)[1] for picture in pictures]
    focal_px = config.focal_px / 2

    def whole(source: list[np.ndarray]) -> None:
        monitor = LiveMonitor(640, 480, "srgb", 30, 1.0, 20, focal_px=config.focal_px)
        for k, (picture, stamp_s) in enumerate(zip(source, stamps, strict=True)):
            monitor.add(picture, stamp_s, k)
            if k % 4 == 0:
                monitor.snapshot()

    def tags() -> None:
        tagger = LiveTagger("srgb")
        for luma, stamp_s in zip(lumas, stamps, strict=True):
            tagger.add(luma, stamp_s)

    def meters() -> None:
        meter = LightMeter(640, 480)
        for picture, luma in zip(pictures, lumas, strict=True):
            meter.measure(picture, luma)

    def sharpness() -> None:
        gauge = SharpnessGauge()
        for small in smalls:
            gauge.add(small)

    def following() -> None:
        tracker = FlowTracker()
        for small, k in zip(smalls, unlit, strict=True):
            flow = tracker.add(small, stamps[k])
            if flow is not None:
                surroundings_turn(flow, focal_px)

    parts: dict[str, Callable[[], None]] = {
        "decode a JPEG (yardstick)": lambda: (
            [cv2.imdecode(jpeg, cv2.IMREAD_COLOR) for jpeg in jpegs] and None
        ),
        "whole, RGB": lambda: whole(pictures),
        "whole, luma": lambda: whole(lumas),
        "labels": tags,
        "meters": meters,
        "sharpness, unlit frames": sharpness,
        "following and turn, unlit frames": following,
    }
    times: dict[str, list[float]] = {name: [] for name in parts}
    for turn in range(repeats + 1):
        for name, work in parts.items():
            started = time.process_time()
            work()
            if turn:
                times[name].append(1e3 * (time.process_time() - started) / len(pictures))
    medians = {name: float(np.median(values)) for name, values in times.items()}
    yardstick = medians["decode a JPEG (yardstick)"]
    for name, median in medians.items():
        print(f"{name:36s} {median:6.2f} ms a frame   {median / yardstick:5.2f} of the yardstick", flush=True)
    return {
        "frame": "640x480",
        "cpu_ms_a_frame": {name: spread(values) for name, values in times.items()},
        "ratio_to_jpeg_decoding": {name: median / yardstick for name, median in medians.items()},
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    parser.add_argument("--only", choices=("gauges", "timing"), help="one part")
    parser.add_argument("--scenes", default="", help="only scenes whose name holds this")
    parser.add_argument("--repeats", type=int, default=5, help="turns of the timing")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    results: dict[str, Any] = {}
    if args.only != "gauges":
        results["timing"] = measure_time(args.repeats)
    if args.only != "timing":
        results["gauges"] = measure_gauges(args.scenes)
    write_record(args.out, "live display", ["numpy", "opencv-contrib-python-headless", "rich"], results)


if __name__ == "__main__":
    main()
