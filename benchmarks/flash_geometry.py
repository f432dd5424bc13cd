"""Whether the flash's place is found, and as surely as it is said: many simulated sets of board pictures.

    python -m benchmarks.flash_geometry --out benchmarks/results/flash_geometry.json

Each set has a board of 0.15 x 0.21 m at 0.25 to 0.6 m; squares with 0.3 % noise and 0.3 % texture, pulses
that differ by 1 %, corners found to 0.1 px. The sets are those of `tests/calib/flash/test_flash_fit.py`.
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from scipy.stats import chi2

from benchmarks.record import ROOT, write_record

_NUMBERS = ("x_m", "y_m", "z_m", "axis_x", "axis_y", "falloff", "log_strength", "droop")


def measure(sets: ModuleType, poses: int, trials: int) -> dict[str, Any]:
    """Errors over stated sigmas of many sets."""
    rng = np.random.default_rng(poses)
    errors, sigmas, inside = [], [], 0
    for _ in range(trials):
        fit = sets.fitted(sets.make_boards(rng, poses))[0]
        error = fit.light.vector - sets.TRUTH
        errors.append(error)
        sigmas.append(np.sqrt(np.diag(fit.covariance)))
        inside += bool(error @ np.linalg.solve(fit.covariance, error) < chi2.ppf(0.95, len(error)))
    scores = np.abs(np.array(errors) / np.array(sigmas)) < 1.96
    return {
        "poses": poses,
        "sets": trials,
        "inside_95_jointly": inside / trials,
        "inside_95": dict(zip(_NUMBERS, scores.mean(axis=0).round(3).tolist(), strict=True)),
        "rms_error": dict(zip(_NUMBERS, np.sqrt(np.mean(np.square(errors), axis=0)).tolist(), strict=True)),
        "median_sigma": dict(zip(_NUMBERS, np.median(sigmas, axis=0).tolist(), strict=True)),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--sets", type=int, default=400)
    args = parser.parse_args()
    path = ROOT / "tests" / "calib" / "flash" / "test_flash_fit.py"
    spec = importlib.util.spec_from_file_location("sets", path)
    assert spec is not None
    assert spec.loader is not None
    sets = importlib.util.module_from_spec(spec)
    sys.modules["sets"] = sets
    spec.loader.exec_module(sets)
    rows = [measure(sets, poses, args.sets) for poses in (8, 12, 20)]
    for row in rows:
        print(row)
    write_record(args.out, "flash_geometry", ["numpy", "scipy"], {"cases": rows})


if __name__ == "__main__":
    main()
