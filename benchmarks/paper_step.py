"""Where the time of one step of the preset `paper` goes, in seconds of the processor.

    python -m benchmarks.paper_step SESSION --out benchmarks/results/paper_step.json

SESSION has a portrait "solve"; its face is used if one was found. Measured are a whole step, and its parts by
themselves: rasterising the patch, looking descriptors up and back, network and back in both precisions and
both layouts of memory, and the mismatch and back. Processor seconds, the least of several repeats, on one
thread: a machine that does other things lengthens them least.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path

import torch

from benchmarks.record import write_record
from capture.session import Session
from relight.face.store import load_face
from relight.neural.crops import random_crop
from relight.neural.frames import FrameStore
from relight.neural.paper.config import PRECISIONS, PaperConfig
from relight.neural.paper.fitting import PaperFit
from relight.neural.paper.model import LEVELS, rendering_network
from relight.neural.perceptual import laplacian_perceptual
from relight.neural.raw_images import raw_images
from relight.portrait import load_portrait
from relight.raster import rasterize_ids
from relight.scene import load_scene

PATCHES_PX = (256, 512)


def least_s(work: Callable[[], object], repeats: int) -> float:
    """Processor seconds after a first time that warms up."""
    work()
    times = []
    for _ in range(repeats):
        started_s = time.process_time()
        work()
        times.append(time.process_time() - started_s)
    return min(times)


def network_s(images: list[torch.Tensor], precision: str, layout: torch.memory_format, repeats: int) -> float:
    """Forth and back through the network."""
    network = rendering_network(torch.Generator().manual_seed(0)).to(memory_format=layout)
    inputs = [image.detach().contiguous(memory_format=layout).requires_grad_(True) for image in images]

    def work() -> None:
        with torch.autocast("cpu", torch.bfloat16, enabled=precision == "bfloat16"):
            channels = network(inputs)
        channels.float().abs().mean().backward()

    return least_s(work, repeats)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("session", type=Path)
    parser.add_argument("--repeats", type=int, default=8)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    torch.set_num_threads(1)
    session = Session.open(args.session)
    plan = json.loads((session.portraits_dir / "solve" / "plan.json").read_text())
    scene, solved = (
        load_scene(session, frames=plan["frames"]),
        load_portrait(session.portraits_dir / "solve"),
    )
    face = load_face(session.scene_dir / "face") if (session.scene_dir / "face").is_dir() else None
    store, view = FrameStore(scene, solved), scene.views[len(scene.views) // 2]
    results = {}
    for size in PATCHES_PX:
        crop = random_crop(store.subject(view), size, (0.9, 1.1), torch.Generator().manual_seed(0))
        camera = crop.camera(view.camera)
        ids = rasterize_ids(solved.points, camera, LEVELS).ids
        descriptors = torch.zeros(len(solved.points), 8, requires_grad=True)
        images = raw_images(descriptors, ids)
        first, second = torch.rand(2, 1, 3, size, size)
        first.requires_grad_(True)

        def looked_up(descriptors: torch.Tensor = descriptors, ids: tuple[torch.Tensor, ...] = ids) -> None:
            sum(image.sum() for image in raw_images(descriptors, ids)).backward()

        parts = {
            "rasterise": least_s(
                lambda camera=camera: rasterize_ids(solved.points, camera, LEVELS), args.repeats
            ),
            "descriptors": least_s(looked_up, args.repeats),
            "mismatch": least_s(
                lambda a=first, b=second: laplacian_perceptual(a, b).backward(), args.repeats
            ),
        }
        for precision in PRECISIONS:
            for name, layout in (("rows", torch.contiguous_format), ("channels_last", torch.channels_last)):
                parts[f"network {precision} {name}"] = network_s(images, precision, layout, args.repeats)
            config = PaperConfig(crop=size, precision=precision)
            fit = PaperFit(scene, solved, config, laplacian_perceptual, face, 0)
            parts[f"step {precision}"] = least_s(fit.advance, args.repeats)
        results[str(size)] = {name: round(seconds, 4) for name, seconds in parts.items()}
        for name, seconds in parts.items():
            print(f"{size} px  {name:32} {1e3 * seconds:8.1f} ms", flush=True)
    if args.out:
        facts = {"points": len(solved.points), "face": face is not None, "repeats": args.repeats}
        write_record(args.out, "paper_step", ["torch"], {**facts, "processor_s": results})


if __name__ == "__main__":
    main()
