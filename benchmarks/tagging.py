"""F tagging on simulated video: what is missed and what is wrong, and the time it costs.

    python -m benchmarks.tagging --out benchmarks/results/tagging.json
    python -m benchmarks.tagging --only timing --out timing.json

Grid: readout 10, 20, 33 ms x pulse 60, 100, 150 ms x room light (flash on the head 1.2, 1.5, 2.3 times the
room) x motion (held, walked), each with a microcontroller's timer and with a phone's. Then cases of
trouble: flicker, dropped frames, slow lamp, drooping lamp, drift, missed pulses, long exposure, no flash at
all. A label is wrong when it contradicts the rows' true light at the limits 0.98 and 0.02, however little;
the worst row tells how far. Uncertain frames count as missed.
"""

from __future__ import annotations

import argparse
import itertools
import statistics
import tempfile
import time
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np

from benchmarks.blinking_video import Truth, Video, frames, make_truth
from benchmarks.record import write_record
from capture.errors import TaggingError
from capture.tagging import ProfileAccumulator, TagResult, tag
from capture.video import VideoWriter

READOUTS_S, PULSES_S = (0.010, 0.020, 0.033), (0.06, 0.10, 0.15)
GAINS, MOTIONS = {"bright": 0.2, "usual": 0.5, "dim": 1.3}, ("hand", "walk")
TIMERS = ("hardware", "phone")
# The flash falls off with the square of distance: a wall at three times the head's gets a ninth.
WALL_SHARE = 1 / 9
BASE = Video(duration_s=8.0, room=0.25, exposure_s=0.005)
# A second that is no multiple of the frame interval, as two clocks never agree.
PERIOD_S = 1.013


def case(**changes: Any) -> Video:
    """A video of the base, its wall lit in proportion to the head."""
    video = replace(BASE, period_s=PERIOD_S, **changes)
    return replace(video, background_gain=WALL_SHARE * video.gain)


def grid(seed: int) -> Iterable[tuple[dict[str, Any], Video]]:
    """All cases of the grid with their names."""
    choices = itertools.product(TIMERS, READOUTS_S, PULSES_S, GAINS, MOTIONS)
    for number, (timer, readout_s, on_s, room, motion) in enumerate(choices):
        name = {
            "timer": timer,
            "readout_ms": 1e3 * readout_s,
            "pulse_ms": 1e3 * on_s,
            "room": room,
            "motion": motion,
        }
        yield (
            name,
            case(
                readout_s=readout_s,
                on_s=on_s,
                gain=GAINS[room],
                motion=motion,
                timer=timer,
                seed=1000 * seed + number,
                first_s=0.2 + 0.013 * (number % 30),
            ),
        )


TROUBLE: dict[str, Video] = {
    "flicker 100 Hz, 30 %": case(flicker_hz=100.06, flicker_depth=0.3, timer="phone"),
    "flicker 120 Hz at 25/s, 30 %": case(flicker_hz=119.95, flicker_depth=0.3, rate_hz=25.0),
    "flicker 100 Hz, no multiple of rows": case(
        flicker_hz=100.0, flicker_depth=0.3, readout_s=0.013, motion="hand"
    ),
    "one frame in ten dropped": case(dropped=0.1, timer="phone"),
    "irregular frame times": case(pts_jitter_s=0.001, timer="phone"),
    "lamp rises in 15 ms": case(rise_s=0.015, fall_s=0.005, timer="phone"),
    "lamp droops by 5 %": case(droop=0.05, timer="phone"),
    "exposure drifts 1 % a second": case(drift_per_s=0.01, motion="hand", timer="phone"),
    "exposure jumps by 10 %": case(step_at_s=5.2, step=(1.1, 1.1, 1.1), timer="phone"),
    "two pulses missed": case(missed=(3, 6), timer="phone"),
    "exposure 15 ms": case(exposure_s=0.015, timer="phone"),
    "exposure 1 ms": case(exposure_s=0.001, timer="phone"),
    "exposure 30 ms": case(exposure_s=0.030, timer="phone"),
    "bottom row first": case(readout_s=-0.02, timer="phone"),
    "global shutter": case(readout_s=0.0, exposure_s=0.008, timer="phone"),
    "dark room": case(room=0.004, gain=3.0, timer="phone"),
    "60 frames a second": case(rate_hz=60.0, readout_s=0.012, timer="phone", duration_s=8.0),
    "tripod": case(motion="still", timer="phone"),
    "period 0.5 s": replace(case(timer="phone"), period_s=0.52, on_s=0.08),
    "period 2 s": replace(case(timer="phone"), period_s=1.95, duration_s=16.0),
    "clock in step with the frames": replace(case(), period_s=1.0),
}
REFUSED: dict[str, Video] = {
    f"no flash, {motion}, {seed}": case(flash=False, motion=motion, seed=seed)
    for motion in ("still", "hand", "walk")
    for seed in range(4)
} | {
    "always on": case(always_on=True),
    "no flash, flicker": case(flash=False, flicker_hz=100.0, flicker_depth=0.3),
    "no flash, exposure jumps": case(flash=False, step_at_s=5.0, step=(1.3, 1.3, 1.3)),
}


