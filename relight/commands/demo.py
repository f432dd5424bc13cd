"""`relight demo`: the whole way once, on a simulated head filmed by a simulated phone."""

from __future__ import annotations

import argparse
import shutil
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from capture.errors import RelightError
from relight.commands.arguments import add_device

if TYPE_CHECKING:
    from capture.session import Session
    from relight.stages import Progress

EXAMPLE = "relight demo --out demo --seed 3"

_MARKER = ".relight-demo"
_MARKER_TEXT = "Made by `relight demo`, which replaces this folder when it runs again.\n"
_FILM_S = 12.0  # a dozen flashes; a real capture takes twenty seconds
_ORBIT_S, _ORBIT_SCALE = 3.0, 0.75


class DemoError(RelightError):
    """The demo cannot be made where it was asked for."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The flags of `relight demo`."""
    parser.add_argument(
        "--out", type=Path, default=Path("demo"), metavar="DIR", help="folder to make (default ./demo)"
    )
    parser.add_argument(
        "--seed", type=int, default=0, metavar="N", help="another head in another room (default 0)"
    )
    parser.add_argument("--quick", action="store_true", help="a coarse head in small pictures, in seconds")
    parser.add_argument(
        "--frames-only",
        action="store_true",
        help="withhold the rig's poses and cloud: find them, and masks, from the film alone (takes minutes)",
    )
    add_device(parser)


def run(args: argparse.Namespace) -> None:
    """Films, imports, fits, measures, renders and reports; says where everything is."""
    from capture.importers import ImportOptions, import_source
    from capture.sim import RigConfig, simulate_video
    from capture.terminal import StageProgress
    from relight.commands.evaluate import evaluate_portrait
    from relight.commands.summary import describe_session
    from relight.fit import fit

    started_s = time.monotonic()
    out: Path = args.out
    prepare_folder(out)
    filmed, session = out / "capture", out / "session"
    config = RigConfig.small() if args.quick else RigConfig.from_seed(args.seed)
    if not args.quick:
        config = replace(config, path=replace(config.path, duration_s=_FILM_S))
    with StageProgress() as progress:
        video = simulate_video(filmed, config, progress)
        options = ImportOptions()
        if not args.frames_only:
            options = ImportOptions(poses=filmed / "cameras.json", points=filmed / "points.ply")
        imported = import_source([video], session, options, progress)
        portrait = fit(session, device=args.device, progress=progress)
        table = evaluate_portrait(session, filmed, portrait.name, progress=progress)
        _render(imported, portrait, filmed, out, progress)
    _write_sheet(portrait / "previews", out / "relit.jpg")
    shutil.copyfile(portrait / "report.html", out / "report.html")
    print(describe_session(imported))
    print()
    print(table)
    print()
    print(f"film      {video}")
    print(f"relit     {out / 'relit.jpg'}")
    print(f"pictures  {out / 'pictures'}")
    print(f"orbit     {out / 'orbit.mp4'}")
    print(f"report    {out / 'report.html'}  (open it in a browser)")
    print(f"done in {time.monotonic() - started_s:.0f} s")


def prepare_folder(out: Path) -> None:
    """Makes an empty folder, over an earlier demo but over nothing else.

    Raises:
        DemoError: Something is there that no demo has made.
    """
    if out.is_dir() and (out / _MARKER).is_file():
        shutil.rmtree(out)
    elif out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise DemoError(f"{out} exists and was not made by a demo; name another folder with --out.")
    out.mkdir(parents=True, exist_ok=True)
    (out / _MARKER).write_text(_MARKER_TEXT)


def _render(session: Session, folder: Path, filmed: Path, out: Path, progress: Progress) -> None:
    """The rig's measured lights in two of its validation views, and an orbit under the studio's."""
    from capture.cameras import load_posed_set
    from relight.commands.render import upright_cameras
    from relight.light_spec import load_lights
    from relight.portrait import load_portrait
    from relight.render import render_files, render_orbit

    portrait = load_portrait(folder)
    lights = load_lights(filmed / "lights.json")
    cameras = [frame.camera for frame in load_posed_set(filmed / "cameras_val.json").frames]
    render_files(portrait, cameras[::4], lights, out / "pictures", maps=True, progress=progress)
    around = [camera.scaled(_ORBIT_SCALE) for camera in upright_cameras(session)]
    render_orbit(portrait, around, lights["env1"], out / "orbit.mp4", seconds=_ORBIT_S, progress=progress)


def _write_sheet(previews: Path, file: Path) -> None:
    """The relit previews side by side."""
    import numpy as np

    from capture.images import read_image, write_jpeg

    pictures = [read_image(path) for path in sorted(previews.glob("relit_*.jpg"))]
    write_jpeg(file, np.concatenate(pictures, axis=1), quality=90)
