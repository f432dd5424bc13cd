"""Error over time of the presets, what each part of ours is worth, and what its skips save.

    OMP_NUM_THREADS=1 python -m benchmarks.quality_fit --out benchmarks/results/quality_fit.json \
        [--only curve|paper|ablations|skips|plot] [--case NAME] [--views 5] [--keep FOLDER]

On portrait_A (skipped with a word where it is not there) with its poses, cloud and masks given. Time is that
of the processor divided by two cores, "seconds of an idle machine of two cores, by processor time", counted
from the beginning of the fit; wall time stands beside it. So a machine that does other things can be used,
but what two cores do not share well is counted as if they did. Reading the session, the check, pictures and
report of `relight fit` are not counted.

curve      solve, fast and balanced at the marks; before the solve is done there is no portrait. At 10 s also
           a solve of the frames that the plan leaves for that time.
paper      the paper's recipe at its marks, an hour long; or, with --paper-snapshots FOLDER, the portraits
           mark-NNNN that a run of it left there.
ablations  fast without each of its parts.
skips      a hundred steps of fast with each skip turned off: the loss of frames that are not fitted.
plot       only draws anew what --out has.

Every run is a process of its own, so that its peak memory is its alone; solves are shared. What was run
before stays in --out; each row is written as it comes.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import multiprocessing
import os
import resource
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import cv2
import numpy as np
import torch

from benchmarks.quality_cases import CASES, Case
from benchmarks.quality_plot import Panel, draw
from benchmarks.record import ROOT, machine, write_record
from capture.frame_record import FrameRecord
from capture.importers import ImportOptions, import_source
from capture.session import Session
from capture.transfer import to_display
from relight.evaluate import portrait_renderer
from relight.face.store import load_face
from relight.fit import fit
from relight.measure import measure
from relight.neural.refined import decoder as refined_decoder
from relight.neural.refined import fitting as refined_fitting
from relight.neural.stopwatch import Stopwatch
from relight.photometric import solve
from relight.planning import make_plan
from relight.portrait import Portrait, load_portrait
from relight.presets import chosen_preset
from relight.raster import rasterize_ids
from relight.scene import load_scene
from relight.truth import load_truth

PACKAGES = ("torch", "numpy", "scipy")
CORES = 2


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    default = os.environ.get("RELIGHT_PORTRAIT_A", ROOT.parent / "shared" / "portrait_A")
    parser.add_argument("--portrait-a", type=Path, default=Path(default))
    parser.add_argument("--only", action="append", choices=(*CASES, "plot"), help="sub-runs (default: all)")
    parser.add_argument("--case", action="append", help="of these sub-runs only the cases of this name")
    parser.add_argument("--views", type=int, help="measure about this many of the validation views")
    parser.add_argument("--steps", type=int, help="of every refinement, to try the script")
    parser.add_argument("--half", action="store_true", help="half the resolution, to try the script")
    parser.add_argument("--limit", type=float, help="end every fit at this time, seconds")
    parser.add_argument("--paper-snapshots", type=Path, help="folder of an earlier run's mark-NNNN")
    parser.add_argument("--keep", type=Path, help="folder of sessions and solves, kept and used again")
    parser.add_argument("--plot", type=Path, help="PNG file to draw the curves in")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    args = parser.parse_args()
    wanted = args.only or list(CASES)
    if wanted != ["plot"]:
        if not (args.portrait_a / "cameras.json").is_file():
            print(f"skipped: there is no portrait_A in {args.portrait_a}")
            return
        with tempfile.TemporaryDirectory() as scratch:
            bench = Bench(args.keep or Path(scratch), args.portrait_a, args.views, args.out)
            for section in (section for section in CASES if section in wanted):
                if section == "paper" and args.paper_snapshots is not None:
                    bench.measure_snapshots(args.paper_snapshots)
                    continue
                for case in CASES[section]:
                    if args.case is None or case.name in args.case:
                        bench.run(section, _tried(case, args.steps, args.half, args.limit))
    if args.plot is not None:
        draw(panels(json.loads(args.out.read_text())), args.plot)


def _tried(case: Case, steps: int | None, half: bool, limit_s: float | None) -> Case:
    """The case as the options that try the script want it."""
    if steps is not None and case.settings is not None:
        case = replace(case, settings={**case.settings, "steps": steps})
    case = replace(case, limit_s=case.limit_s if limit_s is None else limit_s)
    return replace(case, smaller=2) if half else case


class Bench:
    """The sessions and solves of the cases, and the record."""

    def __init__(self, folder: Path, source: Path, views: int | None, out: Path) -> None:
        """Nothing is run yet; what lies in the folder is used again."""
        folder.mkdir(parents=True, exist_ok=True)
        self._folder, self._source, self._views, self._out = folder, source, views, out

    def run(self, section: str, case: Case) -> None:
        """Fits and measures a case, and writes its row."""
        session = self._session(case.smaller)
        if case.preset == "paper" and not (session / "scene" / "face").is_dir():
            alone(fit, session, "solve")  # finds the face
        solved = self._folder / f"solved_{case.solved}"
        facts_file = solved / "facts.json"
        if not facts_file.is_file():
            facts_file.write_text(json.dumps(alone(solve_case, session, case, solved)))
        facts = json.loads(facts_file.read_text())
        row: dict[str, Any] = {"solve": facts}
        portraits = []
        if case.settings is None:
            portraits.append(("end", facts["cpu_s"] / CORES, solved))
        else:
            into = self._folder / f"{section}_{case.name}".replace(" ", "_")
            shutil.rmtree(into, ignore_errors=True)
            row["refine"] = alone(refine_case, session, case, solved, facts["cpu_s"] / CORES, into)
            portraits += [
                (f"{m['mark_s']:g} s", m["fit_s"], into / m["folder"]) for m in row["refine"]["marks"]
            ]
            portraits.append(("end", (facts["cpu_s"] + row["refine"]["cpu_s"]) / CORES, into / "end"))
        parts = [facts, *([row["refine"]] if "refine" in row else [])]
        row |= {
            "cpu_s": sum(part["cpu_s"] for part in parts),
            "wall_s": sum(part["wall_s"] for part in parts),
            "peak_mb": max(part["peak_mb"] for part in parts),
        }
        if section != "skips":  # these are told apart by their loss
            row["measured"] = {}
            for name, fit_s, portrait in portraits:
                row["measured"][name] = {"fit_s": fit_s, **self._measure(portrait)}
        self._write(section, case.name, row)

    def measure_snapshots(self, folder: Path) -> None:
        """Measures the portraits that a run of the paper's recipe left, as far as it came."""
        facts = json.loads((self._folder / f"solved_{CASES['paper'][0].solved}" / "facts.json").read_text())
        measured = {}
        for portrait in sorted(folder.glob("mark-*")):
            if not (portrait / "portrait.json").is_file():
                continue
            told = load_portrait(portrait).info["refinement"]
            fit_s = facts["cpu_s"] / CORES + told["seconds"]
            row = {"fit_s": fit_s, "cpu_s": CORES * fit_s, "steps": told["steps"]}
            measured[f"{int(portrait.name[5:])} s"] = row | self._measure(portrait)
        self._write("paper", "paper", {"solve": facts, "measured": measured})

    def _measure(self, portrait: Path) -> dict[str, Any]:
        return alone(measure_portrait, portrait, self._source, self._views)

    def _session(self, smaller: int) -> Path:
        whole = self._folder / "S"
        if not whole.is_dir():
            import_source([self._source], whole, ImportOptions())
        if smaller == 1:
            return whole
        folder = self._folder / f"S_{smaller}"
        if not folder.is_dir():
            make_smaller(Session.open(whole), folder, smaller)
        return folder

    def _write(self, section: str, name: str, row: dict[str, Any]) -> None:
        content = json.loads(self._out.read_text()) if self._out.is_file() else {}
        sections = {key: content.get(key, {}) for key in CASES}
        facts = machine(PACKAGES)
        row |= {key: facts[key] for key in ("commit", "date", "load_average")}
        sections[section][name] = row | {"views": self._views or "all"}
        time_axis = "seconds of an idle 2-core machine, by processor time"
        write_record(self._out, "quality_fit", PACKAGES, {"time": time_axis, **sections})
        print(section, name, f"{row.get('cpu_s', 0.0):.1f} CPU s", flush=True)
        for mark, measures in row.get("measured", {}).items():
            print("   ", mark, json.dumps(summary(measures)), flush=True)