def tagged(video: Video) -> tuple[Truth, TagResult, float]:
    """Truth, tags, and the CPU seconds of tagging."""
    accumulator = ProfileAccumulator(video.width, video.height, transfer="srgb")
    for picture, pts_s in frames(video):
        accumulator.add(picture, pts_s)
    profiles = accumulator.profiles()
    started = time.process_time()
    result = tag(profiles)
    return make_truth(video), result, time.process_time() - started


def score(truth: Truth, result: TagResult) -> dict[str, Any]:
    """Counts of what is right, missed and wrong."""
    given = [frame.flash for frame in result.frames]
    pairs = list(zip(truth.labels, given, strict=True))
    low, high = truth.lit.min(axis=1), truth.lit.max(axis=1)
    false_lit = [k for k, (true, tagged) in enumerate(pairs) if tagged == 1 and true != 1]
    false_unlit = [k for k, (true, tagged) in enumerate(pairs) if tagged == 0 and true != 0]
    inside = (truth.off_s > truth.pts_s[0]) & (truth.on_s < truth.pts_s[-1])
    return {
        "full": sum(true == 1 for true, _ in pairs),
        "full_found": sum(true == 1 and tagged == 1 for true, tagged in pairs),
        "partial": sum(true is None for true, _ in pairs),
        "partial_found": sum(true is None and tagged is None for true, tagged in pairs),
        "unlit": sum(true == 0 for true, _ in pairs),
        "unlit_found": sum(true == 0 and tagged == 0 for true, tagged in pairs),
        "false_lit": len(false_lit),
        "false_lit_worst_row": min((float(low[k]) for k in false_lit), default=None),
        "false_unlit": len(false_unlit),
        "false_unlit_worst_row": max((float(high[k]) for k in false_unlit), default=None),
        "pulses": int(inside.sum()),
        "pulses_found": len(result.pulses),
        "readout_s": result.readout_s,
        "readout_sigma_s": result.readout_sigma_s,
        "period_s": result.period_s,
        "warnings": list(result.warnings),
    }


def run_cases(cases: Iterable[tuple[dict[str, Any], Video]]) -> list[dict[str, Any]]:
    """Scores of cases, one line printed for each."""
    rows = []
    for name, video in cases:
        try:
            truth, result, seconds = tagged(video)
            row = {**name, **score(truth, result), "tag_cpu_s": round(seconds, 3)}
        except TaggingError as error:
            row = {**name, "refused": str(error)}
        rows.append(row)
        print(_line(name, row), flush=True)
    return rows


def _line(name: dict[str, Any], row: dict[str, Any]) -> str:
    label = " ".join(f"{value:g}" if isinstance(value, float) else str(value) for value in name.values())
    if "refused" in row:
        return f"{label:44s} refused: {row['refused'][:100]}"
    readout = (
        "-"
        if row["readout_s"] is None
        else f"{1e3 * row['readout_s']:.1f}±{1e3 * row['readout_sigma_s']:.1f}"
    )
    return (
        f"{label:44s} full {row['full_found']:3d}/{row['full']:3d}  partial "
        f"{row['partial_found']:3d}/{row['partial']:3d}  "
        f"false 1: {row['false_lit']} {_worst(row['false_lit_worst_row'])}  "
        f"false 0: {row['false_unlit']} {_worst(row['false_unlit_worst_row'])}  "
        f"pulses {row['pulses_found']}/{row['pulses']}  readout {readout} ms"
    )


def _worst(value: float | None) -> str:
    return "" if value is None else f"(row {value:.2f})"


