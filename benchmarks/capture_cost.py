"""What a capture costs: processor time a frame, by format and size, with and without what is shown.

    python -m benchmarks.capture_cost --out benchmarks/results/capture_cost.json

The camera is a double that gives frames of the fake V4L2 driver again and again, so that nothing is measured
but our own work: looking, tagging, writing, showing. Time is virtual; a core's load at 30 frames a second is
processor time a frame over a thirtieth of a second. What a real driver costs beside it is not in here.
"""

from __future__ import annotations

import argparse
import shutil
import statistics
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks.record import write_record
from capture.controller.config import CaptureConfig
from capture.controller.run import run_capture
from capture.controller.showing import Display
from capture.devices.bench import Bench, VirtualClock
from capture.devices.camera import CameraInfo, CameraProfile, CapturedFrame, LockReport
from capture.devices.flash import PulseTrain
from capture.devices.table import open_bench, open_camera, open_flash

_LOOP = 90  # frames, three periods of the flash
_FPS = 30.0


class LoopedCamera:
    """Gives the same three seconds again and again."""

    def __init__(self, pixel_format: str, width: int, height: int, bench: Bench) -> None:
        self._clock = bench.clock
        made_on = open_bench("fake-v4l2:", "sim:")
        url = f"fake-v4l2:width={width};height={height}"
        with open_camera(url, made_on) as camera, open_flash("sim:jitter_ms=0", made_on) as flash:
            camera.lock(CameraProfile(pixel_format=pixel_format, fps=_FPS))
            self.format = camera.format
            first = camera.read(1.0)
            start_s = first.stamp_s + 0.7
            flash.start(PulseTrain(start_s=start_s, count=20))
            self._frames = [camera.read(1.0) for _ in range(_LOOP)]
        self.info = CameraInfo(
            url=url, name="loop", back_end="loop", details={}, clock="monotonic", stamp_at="start of exposure"
        )
        self._count = 0

    def lock(self, profile: CameraProfile) -> LockReport:
        return LockReport(controls=())

    def read(self, timeout_s: float) -> CapturedFrame:
        frame = self._frames[self._count % _LOOP]
        stamp_s = 100.0 + self._count / _FPS
        self._count += 1
        assert isinstance(self._clock, VirtualClock)
        self._clock.advance_to(stamp_s)
        return replace(frame, stamp_s=stamp_s, sequence=self._count, arrival_s=stamp_s)

    def check(self) -> tuple[()]:
        return ()

    def restore(self) -> tuple[()]:
        return ()

    def close(self) -> None:
        pass


def measure(pixel_format: str, width: int, height: int, seconds: float, shown: bool) -> dict[str, Any]:
    """A capture of so many seconds; processor and wall time of the recording and of the end."""
    bench = Bench(VirtualClock(100.0))
    camera = LoopedCamera(pixel_format, width, height, bench)
    config = CaptureConfig(duration_s=seconds)
    watch = Display(seconds, 1.0, None, None) if shown else None
    folder = Path(tempfile.mkdtemp(prefix="benchmark-capture-"))
    try:
        with open_flash("manual:", bench) as flash:
            cpu_s, wall_s = time.process_time(), time.monotonic()
            outcome = run_capture(camera, flash, bench, folder / "S", config, watch=watch)
            cpu_s, wall_s = time.process_time() - cpu_s, time.monotonic() - wall_s
        report = outcome.session.info["capture"]
        frames = report["frames"]
        written = sum(path.stat().st_size for path in (folder / "S" / "frames").iterdir())
        return {
            "pixel_format": pixel_format,
            "width": width,
            "height": height,
            "shown": shown,
            "frames": frames,
            "lit": report["light"]["labels"].get("lit", 0),
            "recording_cpu_ms_a_frame": 1e3 * report["cpu_s"] / frames,
            "share_of_a_core_at_30_fps": report["cpu_s"] / frames * _FPS,
            "all_cpu_ms_a_frame": 1e3 * cpu_s / frames,
            "all_wall_s": wall_s,
            "kept_bytes": written,
        }
    finally:
        shutil.rmtree(folder)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seconds", type=float, default=12.0)
    parser.add_argument("--repeats", type=int, default=3)
    args = parser.parse_args()
    cases = [
        ("MJPG", 1920, 1080, False),
        ("MJPG", 1920, 1080, True),
        ("NV12", 1920, 1080, False),
        ("MJPG", 1280, 720, False),
        ("YUYV", 1280, 720, False),
        ("YUYV", 640, 480, False),
    ]
    rows: list[list[dict[str, Any]]] = [[] for _ in cases]
    measure("YUYV", 320, 240, 4.0, True)  # warm-up: imports and caches
    for _ in range(args.repeats):
        for row, case in zip(rows, cases, strict=True):
            row.append(measure(*case[:3], args.seconds, case[3]))
    results = []
    for row in rows:
        shares = [run["share_of_a_core_at_30_fps"] for run in row]
        middle = sorted(row, key=lambda run: run["share_of_a_core_at_30_fps"])[len(row) // 2]
        results.append({**middle, "share_spread": [min(shares), max(shares)]})
        print(
            f"{middle['pixel_format']} {middle['width']}x{middle['height']}"
            f"{' shown' if middle['shown'] else ''}: {statistics.median(shares):.2f} of a core at 30 fps "
            f"({min(shares):.2f}..{max(shares):.2f}), {middle['lit']} lit of {middle['frames']}"
        )
    write_record(args.out, "capture_cost", ["numpy", "opencv-contrib-python-headless"], {"cases": results})


if __name__ == "__main__":
    main()
