"""What an update of the descriptors costs: of all of them, or of those that a patch has seen.

    OMP_NUM_THREADS=1 python -m benchmarks.descriptor_updates --out benchmarks/results/descriptor_updates.json

Both take a gradient of the descriptors of a patch's pixels. `all` is what the fits do: the gradient is spread
over a table of every point, and a fused Adam goes through it from end to end. `seen` gathers the gradient by
point, and moves the moments and values of those points alone (a lazy Adam; its moments do not fade while a
point is unseen). Points are drawn as a patch of portrait_A sees them: each once or twice.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import torch

from benchmarks.record import write_record

_RATE, _FIRST, _SECOND, _LEAST = 1e-2, 0.9, 0.999, 1e-8


def main() -> None:
    """Times both and writes them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--points", type=int, default=423_887)
    parser.add_argument("--patch", type=int, default=256)
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    chance = torch.Generator().manual_seed(0)
    pixels = args.patch**2
    ids = torch.randint(0, args.points, (1,), generator=chance) + torch.arange(pixels) * 3 // 4
    ids = ids % args.points
    result = {}
    for length in (4, 8):
        gradient = torch.randn(pixels, length, generator=chance)
        result[str(length)] = {
            "all_ms": _milliseconds(_all(args.points, ids, gradient), args.repeats),
            "seen_ms": _milliseconds(_seen(args.points, ids, gradient), args.repeats),
        }
        print(length, result[str(length)], flush=True)
    write_record(args.out, "descriptor_updates", ["torch"], {"by_length": result, "patch": args.patch})


def _all(points: int, ids: torch.Tensor, gradient: torch.Tensor) -> Callable[[], None]:
    table = torch.zeros(points, gradient.shape[1], requires_grad=True)
    adam = torch.optim.Adam([table], lr=_RATE, fused=True)

    def step() -> None:
        adam.zero_grad(set_to_none=True)
        table[ids].backward(gradient)
        adam.step()

    return step


def _seen(points: int, ids: torch.Tensor, gradient: torch.Tensor) -> Callable[[], None]:
    table = torch.zeros(points, gradient.shape[1])
    mean, square = torch.zeros_like(table), torch.zeros_like(table)

    def step() -> None:
        rows, member = torch.unique(ids, return_inverse=True)
        own = gradient.new_zeros(len(rows), gradient.shape[1]).index_add_(0, member, gradient)
        mean[rows] = _FIRST * mean[rows] + (1.0 - _FIRST) * own
        square[rows] = _SECOND * square[rows] + (1.0 - _SECOND) * own * own
        table[rows] -= _RATE * mean[rows] / (square[rows].sqrt() + _LEAST)

    return step


def _milliseconds(step: Callable[[], None], repeats: int) -> float:
    """Of processor time a step."""
    step()
    began_s = time.process_time()
    for _ in range(repeats):
        step()
    return round(1e3 * (time.process_time() - began_s) / repeats, 2)


if __name__ == "__main__":
    main()
