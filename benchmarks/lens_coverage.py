"""Whether the lens's stated uncertainty is right: how often its 95 % regions hold the truth.

    python -m benchmarks.lens_coverage --out benchmarks/results/lens_coverage.json

Fourteen pictures a set of a board of 5 x 7 squares, corners with 0.15 px of noise, a lens of 480 x 360 pixels
with four distortion terms, fitted from the truth. The sets are those of `tests/calib/conftest.py`.
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from benchmarks.record import ROOT, write_record
from calib.lens.bundle import Solution, minimise, observations_of
from calib.lens.models import free_of
from calib.lens.terms import LENS_NAMES
from calib.lens.uncertainty import uncertainty_of

NOISE_PX, VIEWS = 0.15, 14


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--sets", type=int, default=200)
    args = parser.parse_args()
    spec = importlib.util.spec_from_file_location("boards", ROOT / "tests" / "calib" / "conftest.py")
    assert spec is not None
    assert spec.loader is not None
    boards = importlib.util.module_from_spec(spec)
    sys.modules["boards"] = boards
    spec.loader.exec_module(boards)
    free = free_of("k1k2p1p2", False)
    rng = np.random.default_rng(44)
    jointly, singly, errors, sigmas = 0, np.zeros(len(free)), [], []
    for _ in range(args.sets):
        views, poses = [], []
        while len(views) < VIEWS:
            pose = boards.random_pose(rng)
            view = boards.see(boards.BOARD, pose, boards.LENS, rng, NOISE_PX, boards.SIZE)
            if view is not None:
                views.append(view)
                poses.append(pose)
        observations = observations_of(views, boards.BOARD)
        start = Solution(
            np.concatenate([boards.LENS, [0.0, 0.0]]),
            np.array([rotation for rotation, _ in poses]),
            np.array([translation for _, translation in poses]),
            np.zeros_like(observations.pixels),
            np.inf,
        )
        found = minimise(observations, start, free)
        covariance = uncertainty_of(observations, found, free).covariance[np.ix_(free, free)]
        off = (found.lens - boards.LENS)[free]
        sigma = np.sqrt(np.diag(covariance))
        jointly += int(off @ np.linalg.solve(covariance, off) < chi2.ppf(0.95, len(free)))
        singly += np.abs(off) < 1.96 * sigma
        errors.append(off)
        sigmas.append(sigma)
    names = [LENS_NAMES[number] for number in free]
    results = {
        "sets": args.sets,
        "inside_95_jointly": jointly / args.sets,
        "inside_95": dict(zip(names, (singly / args.sets).tolist(), strict=True)),
        "rms_error": dict(zip(names, np.sqrt(np.mean(np.square(errors), 0)).tolist(), strict=True)),
        "median_sigma": dict(zip(names, np.median(sigmas, 0).tolist(), strict=True)),
    }
    print(results)
    write_record(args.out, "lens_coverage", ("numpy", "scipy", "opencv-contrib-python-headless"), results)


if __name__ == "__main__":
    main()
