"""How well the host knows when the firmware's lamp was lit: edges as told against edges as they were.

    python -m benchmarks.flash_clock --seconds 60 --out benchmarks/results/flash_clock.json

The firmware runs in real time behind a pseudo-terminal, as a program of this machine and in simavr, and
writes its lamp's edges by the clock of the system. A C compiler, avr-gcc and simavr are needed.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.record import write_record
from capture.devices.bench import Bench
from capture.devices.flash import FlashEdge, PulseTrain
from capture.devices.serial_flash import open_flash

ROOT = Path(__file__).parents[1]
sys.path.append(str(ROOT / "tests" / "capture" / "devices"))

from flash_doubles import LiveDevice, build  # noqa: E402


def measure(device: LiveDevice, seconds: int) -> dict[str, Any]:
    """One flash of 0.1 s each second."""
    bench = Bench()
    edges: list[FlashEdge] = []
    with open_flash(device.path, bench) as flash:
        train = PulseTrain(start_s=bench.clock.now_s() + 0.5, count=seconds)
        flash.start(train)
        while bench.clock.now_s() < train.end_s + 0.3:
            edges += flash.poll()
            bench.clock.sleep(0.1)
        report = flash.link_report()
    true_s = np.array([time_s for time_s, _ in device.lamp()])
    told_s = np.array([edge.time_s for edge in edges])
    sigma_s = np.array([edge.sigma_s for edge in edges])
    if len(true_s) != len(told_s):
        raise RuntimeError(f"the lamp made {len(true_s)} edges and {len(told_s)} were told")
    planned_s = train.start_s + np.arange(seconds)
    return {
        "edges": len(edges),
        "error_us": _spread(told_s - true_s),
        "claimed_sigma_us": _spread(sigma_s),
        "worst_error_in_sigmas": float(np.max(np.abs(told_s - true_s) / sigma_s)),
        "start_against_plan_us": _spread(true_s[::2] - planned_s),
        "width_error_us": _spread(true_s[1::2] - true_s[::2] - train.on_s),
        "link": report,
    }


def _spread(seconds: np.ndarray) -> dict[str, float]:
    size = np.abs(seconds) * 1e6
    return {
        "median": round(float(np.median(size)), 2),
        "p99": round(float(np.quantile(size, 0.99)), 2),
        "max": round(float(np.max(size)), 2),
    }


def main() -> None:
    """Measures both and writes the record."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seconds", type=int, default=60)
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    results = {}
    with tempfile.TemporaryDirectory() as folder:
        directory = Path(folder)
        commands = {
            "flash_double": lambda: (build(directory, "flash_double"),),
            "simavr": lambda: (build(directory, "runner"), build(directory, "flash.elf")),
        }
        for name, command in commands.items():
            device = LiveDevice(*command(), edges_file=directory / f"{name}.txt")
            try:
                results[name] = measure(device, arguments.seconds)
            finally:
                device.close()
            error = results[name]["error_us"]
            print(f"{name}: median {error['median']} us, p99 {error['p99']} us, max {error['max']} us")
    write_record(arguments.out, "flash_clock", ("numpy", "pyserial"), results)


if __name__ == "__main__":
    main()
