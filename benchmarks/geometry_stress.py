"""What the geometry makes of captures that go wrong: a result with its errors, or a refusal that says why.

    python benchmarks/geometry_stress.py [--only NAME] [--full] [--out FILE]

Every scene of `geometry_scenes` goes through the whole fit, each in a process of its own, small ones unless
--full is given. A result is called wrong where the poses are off by more than half a degree or a fiftieth of
the distance, or the portrait shows the validation views at less than 22 dB, and nothing said so: the worst
that can happen. Where a warning says that it may be off, it is called doubted.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from geometry_scenes import scenes
from record import ROOT, write_record

from capture.errors import RelightError
from capture.session import Session
from relight.evaluate import evaluate
from relight.fit import fit
from relight.geometry_plan import GeometryConfig
from relight.stage_cache import StageCache
from relight.stereo import StereoConfig

PACKAGES = ("torch", "numpy", "pycolmap", "opencv-contrib-python-headless")
MOST_ROTATION_DEG = 0.5
MOST_CENTRE_SHARE = 0.02
LEAST_CAPTURED_DB = 22.0
QUICK_REFERENCES = 16  # depth maps: a small capture needs no more to show whether it works


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", action="append", help="scenes to run (default: all)")
    parser.add_argument("--full", action="store_true", help="at full size")
    parser.add_argument("--at-once", type=int, default=2, help="scenes at a time, one thread each")
    parser.add_argument("--one", help=argparse.SUPPRESS)  # a scene, in a process of its own
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "results" / "geometry_stress.json")
    args = parser.parse_args()
    if args.one is not None:
        print(json.dumps(outcome(args.one, quick=not args.full)))
        return
    names = [scene.name for scene in scenes() if not args.only or scene.name in args.only]
    with ThreadPoolExecutor(args.at_once) as pool:
        results = dict(
            zip(names, pool.map(lambda name: in_its_own_process(name, args.full), names), strict=True)
        )
    write_record(args.out, "geometry_stress", PACKAGES, {"full": args.full, "scenes": results})


def in_its_own_process(name: str, full: bool) -> dict[str, Any]:
    """One scene elsewhere; a crash is an outcome too."""
    command = [sys.executable, str(Path(__file__).resolve()), "--one", name, *(["--full"] if full else [])]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    lines = done.stdout.splitlines()
    if done.returncode != 0 or not lines:
        result: dict[str, Any] = {"outcome": "crash", "said": done.stderr.strip().splitlines()[-1:]}
    else:
        result = json.loads(lines[-1])
    print(f"{name:32} {json.dumps(result)}", flush=True)
    return result


def outcome(name: str, quick: bool) -> dict[str, Any]:
    """What becomes of a scene."""
    scene = next(scene for scene in scenes() if scene.name == name)
    about = {"what": scene.what, "expected": scene.expected}
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        try:
            made = scene.make(folder, quick)
            stereo = StereoConfig(references=QUICK_REFERENCES) if quick else StereoConfig()
            fit(made.session, geometry=GeometryConfig(stereo=stereo))
            measured = evaluate(made.session, made.truth)
        except RelightError as refusal:
            return {**about, "outcome": "refusal", "kind": type(refusal).__name__, "said": str(refusal)}
        session = Session.open(made.session)
        cache = StageCache(session)
        metrics = json.loads((session.portraits_dir / "solve" / "metrics.json").read_text())
        said = metrics["warnings"]
        poses = measured["alignment"]
        captured = measured.get("captured", {}).get("psnr_db")
        wrong = (
            poses["rotation_median_deg"] > MOST_ROTATION_DEG
            or poses["centre_median_share"] > MOST_CENTRE_SHARE
            or (captured is not None and captured < LEAST_CAPTURED_DB)
        )
        return {
            **about,
            "outcome": ("doubted" if any(map(_doubts, said)) else "wrong") if wrong else "result",
            "registered": cache.reports()["poses"].get("registered"),
            "rotation_median_deg": poses["rotation_median_deg"],
            "rotation_worst_deg": poses["rotation_worst_deg"],
            "centre_median_share": poses["centre_median_share"],
            "captured_db": captured,
            "normals_deg": measured.get("normals", {}).get("mean_deg"),
            "mask_iou": measured.get("mask", {}).get("iou"),
            "warnings": said,
        }


def _doubts(sentence: str) -> bool:
    """Whether a warning tells the user that poses or portrait may be off."""
    return any(word in sentence for word in ("Look twice", "poses are off", "may be off", "moves against"))


if __name__ == "__main__":
    main()
