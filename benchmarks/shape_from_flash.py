"""What normals from heights are worth, and what bounces cost where none are, on heads of the simulated rig.

    python -m benchmarks.shape_from_flash --seeds 0 1 3 5 --out benchmarks/results/shape_from_flash.json

Each head (hair, eyes, gloss, sensor noise) is a posed set of 45 frames of 240 x 320 pixels, nine with the
flash, with a cloud of 60,000 noisy points; the portraits are measured at the set's validation views. The
rig's light does not bounce.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks.record import write_record
from capture.importers import import_source
from capture.importers.options import ImportOptions
from capture.sim import RigConfig
from capture.sim.simulate import simulate_posed_set
from relight.evaluate import portrait_renderer
from relight.measure import measure
from relight.photometric import SolveConfig, solve
from relight.scene import load_scene
from relight.shape_from_flash import ShapeConfig
from relight.truth import load_truth

_SIZE: dict[str, Any] = {"width": 240, "height": 320, "focal_px": 345.0, "posed_frames": 45}
_COARSE: dict[str, Any] = {"shadow_directions": 40, "strands": 5000, "cloud_points": 60_000, "cell_mm": 3.0}
_SOLVES: dict[str, dict[str, Any]] = {
    "points alone": {},
    "heights": {"shape": ShapeConfig()},
    "heights, without bounces": {"shape": ShapeConfig(), "bounces": False},
}


def main() -> None:
    """Solves each head in every way and writes the measures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 3, 5])
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    heads: dict[str, Any] = {}
    for seed in args.seeds:
        with tempfile.TemporaryDirectory() as folder:
            heads[str(seed)] = _head(seed, Path(folder))
        print(seed, heads[str(seed)], flush=True)
    write_record(args.out, "shape_from_flash", ["numpy", "scipy", "torch"], {"heads": heads})


def _head(seed: int, folder: Path) -> dict[str, Any]:
    config = replace(RigConfig.from_seed(seed), **_SIZE, **_COARSE)
    cameras = simulate_posed_set(folder / "set", config)
    session = import_source([cameras], folder / "S", ImportOptions(points=folder / "set" / "points.ply"))
    frames = [record.index for record in session.frames if record.split != "val"]
    scene, truth = load_scene(session, frames=frames), load_truth(folder / "set")
    results = {}
    for name, changes in _SOLVES.items():
        started = time.process_time()
        portrait = solve(scene, SolveConfig(**changes))
        seconds = time.process_time() - started
        measures = measure(truth, portrait_renderer(portrait))
        results[name] = {
            "cpu_s": round(seconds, 2),
            "bounce_scale": round(portrait.bounce_scale, 3),
            "normals_mean_deg": round(measures["normals"]["mean_deg"], 3),
            "normals_median_deg": round(measures["normals"]["median_deg"], 3),
            "albedo_psnr_db": round(measures["albedo"]["psnr_db"], 2),
            "captured_psnr_db": round(measures["captured"]["psnr_db"], 2),
        }
    return results


if __name__ == "__main__":
    main()