def totals(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Sums over cases."""
    done = [row for row in rows if "refused" not in row]

    def total(key: str) -> int:
        return sum(row[key] for row in done)

    return {
        "cases": len(rows),
        "refused": len(rows) - len(done),
        "full": total("full"),
        "full_found_share": total("full_found") / max(total("full"), 1),
        "partial": total("partial"),
        "partial_recall": total("partial_found") / max(total("partial"), 1),
        "unlit_found_share": total("unlit_found") / max(total("unlit"), 1),
        "false_lit": total("false_lit"),
        "false_lit_worst_row": min((r["false_lit_worst_row"] for r in done if r["false_lit"]), default=None),
        "false_unlit": total("false_unlit"),
        "false_unlit_worst_row": max(
            (r["false_unlit_worst_row"] for r in done if r["false_unlit"]), default=None
        ),
    }


def print_totals(title: str, sums: dict[str, Any]) -> None:
    print(
        f"{title:34s} full {100 * sums['full_found_share']:5.1f} % of {sums['full']:5d}   partial recall "
        f"{100 * sums['partial_recall']:6.2f} % of {sums['partial']:5d}   unlit "
        f"{100 * sums['unlit_found_share']:5.2f} %   "
        f"false 1: {sums['false_lit']} {_worst(sums['false_lit_worst_row'])}   "
        f"false 0: {sums['false_unlit']} {_worst(sums['false_unlit_worst_row'])}"
    )


def measure_time(repeats: int) -> dict[str, Any]:
    """Looking at a 1080p H.264 file and tagging it, against bare decoding of it: CPU and wall seconds."""
    video = replace(case(timer="phone"), width=1920, height=1080, duration_s=8.0, color=True)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "clip.mp4"
        with VideoWriter(path, video.width, video.height, crf=23, transfer="srgb") as writer:
            for picture, pts_s in frames(video):
                writer.write(picture, pts_s)
        bare, looked = [], []
        for _ in range(repeats):
            bare.append(_timed(lambda: sum(1 for _ in _decoded(path))))
            looked.append(_timed(lambda: _look(path, video)))
        count = sum(1 for _ in _decoded(path))
    ratio = [b["wall_s"] / a["wall_s"] for a, b in zip(bare, looked, strict=True)]
    return {
        "video": f"{video.width}x{video.height}, {count} frames, H.264",
        "decode_ms_a_frame": statistics.median(1e3 * a["cpu_s"] / count for a in bare),
        "look_and_tag_ms_a_frame": statistics.median(
            1e3 * (b["cpu_s"] - a["cpu_s"]) / count for a, b in zip(bare, looked, strict=True)
        ),
        "wall_ratio": {"median": statistics.median(ratio), "min": min(ratio), "max": max(ratio)},
        "cpu_ratio": statistics.median(b["cpu_s"] / a["cpu_s"] for a, b in zip(bare, looked, strict=True)),
    }


def _decoded(path: Path) -> Iterable[Any]:
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        yield from container.decode(stream)


def _look(path: Path, video: Video) -> TagResult:
    accumulator = ProfileAccumulator(video.width, video.height, transfer="srgb", levels=(16, 235))
    for picture in _decoded(path):
        plane = picture.planes[0]
        luma = np.frombuffer(plane, np.uint8).reshape(plane.height, plane.line_size)[:, : plane.width]
        accumulator.add(luma, float(picture.pts * picture.time_base))
    return tag(accumulator.profiles())


def _timed(work: Any) -> dict[str, float]:
    wall, cpu = time.perf_counter(), time.process_time()
    work()
    return {"wall_s": time.perf_counter() - wall, "cpu_s": time.process_time() - cpu}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    parser.add_argument("--only", choices=("grid", "trouble", "refused", "timing"), help="one part")
    parser.add_argument("--seed", type=int, default=0, help="of the grid")
    parser.add_argument("--every", type=int, default=1, help="take every so many-th case of the grid")
    parser.add_argument("--repeats", type=int, default=3, help="turns of the timing")
    args = parser.parse_args()
    results: dict[str, Any] = {}
    if args.only in (None, "grid"):
        rows = run_cases(list(grid(args.seed))[:: args.every])
        results["grid"] = {"cases": rows, "all": totals(rows)}
        for timer in TIMERS:
            results["grid"][timer] = totals([row for row in rows if row["timer"] == timer])
    if args.only in (None, "trouble"):
        rows = run_cases(({"case": name}, video) for name, video in TROUBLE.items())
        results["trouble"] = {"cases": rows, "all": totals(rows)}
    if args.only in (None, "refused"):
        rows = run_cases(({"case": name}, video) for name, video in REFUSED.items())
        results["refused"] = {
            "cases": rows,
            "refused": sum("refused" in row for row in rows),
            "of": len(rows),
        }
    if args.only in (None, "timing"):
        results["timing"] = measure_time(args.repeats)
    for part, keys in (("grid", ("all", *TIMERS)), ("trouble", ("all",))):
        for key in keys if part in results else ():
            print_totals(f"{part}, {key}", results[part][key])
    if "refused" in results:
        print(
            f"refused {results['refused']['refused']} of {results['refused']['of']} sequences without a "
            "blinking flash"
        )
    if "timing" in results:
        print(results["timing"])
    write_record(args.out, "tagging", ("numpy", "scipy", "opencv-contrib-python-headless", "av"), results)


if __name__ == "__main__":
    main()