def alone(work: Callable[..., Any], *arguments: Any) -> Any:
    """The result of work in a fresh process."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(work, arguments)


def solve_case(session: Path, case: Case, into: Path) -> dict[str, Any]:
    """Solves as a case does, in this process."""
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", CORES)))
    opened = Session.open(session)
    chosen = make_plan(opened, max_seconds=case.budget_s).frames
    records = [record for record in opened.frames if record.index in set(chosen)]
    frames = _thinned(records, case.every)
    began = _Used()
    scene = load_scene(opened, frames=frames)
    portrait = solve(scene, case.solve_config)
    used = began.until_now()
    portrait.save(into)
    return used | {"frames": len(frames), "points": len(portrait.points)}


def refine_case(session: Path, case: Case, solved: Path, offset_s: float, into: Path) -> dict[str, Any]:
    """Refines a solve as a case does, in this process; portraits at the marks and at the end go into a
    folder."""
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", CORES)))
    preset = chosen_preset(case.preset)
    refine = preset.load_refine()
    assert refine is not None
    assert case.settings is not None
    opened = Session.open(session)
    chosen = make_plan(opened, max_seconds=case.budget_s).frames
    records = [record for record in opened.frames if record.index in set(chosen)]
    scene = load_scene(opened, frames=_thinned(records, case.every))
    portrait = load_portrait(solved)
    face = load_face(opened.scene_dir / "face") if case.preset == "paper" else None
    marks: list[dict[str, Any]] = []

    def keep(mark_s: float, reached: Portrait) -> None:
        told = reached.info["refinement"]
        folder = f"mark-{round(mark_s + offset_s):04d}"
        reached.save(into / folder)
        fit_s = offset_s + told["seconds"]
        marks.append({"mark_s": mark_s + offset_s, "fit_s": fit_s, "steps": told["steps"], "folder": folder})

    wall_s = time.perf_counter()
    watch = Stopwatch(
        None if case.limit_s is None else case.limit_s - offset_s,
        marks_s=[mark_s - offset_s for mark_s in case.marks_s if mark_s > offset_s],
        at_mark=keep,
        clock=lambda: time.process_time() / CORES,
    )
    with _without(case.skip, portrait):
        refined = refine(
            scene, portrait, config=preset.config(case.settings), face=face, seed=0, stopwatch=watch
        )
    used = {
        "cpu_s": CORES * watch.elapsed_s,
        "wall_s": time.perf_counter() - wall_s,
        "peak_mb": _peak_mb(),
    }
    refined.save(into / "end")
    told = refined.info["refinement"]
    kept = {key: told[key] for key in ("steps", "held_out_db", "held_out_loss") if key in told}
    return used | kept | {"marks": marks, "before the solve": [m for m in case.marks_s if m <= offset_s]}


def measure_portrait(portrait: Path, source: Path, views: int | None) -> dict[str, Any]:
    """What `relight evaluate` measures of a portrait, in this process."""
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", CORES)))
    truth = load_truth(source)
    if views is not None:
        # From end to end: lit frames come at even steps, and are not all that is to be measured.
        chosen = np.linspace(0, len(truth.views) - 1, min(views, len(truth.views))).round().astype(int)
        truth = replace(truth, views=[truth.views[k] for k in chosen])
    measures = measure(truth, portrait_renderer(load_portrait(portrait)))
    measures["captured"].pop("by_view", None)
    return {key: measures[key] for key in ("captured", "albedo", "normals", "lights", "mask")}


def make_smaller(whole: Session, folder: Path, factor: int) -> None:
    """A session of the same frames with sides smaller by a factor: means of linear light."""
    image = whole.info["image"]
    size = (image["width"] // factor, image["height"] // factor)
    with Session.create(folder, source=whole.info["source"], width=size[0], height=size[1]) as session:
        for record in whole.frames:
            if record.file is None:
                continue
            linear = cv2.resize(whole.load_radiance(record), size, interpolation=cv2.INTER_AREA)
            file = session.write_frame(record.index, np.rint(255.0 * to_display(linear)).astype(np.uint8))
            session.append_frame(replace(record, file=file, width=size[0], height=size[1]))
        cameras = whole.load_scene_cameras()
        session.save_scene_cameras({index: camera.scaled(1.0 / factor) for index, camera in cameras.items()})
        shutil.copyfile(whole.points_path, session.points_path)
        session.masks_dir.mkdir(parents=True)
        for record in whole.frames:
            mask = whole.load_mask(record)
            if mask is not None:
                smaller = cv2.resize(mask, size, interpolation=cv2.INTER_AREA)
                cv2.imwrite(str(session.mask_path(record.index)), smaller)
    shutil.copyfile(whole.calibration_path, folder / whole.calibration_path.name)


def summary(measures: Mapping[str, Any]) -> dict[str, float]:
    """The numbers that a person looks at first."""
    lights = {name: light["psnr_db"] for name, light in measures["lights"].items()}

    def mean(kind: str) -> float:
        return float(np.mean([value for name, value in lights.items() if name.startswith(kind)]))

    values = {
        "fit_s": measures["fit_s"],
        "captured_db": measures["captured"]["psnr_db"],
        "ssim": measures["captured"]["ssim"],
        "albedo_db": measures["albedo"]["psnr_db"],
        "normals_deg": measures["normals"]["mean_deg"],
        "directional_db": mean("dir"),
        "environment_db": mean("env"),
        "point_db": mean("point"),
        "mask_iou": measures["mask"]["iou"],
    }
    return {name: round(value, 4) for name, value in values.items()}


TITLES = {
    "captured_db": "captured view, dB",
    "albedo_db": "albedo, dB",
    "normals_deg": "normals, mean degrees",
    "directional_db": "directional lights, dB",
    "point_db": "point light, dB",
    "mask_iou": "mask, IoU",
}


def panels(content: Mapping[str, Any]) -> list[Panel]:
    """The curves of a record, each from its first portrait on."""
    rows = {**content["curve"], **content["paper"]}
    curves = {name: [summary(m) for m in row["measured"].values()] for name, row in rows.items()}
    return [
        Panel(
            title,
            {
                name: sorted((point["fit_s"], point[measure]) for point in points)
                for name, points in curves.items()
            },
        )
        for measure, title in TITLES.items()
    ]


class _Used:
    """Time and memory from now on."""

    def __init__(self) -> None:
        self._wall_s, self._cpu_s = time.perf_counter(), time.process_time()

    def until_now(self) -> dict[str, float]:
        return {
            "cpu_s": time.process_time() - self._cpu_s,
            "wall_s": time.perf_counter() - self._wall_s,
            "peak_mb": _peak_mb(),
        }


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6


def _thinned(records: Sequence[FrameRecord], every: int) -> list[int]:
    """Indices of one of so many of the lit frames and of the unlit ones."""
    kept = [
        record.index
        for flash in (0, 1)
        for record in [record for record in records if record.flash == flash][::every]
    ]
    return sorted(kept)


@contextlib.contextmanager
def _without(skip: str, solved: Portrait) -> Iterator[None]:
    """Turns a skip of the fit off."""
    if skip == "kept maps":
        with mock.patch.object(refined_fitting, "_ROOM_BYTES", 0):
            yield
    elif skip == "choice by error":
        with mock.patch.object(refined_fitting.RefinedFit, "_remember", return_value=None):
            yield
    elif skip == "strided ids":
        real = refined_fitting.apply_network

        def apply(network: Any, descriptors: Any, layers: Any, ids: Any, camera: Any, *rest: Any) -> Any:
            pyramid = rasterize_ids(solved.points, camera, network.scales).ids
            with mock.patch.object(refined_decoder, "strided", return_value=[ids, *pyramid[1:]]):
                return real(network, descriptors, layers, ids, camera, *rest)

        with mock.patch.object(refined_fitting, "apply_network", apply):
            yield
    else:
        yield


if __name__ == "__main__":
    main()
