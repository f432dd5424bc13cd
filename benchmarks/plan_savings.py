"""What the plan leaves out, against doing it: seconds of the fit and errors, both ways.

    python -m benchmarks.plan_savings --out benchmarks/results/plan_savings.json

Each case is a simulated capture made so that one decision has something to leave out: a hand that stands
still, a dark room, a lens that moves no pixel by a tenth. It is fitted as planned and with the decision
turned round, and both portraits are measured against the same truth. A decision earns its place when its
errors are the same and its seconds are fewer.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from benchmarks.record import spread, write_record
from capture.importers import ImportOptions, import_source
from capture.sim import RigConfig, simulate_posed_set
from relight.evaluate import evaluate
from relight.fit import fit
from relight.plan import Action

_TURNS = 3  # fits of each way
_REPEATS = 8  # views of each place where the hand stands still
_BARELY_BENT = 2e-4  # k1 that moves the corner by some hundredths of a pixel


@dataclass(frozen=True)
class Case:
    """A capture on which one decision has something to leave out.

    Attributes:
        decision: its name in the plan.
        config: of the rig.
        alter: changes the capture's cameras.json, already parsed.
    """

    decision: str
    config: RigConfig
    alter: Callable[[dict[str, Any]], None]


def cases(config: RigConfig) -> list[Case]:
    """One capture a decision."""
    return [
        Case("redundant_views", config, _repeat_unlit),
        Case("room_shading", replace(config, room_level=0.002), lambda _: None),
        Case("undistortion", config, _bend_barely),
    ]


def compare(case: Case, folder: Path) -> dict[str, Any]:
    """Both ways of one decision."""
    truth = folder / "truth"
    cameras_file = simulate_posed_set(truth, case.config)
    cameras = json.loads(cameras_file.read_text())
    case.alter(cameras)
    capture = folder / "capture"
    shutil.copytree(truth, capture)
    (capture / "cameras.json").write_text(json.dumps(cameras))
    session = folder / "S"
    import_source([capture], session, ImportOptions())
    ways = {"planned": {}, "turned_round": {case.decision: Action.RUN}}
    fit(session, name="warm_up", device="cpu")
    # The two take turns, so that whatever else the machine does falls on both.
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(_TURNS):
        for name, forced in ways.items():
            seconds[name].append(_solve_s(fit(session, name=name, forced=forced, device="cpu")))
    measured = {name: _measures(session, truth, name) for name in ways}
    return {
        "decision": case.decision,
        "ways": {name: {"solve_s": spread(seconds[name]), **measured[name]} for name in ways},
    }


def _solve_s(portrait: Path) -> float:
    seconds: dict[str, float] = json.loads((portrait / "metrics.json").read_text())["seconds"]
    return sum(seconds[stage] for stage in ("read", "cloud", "observe", "solve"))


def _measures(session: Path, truth: Path, name: str) -> dict[str, float]:
    result = evaluate(session, truth, name)
    metrics = json.loads((session / "portraits" / name / "metrics.json").read_text())
    return {
        "frames": metrics["frames"],
        "captured_psnr_db": result["captured"]["psnr_db"],
        "albedo_psnr_db": result["albedo"]["psnr_db"],
        "normals_mean_deg": result["normals"]["mean_deg"],
    }


def _repeat_unlit(cameras: dict[str, Any]) -> None:
    """Every unlit training frame again and again, as a hand that stands still gives it."""
    frames = cameras["frames"]
    index = max(frame["index"] for frame in frames)
    for frame in [frame for frame in frames if frame["flash"] == 0 and frame["split"] == "train"]:
        for _ in range(_REPEATS - 1):
            index += 1
            frames.append({**frame, "index": index, "name": f"again_{index:05d}"})


def _bend_barely(cameras: dict[str, Any]) -> None:
    cameras["distortion"] = [_BARELY_BENT, 0.0, 0.0, 0.0]


def main() -> None:
    """Runs all cases and writes the record."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    parser.add_argument("--coarse", action="store_true", help="a coarse rig, to try the script")
    args = parser.parse_args()
    config = RigConfig.small() if args.coarse else RigConfig()
    results = []
    for case in cases(config):
        with tempfile.TemporaryDirectory() as folder:
            results.append(compare(case, Path(folder)))
        _print(results[-1])
    write_record(args.out, "plan_savings", ("numpy", "torch", "scipy"), {"cases": results})


def _print(result: dict[str, Any]) -> None:
    print(result["decision"])
    for way, numbers in result["ways"].items():
        measures = "  ".join(f"{name} {value:.2f}" for name, value in numbers.items() if name != "solve_s")
        print(f"  {way:13} solve_s {numbers['solve_s']['median']:.2f}  {measures}")


if __name__ == "__main__":
    main()
