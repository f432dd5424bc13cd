"""What it gives to let each flash come a share of a frame later: lit frames found, and the shutter.

    python -m benchmarks.phase_step --out benchmarks/results/phase_step.json

The simulated rig in small, twenty flashes, a camera of 30.003 frames a second; truth from the lamp's light in
every row.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

from benchmarks.record import write_record
from capture.controller.config import CaptureConfig
from capture.controller.run import run_capture
from capture.devices.table import open_bench, open_camera, open_flash
from capture.sim.config import RigConfig
from capture.sim.lamp import Pulse, PulseTrain

_CAMERA, _SECONDS = "sim:coarse;fps=30.003", 20.0


def measure(step: float) -> dict[str, Any]:
    """A capture with a step, against the truth."""
    folder = Path(tempfile.mkdtemp(prefix="benchmark-phase-"))
    try:
        bench = open_bench(_CAMERA, "sim:", _SECONDS)
        with open_flash("sim:", bench) as flash, open_camera(_CAMERA, bench) as camera:
            config = CaptureConfig(duration_s=_SECONDS, phase_step=step)
            session = run_capture(camera, flash, bench, folder / "S", config).session
        rig = RigConfig.small()
        train = PulseTrain(rig.lamp, tuple(Pulse(on_s, off_s) for on_s, off_s in bench.light.pulses))
        truth: Counter[str] = Counter()
        wrong = 0
        for record in session.frames:
            start_s, exposure_s = 1e-9 * (record.device_timestamp_ns or 0), record.exposure_s or 0.0
            flag = train.flag(train.lit_fraction(start_s, record.height, rig.sensor.readout_s, exposure_s))
            truth[{1: "lit", 0: "unlit", None: "partial"}[flag]] += 1
            wrong += record.flash is not None and record.flash != flag
        light = session.info["capture"]["light"]
        return {
            "step": step,
            "truth": dict(truth),
            "found": light["labels"],
            "wrong": wrong,
            "readout_s": light["readout_s"],
            "readout_sigma_s": light["readout_sigma_s"],
            "true_readout_s": rig.sensor.readout_s,
        }
    finally:
        shutil.rmtree(folder)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--steps", type=float, nargs="+", default=[0.0, 0.382, 0.5])
    args = parser.parse_args()
    rows = [measure(step) for step in args.steps]
    for row in rows:
        print(row)
    write_record(args.out, "phase_step", ["numpy"], {"cases": rows})


if __name__ == "__main__":
    main()
