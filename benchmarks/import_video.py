"""Import of a phone video against bare decoding of the same file: time by stage, peak memory, frames, pulses.

    python -m benchmarks.import_video --out benchmarks/results/import_video.json
    python -m benchmarks.import_video --video VID_20261102_101530.mp4 --out result.json

Without --video a clip of 20 s, 1920 x 1080, 30 fps, H.264 at 17 Mbit/s is made first: a textured scene that
sways as in a hand, noise, a rolling shutter of 20 ms, exposure 5 ms, a flash of 107 ms every 1.003 s.
Decoding and import take turns, each in a process of its own, so that the peak memory is theirs alone. CPU
seconds are given beside wall time, because they depend less on what else the machine does.
"""

from __future__ import annotations

import argparse
import multiprocessing
import tempfile
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np

from benchmarks.record import spread, write_record
from capture.importers.open_camera import import_videos
from capture.importers.options import ImportOptions
from capture.video import VideoWriter

READOUT_S, EXPOSURE_S, PERIOD_S, ON_S, FIRST_S = 0.020, 0.005, 1.003, 0.107, 0.02
WIDTH, HEIGHT, RATE_HZ, BITS_PER_S = 1920, 1080, 30, 17_000_000
PACKAGES = ("av", "numpy", "opencv-contrib-python-headless")
DECODING, LOOKING, TAGGING, WRITING = "decoding", "looking at every frame", "tagging", "writing frames"


def pulse_starts_s(seconds: float) -> np.ndarray:
    """When the flash goes on within a clip."""
    return np.arange(FIRST_S, seconds, PERIOD_S)


