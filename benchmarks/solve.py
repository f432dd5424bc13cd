"""Seconds a stage and peak memory of the photometric solve, on a subject of formulas and on portrait_A.

    python -m benchmarks.solve --out benchmarks/results/solve.json

The subject of formulas (tests/relight/analytic_scene.py) is filmed in 70 frames of 512 x 512 pixels, every
fifth with the flash, and given as a cloud of 200,000 points with 0.5 mm of noise. portrait_A is looked for in
../shared/portrait_A or where RELIGHT_PORTRAIT_A says, imported, and left out with a word where it is missing.
Every run is a process of its own, so that its peak memory is its alone; frames are read from a session's PNGs
or JPEGs as in a fit. Errors against the truth stand beside the times: a faster solve has to keep them.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import resource
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.record import ROOT, spread, write_record
from capture.importers import import_source
from capture.importers.options import ImportOptions
from capture.ply import PointCloud
from capture.session import Session
from relight.photometric import solve
from relight.portrait import Portrait
from relight.scene import load_scene

sys.path.append(str(ROOT / "tests" / "relight"))
from analytic_scene import C_FLASH, Head, arc, cloud_of, photograph, with_noise, write_session

FRAMES, EVERY, SIZE_PX, POINTS, NOISE_M = 70, 5, 512, 200_000, 0.0005


def film(folder: Path, frames: int, size_px: int, points: int) -> dict[str, Any]:
    """Makes the session of the subject of formulas."""
    head = Head()
    shots = []
    for number, camera in enumerate(arc(frames, EVERY, size_px)):
        frame = photograph(head, camera)
        noisy = (with_noise(frame.radiance, 0.01, number) * frame.hit[..., None]).astype(np.float32)
        nothing = noisy[:0]  # only what is written is kept
        shots.append(replace(frame, radiance=noisy, points=nothing, normals=nothing, albedo=nothing))
    cloud, normals = cloud_of(head, points, NOISE_M)
    del normals  # as dense stereo gives it
    write_session(folder, shots, PointCloud(cloud, None, None))
    return {}


def import_quietly(source: Path, folder: Path) -> dict[str, Any]:
    """Makes the session of a posed image set."""
    import_source([source], folder, ImportOptions())
    return {}


def errors_of(portrait: Portrait) -> dict[str, float]:
    """Median errors at the points that the flash knows well, against the formulas."""
    head, known = Head(), portrait.confidence.numpy() > 0.6
    points = portrait.points.double().numpy()[known]
    normals = (head.normals(points) * portrait.normals_world.numpy()[known]).sum(axis=1)
    product = portrait.albedo.numpy()[known] * portrait.c_flash / (C_FLASH * head.albedo(points))
    return {
        "normals_deg": float(np.degrees(np.median(np.arccos(np.clip(normals, -1, 1))))),
        "albedo_relative": float(np.median(np.abs(product - 1))),
    }


def run(session: Path, analytic: bool, threads: int, device: str) -> dict[str, Any]:
    """Loads and solves a session in this process."""
    torch.set_num_threads(threads)
    opened = Session.open(session)
    frames = [record.index for record in opened.frames if record.usable and record.split != "val"]
    before_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6
    began: list[tuple[str, float]] = []

    def note(stage: str, _: float) -> None:
        if not began or began[-1][0] != stage:
            began.append((stage, time.perf_counter()))

    started_s, started_cpu_s = time.perf_counter(), time.process_time()
    scene = load_scene(opened, frames=frames, device=device, progress=note)
    portrait = solve(scene, progress=note)
    ended_s, ended_cpu_s = time.perf_counter(), time.process_time()
    ends = [time_s for _, time_s in began[1:]] + [ended_s]
    stages: dict[str, float] = {}
    for (stage, start_s), end_s in zip(began, ends, strict=True):
        stages[stage] = stages.get(stage, 0.0) + end_s - start_s
    result: dict[str, Any] = {
        "frames": len(frames),
        "points given": len(scene.points),
        "points solved": len(portrait.points),
        "wall_s": ended_s - started_s,
        "cpu_s": ended_cpu_s - started_cpu_s,
        "stages_s": stages,
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6,
        "peak_before_mb": before_mb,
    }
    if device != "cpu":
        result["peak_cuda_mb"] = torch.cuda.max_memory_allocated() / 1e6
    return result | ({"errors": errors_of(portrait.to("cpu"))} if analytic else {})


def alone(work: Callable[..., dict[str, Any]], *arguments: Any) -> dict[str, Any]:
    """The result of work in a fresh process."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(work, arguments)


def summary(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Median and spread over the runs, and what is the same in all of them."""
    last = runs[-1]
    spreads = {
        key: spread([r[key] for r in runs]) for key in ("wall_s", "cpu_s", "peak_mb", "peak_before_mb")
    }
    spreads["stages_s"] = {stage: spread([r["stages_s"][stage] for r in runs]) for stage in last["stages_s"]}
    same = {key: last[key] for key in last if key not in spreads}
    return same | spreads


def portrait_a() -> Path | None:
    """The folder of portrait_A, None where there is none."""
    folder = Path(os.environ.get("RELIGHT_PORTRAIT_A", ROOT.parent / "shared" / "portrait_A"))
    return folder if (folder / "cameras.json").is_file() else None


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--repeats", type=int, default=3, help="runs; one more before them warms the files up"
    )
    parser.add_argument("--threads", type=int, default=os.cpu_count(), help="threads of torch")
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--frames", type=int, default=FRAMES)
    parser.add_argument("--size", type=int, default=SIZE_PX, help="sides of a frame, pixels")
    parser.add_argument("--points", type=int, default=POINTS)
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    parser.add_argument("--note", default="", help="what else to remember, as the machine's load")
    args = parser.parse_args()
    results: dict[str, Any] = {"note": args.note, "device": args.device, "threads": args.threads}
    with tempfile.TemporaryDirectory() as scratch:
        scenes = {"formulas": Path(scratch) / "formulas"}
        # Apart: a process begins with the peak memory of the one that starts it.
        alone(film, scenes["formulas"], args.frames, args.size, args.points)
        source = portrait_a()
        if source is None:
            print("portrait_A is not here; set RELIGHT_PORTRAIT_A to its folder to solve it too.")
        else:
            scenes["portrait_A"] = Path(scratch) / "portrait_A"
            alone(import_quietly, source, scenes["portrait_A"])
        for name, session in scenes.items():
            runs = [
                alone(run, session, name == "formulas", args.threads, args.device)
                for _ in range(args.repeats + 1)
            ]
            results[name] = summary(runs[1:])
            stages = ", ".join(f"{k} {v['median']:.1f}" for k, v in results[name]["stages_s"].items())
            print(
                f"{name}: {results[name]['wall_s']['median']:.1f} s ({stages}), "
                f"{results[name]['cpu_s']['median']:.1f} CPU s, {results[name]['peak_mb']['max']:,.0f} MB, "
                f"{results[name]['points given']:,} points x {results[name]['frames']} frames"
                f"{', errors ' + str(results[name]['errors']) if 'errors' in results[name] else ''}"
            )
    write_record(args.out, "solve", ("torch", "numpy", "scipy"), results)


if __name__ == "__main__":
    main()
