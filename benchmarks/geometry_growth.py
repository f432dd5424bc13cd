"""How time and memory of each stage grow with frames, pixels and points, when nothing is given.

    python benchmarks/geometry_growth.py [--out benchmarks/results/geometry_growth.json]

One film of the simulated rig, imported at several rates (frames) and several sizes (pixels); and the stages
that take a cloud, with clouds thinned to several sizes (points). Each row is one process, so that its memory
is its own.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from record import ROOT, write_record

from capture.frame_record import FrameRecord
from capture.importers import ImportOptions, import_source
from capture.ply import read_ply, write_ply
from capture.session import Session
from capture.sim import RigConfig, simulate_video
from relight.fit import fit
from relight.stage_cache import StageCache

PACKAGES = ("torch", "numpy", "pycolmap", "opencv-contrib-python-headless")
RATES_HZ = (2.0, 5.0, 11.0)
SCALES = (0.5,)  # beside the middle rate at full size
POINT_SHARES = (0.25,)
FILM_S = 16.0


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--one", type=Path, help=argparse.SUPPRESS)  # a row, in a process of its own
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "results" / "geometry_growth.json")
    args = parser.parse_args()
    if args.one is not None:
        print(json.dumps(row(args.one)))
        return
    with tempfile.TemporaryDirectory() as scratch:
        results = run_all(Path(scratch), args.seed)
    write_record(args.out, "geometry_growth", PACKAGES, results)


def run_all(scratch: Path, seed: int) -> dict[str, Any]:
    """All rows, by what grows."""
    config = RigConfig.from_seed(seed)
    film = simulate_video(scratch / "film", replace(config, path=replace(config.path, duration_s=FILM_S)))
    frames = {}
    for rate_hz in RATES_HZ:
        session = scratch / f"rate_{rate_hz:g}"
        import_source([film], session, ImportOptions(kept_rate_hz=rate_hz))
        frames[f"{rate_hz:g} Hz"] = in_its_own_process(session)
    middle = scratch / f"rate_{RATES_HZ[1]:g}"
    pixels = {"1": frames[f"{RATES_HZ[1]:g} Hz"]}
    for scale in SCALES:
        session = resized(middle, scratch / f"scale_{scale:g}", scale)
        pixels[f"{scale:g}"] = in_its_own_process(session)
    points = {}
    for share in POINT_SHARES:
        session = thinned(middle, scratch / f"points_{share:g}", share)
        points[f"{share:g}"] = in_its_own_process(session)
    return {"frames": frames, "pixels": pixels, "points": points}


def in_its_own_process(session: Path) -> dict[str, Any]:
    """Fits a session elsewhere and reads what it took."""
    command = [sys.executable, str(Path(__file__).resolve()), "--one", str(session)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    result: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    print(json.dumps(result), flush=True)
    return result


def row(folder: Path) -> dict[str, Any]:
    """Fits, and says how much there was and what each stage took."""
    portrait = fit(folder)
    metrics = json.loads((portrait / "metrics.json").read_text())
    session = Session.open(folder)
    record = next(record for record in session.frames if record.usable)
    reports = StageCache(session).reports()
    return {
        "frames": sum(record.usable for record in session.frames),
        "pixels": record.width * record.height,
        "cloud_points": len(read_ply(session.points_path).points),
        "portrait_points": metrics["points"],
        "seconds": metrics["seconds"],
        "memory_mb": metrics["stage_memory_mb"],
        "total_s": metrics["total_s"],
        "stages": sorted(reports),
    }


def resized(source: Path, target: Path, scale: float) -> Path:
    """A session with the same frames, smaller."""
    original = Session.open(source)
    image = original.info["image"]
    width, height = round(image["width"] * scale), round(image["height"] * scale)
    with Session.create(
        target, source={"kind": "images"}, width=width, height=height, transfer=image["transfer"]
    ) as session:
        for record in original.frames:
            if not record.usable:
                continue
            picture = original.load_image(record)
            small = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
            file = session.write_frame(record.index, small)
            session.append_frame(
                FrameRecord(
                    index=record.index,
                    file=file,
                    width=width,
                    height=height,
                    flash=record.flash,
                    pts_s=record.pts_s,
                    sharpness=record.sharpness,
                )
            )
    return target


def thinned(source: Path, target: Path, share: float) -> Path:
    """A session with the poses and a part of the cloud that another one found: masks and the rest follow."""
    resized(source, target, 1.0)
    original, session = Session.open(source), Session.open(target)
    session.save_scene_cameras(original.load_scene_cameras())
    cloud = read_ply(original.dense_path)
    keep = np.random.default_rng(0).random(len(cloud.points)) < share
    assert cloud.normals is not None
    write_ply(session.points_path, replace(cloud, points=cloud.points[keep], normals=cloud.normals[keep]))
    return target


if __name__ == "__main__":
    main()
