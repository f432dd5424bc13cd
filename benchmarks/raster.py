"""Points per second of the rasteriser, as points and pixels grow, on one core.

    python -m benchmarks.raster --out benchmarks/results/raster.json
    python -m benchmarks.raster --device cuda --out result.json

The points lie on a bumpy sphere that fills the picture. Measured are: the pass over the points for three
sizes of picture, in Morton order (neighbours in space lie together in memory) and in random order; a pyramid
of five scales against five separate passes; and the fast path beside the plain one, whose ids must be the
same. The time of one bare read of the points stands beside: no rasteriser is faster than that.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.record import spread, write_record
from capture.cameras import Camera
from relight.raster import rasterize_ids, rasterize_ids_reference

COUNTS = (10_000, 100_000, 1_000_000, 10_000_000)
SIZES_PX = (256, 512, 1024)
LEVELS = 5  # the paper's S[0..4]


def bumpy_sphere(count: int, seed: int = 0) -> np.ndarray:
    """Points [count, 3] float32 in random order, radius about 0.1 m."""
    random = np.random.default_rng(seed)
    points = random.normal(size=(count, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    radius = 0.1 * (1 + 0.05 * np.sin(20 * points).sum(axis=1))
    return (radius[:, None] * points).astype(np.float32)


def morton_order(points: np.ndarray) -> np.ndarray:
    """Indices [P] that sort points along a Z-order curve of 1024 cells a side (Morton 1966)."""
    low = points.min(axis=0)
    cells = ((points - low) / (points.max(axis=0) - low).max() * 1023).astype(np.uint64)
    code = np.zeros(len(points), np.uint64)
    for bit in range(10):
        for axis in range(3):
            code |= (cells[:, axis] >> np.uint64(bit) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return np.argsort(code, kind="stable")


def head_camera(size_px: int) -> Camera:
    """Looks at the sphere from half a metre; it fills most of the picture."""
    cam_from_world = np.eye(4)
    cam_from_world[2, 3] = 0.5
    K = np.array([[2.0 * size_px, 0, size_px / 2], [0, 2.0 * size_px, size_px / 2], [0, 0, 1]])
    return Camera("head", size_px, size_px, K, cam_from_world)


def timed(work: Callable[[], object], device: torch.device, repeats: int) -> dict[str, float]:
    """Wall-clock seconds, median and spread; on a card until it has finished."""
    times = []
    for repeat in range(repeats + 1):  # the first warms up
        started_s = time.perf_counter()
        work()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        if repeat:
            times.append(time.perf_counter() - started_s)
    return spread(times)


def separate_passes(points: torch.Tensor, camera: Camera) -> None:
    """The pyramid as S[0], ..., S[4] each by a pass of its own."""
    for level in range(LEVELS):
        rasterize_ids(points, camera.scaled(0.5**level))


def growth(points: dict[str, torch.Tensor], size_px: int, repeats: int) -> dict[str, Any]:
    """Times of one count of points and one size of picture."""
    camera = head_camera(size_px)
    device = points["random"].device
    row: dict[str, Any] = {"points": len(points["random"]), "pixels": size_px**2}
    for order, ordered in points.items():
        seconds = timed(lambda ordered=ordered: rasterize_ids(ordered, camera), device, repeats)
        row[order] = {"seconds": seconds, "points_per_s": len(ordered) / seconds["median"]}
    row["random over morton"] = row["random"]["seconds"]["median"] / row["morton"]["seconds"]["median"]
    return row


def pyramid(points: torch.Tensor, size_px: int, repeats: int) -> dict[str, Any]:
    """A pyramid in one pass against one pass a scale."""
    camera = head_camera(size_px)
    one = timed(lambda: rasterize_ids(points, camera), points.device, repeats)
    together = timed(lambda: rasterize_ids(points, camera, LEVELS), points.device, repeats)
    apart = timed(lambda: separate_passes(points, camera), points.device, repeats)
    return {
        "points": len(points),
        "pixels": size_px**2,
        "levels": LEVELS,
        "one scale": one,
        "pyramid": together,
        "separate passes": apart,
        "separate over pyramid": apart["median"] / together["median"],
        "pyramid over one scale": together["median"] / one["median"],
    }


def against_reference(points: torch.Tensor, size_px: int) -> dict[str, Any]:
    """The fast path beside the plain one, and whether both give the same ids."""
    camera = head_camera(size_px)
    array = points.cpu().numpy()
    started_s = time.perf_counter()
    plain = rasterize_ids_reference(array, camera, LEVELS)
    plain_s = time.perf_counter() - started_s
    fast = rasterize_ids(points, camera, LEVELS)
    seconds = timed(lambda: rasterize_ids(points, camera, LEVELS), points.device, 5)
    # float32 may move a projection across a border of a pixel where float64 does not.
    differing = [float((a.cpu().numpy() != b).mean()) for a, b in zip(fast.ids, plain, strict=True)]
    return {
        "points": len(points),
        "pixels": size_px**2,
        "plain_s": plain_s,
        "fast": seconds,
        "plain over fast": plain_s / seconds["median"],
        "share of pixels that differ": differing,
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--threads", type=int, default=1, help="threads of torch on the CPU")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--largest", type=int, default=COUNTS[-1], help="most points")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    parser.add_argument("--note", default="", help="what else to remember, as the machine's load")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    device = torch.device(args.device)
    rows: list[dict[str, Any]] = []
    reads: dict[str, Any] = {}
    for count in (count for count in COUNTS if count <= args.largest):
        cloud = bumpy_sphere(count)
        points = {
            "random": torch.from_numpy(cloud).to(device),
            "morton": torch.from_numpy(cloud[morton_order(cloud)]).to(device),
        }
        reads[str(count)] = timed(points["random"].sum, device, args.repeats)
        for size_px in SIZES_PX:
            rows.append(growth(points, size_px, args.repeats))
            row = rows[-1]
            rates = ", ".join(
                f"{order} {row[order]['points_per_s'] / 1e6:6.1f} M/s" for order in ("random", "morton")
            )
            print(f"{count:>11,} points, {size_px:4d}^2 pixels: {rates}")
    middle = torch.from_numpy(bumpy_sphere(1_000_000)).to(device)
    few = torch.from_numpy(bumpy_sphere(20_000)).to(device)
    results = {
        "device": str(device),
        "threads": args.threads,
        "note": args.note,
        "growth": rows,
        "one read of the points": reads,
        "pyramid": [pyramid(middle, size_px, args.repeats) for size_px in SIZES_PX],
        "against the reference": against_reference(few, 256),
    }
    for row in results["pyramid"]:
        print(
            f"{row['pixels']:>11,} pixels: five passes take {row['separate over pyramid']:.2f} x the pyramid"
        )
    print(f"the plain path takes {results['against the reference']['plain over fast']:.0f} x the fast one")
    write_record(args.out, "raster", ("torch", "numpy"), results)


if __name__ == "__main__":
    main()
