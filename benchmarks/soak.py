"""Ten thousand pulses through the stream tagger: what is mis-tagged, what is lost, and whether memory grows.

    python -m benchmarks.soak --out benchmarks/results/soak.json
    python -m benchmarks.soak --pulses 150 --out soak.json

The capture is that of `benchmarks.soak_scene`. A label is wrong when it contradicts the light of any row at
the limits 0.98 and 0.02, however little; the worst row tells how far.
"""

from __future__ import annotations

import argparse
import gc
import os
import time
from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.record import write_record
from benchmarks.soak_scene import COLUMNS, ROWS, Soak, soak_frames
from capture.tagging import StreamTagger, TaggingConfig
from capture.tagging.stream import CHUNK_S

_SUMMARY = (
    *("period_s", "period_sigma_s", "jitter_s", "missed", "phase_jumps", "segments", "readout_s"),
    *("readout_sigma_s", "exposure_s", "exposure_sigma_s", "droop_share", "droop_sigma", "latency_s"),
    *("latency_jitter_s", "matched", "unseen", "unscheduled", "contradictions", "flicker_hz", "labels"),
    "warnings",
)
_PAGE = os.sysconf("SC_PAGE_SIZE")


def run_soak(
    soak: Soak,
    *,
    scheduled: bool,
    config: TaggingConfig,
    chunk_s: float = CHUNK_S,
    report_every: int = 0,
) -> dict[str, Any]:
    """Streams a capture through the tagger and compares every tag with the truth.

    Args:
        soak: what is captured.
        scheduled: whether the flash reports its pulses.
        config: of the tagger.
        chunk_s: likewise.
        report_every: frames between lines of progress; 0 = none.
    """
    tagger = StreamTagger(COLUMNS, ROWS, config=config, chunk_s=chunk_s)
    truth: dict[int, tuple[float, float, float, tuple[int, ...]]] = {}
    counts: Counter[str] = Counter()
    wrong: list[dict[str, Any]] = []
    touched: dict[int, float] = {}
    memory: list[tuple[int, float]] = []
    making_s, held = 0.0, 0
    started_s = mark = time.process_time()
    frames = soak_frames(soak)
    count = 0
    while True:
        mark = time.process_time()
        frame = next(frames, None)
        making_s += time.process_time() - mark
        if frame is None:
            break
        if scheduled and frame.events:
            tagger.expect(frame.events, soak.on_s)
        tagger.add(frame.picture, frame.pts_s)
        truth[count] = (frame.pts_s, frame.least, frame.most, frame.pulses)
        for pulse in frame.pulses:
            # a pulse that no frame shows in a row by half is not there to be found
            touched[pulse] = max(touched.get(pulse, 0.0), frame.most)
        count += 1
        if count % 300 == 0:
            _compare(tagger.ready(), truth, counts, wrong)
            held = max(held, tagger.held)
        if count % 3000 == 0:
            gc.collect()
            memory.append((count, _resident_mb()))
        if report_every and count % report_every == 0:
            passed_s = round(time.process_time() - started_s)
            print(
                f"{count} frames, {passed_s} s, {_resident_mb():.0f} MB, {dict(counts)}",
                wrong[-3:],
                flush=True,
            )
    result = tagger.finish()
    _compare(list(result.frames), truth, counts, wrong)
    there = [pulse for pulse, most in touched.items() if most >= 0.5]
    return {
        "soak": asdict(soak),
        "scheduled": scheduled,
        "config": asdict(config),
        "frames": count,
        "frames_without_tag": len(truth),
        "pulses": len(there),
        "pulses_found": result.pulses,
        **{name: counts[name] for kind in ("lit", "partial", "unlit") for name in (kind, kind + "_found")},
        "false_lit": sum(item["tag"] == 1 for item in wrong),
        "false_unlit": sum(item["tag"] == 0 for item in wrong),
        "wrong": wrong[:50],
        "reasons": {name[7:]: counts[name] for name in sorted(counts) if name.startswith("reason ")},
        "memory_mb": _memory(memory, soak.rate_hz),
        "cpu_s": round(time.process_time() - started_s - making_s, 1),
        "making_frames_cpu_s": round(making_s, 1),
        "tagging_ms_a_frame": round(1e3 * (time.process_time() - started_s - making_s) / max(count, 1), 2),
        "held_frames_most": held,
        "summary": {name: getattr(result, name) for name in _SUMMARY},
    }


def _compare(
    tags: list[Any],
    truth: dict[int, tuple[float, float, float, tuple[int, ...]]],
    counts: Counter[str],
    wrong: list[dict[str, Any]],
) -> None:
    """Counts tags against the truth, which is forgotten then."""
    for position, tag in tags:
        pts_s, least, most, _ = truth.pop(position)
        true = 1 if least >= 0.98 else 0 if most <= 0.02 else None
        kind = {1: "lit", 0: "unlit", None: "partial"}[true]
        counts[kind] += 1
        counts[kind + "_found"] += tag.flash == true
        for reason in tag.reasons:
            counts["reason " + reason] += 1
        if tag.flash is not None and tag.flash != true:
            wrong.append(
                {
                    "position": position,
                    "pts_s": round(pts_s, 4),
                    "tag": tag.flash,
                    "least_row": round(least, 4),
                    "most_row": round(most, 4),
                    "confidence": round(tag.confidence, 5),
                }
            )


def _resident_mb() -> float:
    with open("/proc/self/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * _PAGE / 1e6


def _memory(memory: list[tuple[int, float]], rate_hz: float) -> dict[str, float] | None:
    """Resident memory: at first, at last, and its growth over the second half, MB an hour of capture."""
    if len(memory) < 4:
        return None
    half = np.array(memory[len(memory) // 2 :])
    slope = float(np.polyfit(half[:, 0] / rate_hz / 3600, half[:, 1], 1)[0])
    most = max(mb for _, mb in memory)
    return {"first": memory[0][1], "most": most, "last": memory[-1][1], "mb_per_hour": slope}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    parser.add_argument("--pulses", type=int, default=Soak.pulses, help="length of the capture")
    parser.add_argument("--seed", type=int, default=0, help="of everything")
    parser.add_argument(
        "--without-schedule", action="store_true", help="the flash does not report its pulses"
    )
    parser.add_argument(
        "--exposure-unknown", action="store_true", help="the camera does not tell its exposure"
    )
    parser.add_argument("--risk", type=float, default=1e-4, help="of the tagger")
    parser.add_argument("--report-every", type=int, default=9000, help="frames between lines of progress")
    args = parser.parse_args()
    soak = Soak(pulses=args.pulses, seed=args.seed)
    result = run_soak(
        soak,
        scheduled=not args.without_schedule,
        config=TaggingConfig(
            risk=args.risk,
            stamp_sigma_s=soak.stamp_s,
            exposure_s=None if args.exposure_unknown else soak.exposure_s,
        ),
        report_every=args.report_every,
    )
    for name in (
        "frames",
        "frames_without_tag",
        "pulses",
        "pulses_found",
        "false_lit",
        "false_unlit",
        "memory_mb",
    ):
        print(name, result[name])
    write_record(args.out, "soak", ("numpy", "scipy", "opencv-contrib-python-headless"), {"result": result})


if __name__ == "__main__":
    main()