def make_clip(path: Path, seconds: float) -> None:
    """Films the scene; light is added in linear light and encoded by BT.709's curve through a table."""
    rng = np.random.default_rng(0)
    canvas = (WIDTH + 240, HEIGHT + 160)
    albedo = np.zeros((canvas[1], canvas[0], 3), np.float32)
    for cell, share in ((4, 0.10), (16, 0.20), (64, 0.30), (256, 0.40)):
        coarse = rng.random((canvas[1] // cell + 2, canvas[0] // cell + 2, 3)).astype(np.float32)
        albedo += share * cv2.resize(coarse, canvas, interpolation=cv2.INTER_CUBIC)
    grain = [rng.normal(0, 60, (HEIGHT, WIDTH, 3)).astype(np.int16) for _ in range(3)]
    levels = np.linspace(0, 1, 4096)
    encoded = np.where(levels < 0.018, 4.5 * levels, 1.099 * levels**0.45 - 0.099)
    code_of_level = np.rint(255 * np.clip(encoded, 0, 1)).astype(np.uint8)
    row_s = np.arange(HEIGHT) / HEIGHT * READOUT_S
    with VideoWriter(
        path, WIDTH, HEIGHT, bit_rate=BITS_PER_S, rotation_deg=90, keyframe_interval=30
    ) as writer:
        for number in range(round(seconds * RATE_HZ)):
            pts_s = number / RATE_HZ
            lit = np.zeros(HEIGHT, np.float32)
            for on_s in pulse_starts_s(seconds):
                start = pts_s + row_s
                overlap = np.minimum(start + EXPOSURE_S, on_s + ON_S) - np.maximum(start, on_s)
                lit += (np.clip(overlap, 0, EXPOSURE_S) / EXPOSURE_S).astype(np.float32)
            x, y = int(120 + 110 * np.sin(1.1 * pts_s)), int(80 + 70 * np.sin(0.7 * pts_s))
            light = 4095 * 0.25 * (1 + 1.2 * lit)[:, None, None]
            linear = (albedo[y : y + HEIGHT, x : x + WIDTH] * light).astype(np.int16)
            writer.write(code_of_level[np.clip(linear + grain[number % 3] // 4, 0, 4095)], pts_s)


def decode(video: Path, _: Path) -> dict[str, Any]:
    """Decodes all frames with FFmpeg's threads and looks at none."""
    with av.open(str(video)) as container:
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        return {"frames": sum(1 for _ in container.decode(stream))}


def import_once(video: Path, folder: Path) -> dict[str, Any]:
    """Imports the clip and notes when each stage began."""
    began: dict[str, tuple[float, float]] = {}

    def note(stage: str, _: float) -> None:
        began.setdefault(stage, (time.perf_counter(), time.process_time()))

    start = time.perf_counter(), time.process_time()
    session = import_videos([video], folder / "S", ImportOptions(), note)
    end = time.perf_counter(), time.process_time()
    marks = [start, began[TAGGING], began[WRITING], end]
    stages = dict(zip((LOOKING, TAGGING, WRITING), pairwise(marks), strict=True))
    return {
        "frames": len(session.frames),
        "kept": sum(record.file is not None for record in session.frames),
        "lit": sum(record.flash == 1 for record in session.frames),
        "partial": sum(record.flash is None for record in session.frames),
        "pulses_on_s": sorted(pulse["t_on_s"] for pulse in session.info["tagging"]["pulses"]),
        "readout_s": session.info["tagging"]["readout_s"],
        "period_s": session.info["tagging"]["period_s"],
        "warnings": session.info["warnings"],
        "stages": {name: {"wall_s": b[0] - a[0], "cpu_s": b[1] - a[1]} for name, (a, b) in stages.items()},
    }


def measured(work: Callable[[Path, Path], dict[str, Any]], video: Path) -> dict[str, Any]:
    """Result, wall and CPU time and peak memory of work in a fresh process."""
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_measure, args=(work, video, sender))
    process.start()
    sender.close()
    result: dict[str, Any] = receiver.recv()
    process.join()
    return result


def _measure(work: Callable[[Path, Path], dict[str, Any]], video: Path, sender: Any) -> None:
    with tempfile.TemporaryDirectory() as folder:
        before_mib = _peak_mib()
        wall, cpu = time.perf_counter(), time.process_time()
        result = work(video, Path(folder))
        result |= {"wall_s": time.perf_counter() - wall, "cpu_s": time.process_time() - cpu}
        result |= {"peak_mib": _peak_mib(), "peak_before_mib": before_mib}
    sender.send(result)


def _peak_mib() -> float:
    """Peak resident memory of this process; unlike getrusage's it does not start at the parent's."""
    lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM"))


def _summary(runs: list[dict[str, Any]], keys: tuple[str, ...]) -> dict[str, dict[str, float]]:
    """Median, least and most of numbers over the runs."""
    return {key: spread([run[key] for run in runs]) for key in keys}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--video", type=Path, help="a video with a blinking flash; default: a clip is made")
    parser.add_argument("--seconds", type=float, default=20.0, help="length of the clip that is made")
    parser.add_argument("--repeats", type=int, default=3, help="turns of decoding and import")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    parser.add_argument("--note", default="", help="what else to remember, as the machine's load")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        video = args.video
        if video is None:
            video = Path(folder) / "VID_20261102_101530.mp4"
            make_clip(video, args.seconds)
        decodings, imports = [], []
        for _ in range(args.repeats):
            decodings.append(measured(decode, video))
            imports.append(measured(import_once, video))
        size = video.stat().st_size
    last = imports[-1]
    stages = {name: [run["stages"][name] for run in imports] for name in (LOOKING, TAGGING, WRITING)}
    times = ("wall_s", "cpu_s")
    results: dict[str, Any] = {
        "note": args.note,
        "video": {"bytes": size, "frames": last["frames"], "made": args.video is None},
        DECODING: _summary(decodings, (*times, "peak_mib")),
        "import": _summary(imports, (*times, "peak_mib", "peak_before_mib")),
        "stages": {name: _summary(runs, times) for name, runs in stages.items()},
        "looking and tagging over decoding": {
            kind: spread(
                [
                    (looking[kind] + tagging[kind]) / decoding[kind]
                    for looking, tagging, decoding in zip(
                        stages[LOOKING], stages[TAGGING], decodings, strict=True
                    )
                ]
            )
            for kind in times
        },
        "found": {key: last[key] for key in ("kept", "lit", "partial", "readout_s", "period_s", "warnings")},
    }
    if args.video is None:
        true = pulse_starts_s(args.seconds)
        error_s = np.array([np.abs(np.array(last["pulses_on_s"]) - on_s).min() for on_s in true])
        results["pulses"] = {
            "true": len(true),
            "found_within_10_ms": int(np.sum(error_s < 0.010)),
            "extra": len(last["pulses_on_s"]) - len(true),
            "median_error_s": float(np.median(error_s)),
        }
    write_record(args.out, "import_video", PACKAGES, results)
    print(args.out.read_text(encoding="utf-8"))


if __name__ == "__main__":
    main()
