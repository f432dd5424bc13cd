"""How far the stated standard errors of a portrait are from its true errors.

    python -m benchmarks.stated_errors S/portraits/fast --out benchmarks/results/stated_errors.json

On portrait_A (skipped with a word where it is not there), every third validation view, inside the true mask:
the splatted albedo (mean of the channels, after one scale a channel) and the angle of the normals, each over
the standard error of the point that is seen. Known points are those that the flash tells, the others are
filled in.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.record import ROOT, write_record
from relight.confidence import confidence_maps
from relight.maps import splat_maps
from relight.metrics import channel_scales
from relight.portrait import load_portrait
from relight.truth import load_truth

_EVERY = 3
_SHARE = 0.68


def main() -> None:
    """Measures and writes it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    default = os.environ.get("RELIGHT_PORTRAIT_A", ROOT.parent / "shared" / "portrait_A")
    parser.add_argument("portrait", type=Path)
    parser.add_argument("--portrait-a", type=Path, default=Path(default))
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    if not (args.portrait_a / "cameras.json").is_file():
        print(f"skipped: there is no portrait_A in {args.portrait_a}")
        return
    portrait = load_portrait(args.portrait)
    columns: dict[str, list[Any]] = {
        name: [] for name in ("ours", "true", "sigma", "angle", "turn", "filled")
    }
    for view in load_truth(args.portrait_a).views[::_EVERY]:
        maps = splat_maps(portrait, view.camera)
        told = {name: image.numpy() for name, image in confidence_maps(portrait, maps).items()}
        on = (view.mask() >= 254 / 255) & (maps.point_ids.numpy() >= 0)
        cosine = (maps.normals_world.numpy() * view.normals_world()).sum(axis=-1).clip(-1.0, 1.0)
        for name, image in (
            ("ours", maps.albedo.numpy()),
            ("true", view.albedo()),
            ("sigma", told["albedo_sigma"]),
            ("angle", np.arccos(cosine)),
            ("turn", told["normal_sigma"]),
            ("filled", told["unobserved_flash"] > 0.5),
        ):
            columns[name].append(image[on])
    ours, true, sigma, angle, turn, filled = (np.concatenate(parts) for parts in columns.values())
    scales = channel_scales(ours, true)
    off = np.abs((ours * scales - true).mean(axis=1)) / scales.mean()
    rows = {}
    for name, ratio in (("albedo", off / sigma), ("normal", angle / turn)):
        for kind, chosen in (("known", ~filled), ("filled in", filled)):
            rows[f"{name}, {kind}"] = {
                "pixels": int(chosen.sum()),
                **{f"within_{k}": round(float((ratio[chosen] < k).mean()), 3) for k in (1, 2, 3)},
                "sigmas_68": round(float(np.quantile(ratio[chosen], _SHARE)), 2),
            }
            print(f"{name}, {kind}", rows[f"{name}, {kind}"], flush=True)
    write_record(args.out, "stated_errors", ["torch", "numpy"], rows)


if __name__ == "__main__":
    main()
