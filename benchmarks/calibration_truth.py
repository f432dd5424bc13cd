"""Response, dark level, noise, flat field and colour against their truth: errors beside what is stated.

    python -m benchmarks.calibration_truth --out benchmarks/results/calibration_truth.json

The simulated sensors, walls and charts are those of the tests (tests/calib). For each quantity: the root mean
square of the error and of the stated standard deviation, and how often the error lies within 1.96 of it.
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np

from benchmarks.record import ROOT, write_record
from calib.colour.fit import fit_colour
from calib.response.fit import fit_response
from calib.response.groups import gather_groups
from calib.sensor.flat_field import fit_flat_field
from calib.sensor.noise import fit_dark, fit_noise
from capture.response import Response

Pair = tuple[np.ndarray, np.ndarray]
"""Errors and stated standard deviations of one set."""

SRGB = Response("srgb")


def tests_of(name: str) -> ModuleType:
    """A module of the tests, for what it simulates."""
    path = ROOT / "tests" / "calib" / name
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module
    spec.loader.exec_module(module)
    return module


def response_set(seed: int) -> Pair:
    made = tests_of("response/test_response.py")
    result = fit_response(gather_groups(made.sweep("srgb", seed, jitter=0.005)))
    return made.errors_of(result, "srgb")


def dark_set(seed: int) -> Pair:
    found = fit_dark(tests_of("sensor/test_noise.py").dark_shots(pedestal=0.031, seed=seed))
    return found.level - 0.031, found.sigma


def read_set(seed: int) -> Pair:
    found = fit_noise(tests_of("sensor/test_noise.py").shots(seed), SRGB)
    return found.read - 3.0 / 6000.0, found.read_sigma


def shot_set(seed: int) -> Pair:
    found = fit_noise(tests_of("sensor/test_noise.py").shots(seed), SRGB)
    return found.shot - 1.0 / 6000.0, found.shot_sigma


def flat_set(seed: int) -> Pair:
    made = tests_of("sensor/test_flat_field.py")
    flats = [made.flat(100 * seed + number, bowl=0.02) for number in range(4)]
    corner = np.ones(1)
    passed, sigma = fit_flat_field(flats, SRGB).passed(corner)
    return passed - made.truth(corner), sigma


def colour_set(seed: int) -> Pair:
    made = tests_of("colour/test_colour.py")
    found = fit_colour([made.perfect(noise=0.002, seed=seed)], "after 2014")
    return (found.matrix - made.expected(made.FLASH)).ravel(), found.sigma.ravel()


QUANTITIES: dict[str, Callable[[int], Pair]] = {
    "response (of white; exposures that scatter by 0.5 %)": response_set,
    "dark level (of white)": dark_set,
    "noise at black (of white)": read_set,
    "noise of light (variance over radiance)": shot_set,
    "flat field (corner; four flats under light with a bowl of 2 %)": flat_set,
    "colour matrix (patches with noise of 0.2 % of white)": colour_set,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--sets", type=int, default=20)
    args = parser.parse_args()
    rows = {}
    for name, make in QUANTITIES.items():
        sets = [make(seed) for seed in range(args.sets)]
        error, sigma = (np.concatenate([np.ravel(one[k]) for one in sets]) for k in (0, 1))
        rows[name] = {
            "rms_error": float(np.sqrt(np.mean(error**2))),
            "rms_sigma": float(np.sqrt(np.mean(sigma**2))),
            "inside_95": float((np.abs(error) < 1.96 * sigma).mean()),
        }
        print(name, rows[name], flush=True)
    write_record(args.out, "calibration_truth", ("numpy", "scipy"), {"sets": args.sets, "rows": rows})


if __name__ == "__main__":
    main()
