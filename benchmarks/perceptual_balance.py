"""What the weight-free perceptual term weighs beside the paper's 2500 times an L1, by kind of mismatch.

    python -m benchmarks.perceptual_balance SESSION --out benchmarks/results/perceptual_balance.json

The paper chose beta = 2500 so that VGG and the L1 of pooled pictures have one range. VGG's weights are not
ours, so the term that stands in for it is scaled to the same end: over patches of a session's frames, against
the solved portrait's pictures of them and against blurred ones, the two should be about equal. SESSION has a
portrait "solve".
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import torch

from benchmarks.record import write_record
from capture.session import Session
from relight.lighting import CapturedLight
from relight.neural.crops import random_crop
from relight.neural.display import display_values
from relight.neural.frames import FrameStore
from relight.neural.losses.mismatch import BETA, pooled_l1
from relight.neural.perceptual import laplacian_perceptual
from relight.portrait import load_portrait
from relight.render import render_view
from relight.scene import load_scene

PATCH_PX = 256
EVERY = 9


def blurred(picture: torch.Tensor, pixels: int) -> torch.Tensor:
    """A picture [1, 3, H, W] under a box."""
    return torch.nn.functional.avg_pool2d(picture, pixels, 1, pixels // 2, count_include_pad=False)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("session", type=Path)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    session = Session.open(args.session)
    plan = json.loads((session.portraits_dir / "solve" / "plan.json").read_text())
    scene = load_scene(session, frames=plan["frames"])
    solved = load_portrait(session.portraits_dir / "solve")
    store, chance = FrameStore(scene, solved), torch.Generator().manual_seed(0)
    terms: dict[str, list[tuple[float, float]]] = {}
    for view in scene.views[::EVERY]:
        _, radiances = render_view(solved, view.camera, {"captured": CapturedLight()}, flash=view.flash)
        crop = random_crop(store.subject(view), PATCH_PX, (0.5, 2.0), chance)
        target = store.patch(view, crop)
        sure = target.valid * target.mask
        truth = (display_values(target.radiance) * sure)[None]
        solve = (display_values(crop.of(radiances["captured"].permute(2, 0, 1))) * sure)[None]
        cases = {
            "solve": solve,
            "blurred over 5 pixels": blurred(truth, 5),
            "blurred over 11 pixels": blurred(truth, 11),
            "5 % brighter": 1.05 * truth,
            "grey": 0.5 * sure.expand_as(truth[0])[None],
        }
        for name, picture in cases.items():
            pair = float(laplacian_perceptual(picture, truth)), BETA * float(pooled_l1(picture, truth))
            terms.setdefault(name, []).append(pair)
    rows = {}
    for name, pairs in terms.items():
        perceptual, colour = np.array(pairs).T
        ratio = float(np.median(perceptual / colour))
        rows[name] = {"perceptual": perceptual.mean(), "beta_l1": colour.mean(), "median_ratio": ratio}
        print(
            f"{name:24} perceptual {perceptual.mean():7.2f}, 2500 L1 {colour.mean():7.2f}, ratio {ratio:.2f}"
        )
    if args.out:
        results = {"patch_px": PATCH_PX, "mismatches": rows}
        write_record(args.out, "perceptual_balance", ["torch"], results)


if __name__ == "__main__":
    main()
