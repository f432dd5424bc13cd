"""`relight render`: pictures, maps and videos of a portrait."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from capture.errors import RelightError
from relight.commands.arguments import add_device, add_portrait, add_session, chosen_portrait, positive_number

if TYPE_CHECKING:
    from capture.cameras import Camera
    from capture.session import Session
    from relight.lighting import Light
    from relight.portrait import Portrait
    from relight.stages import Progress

EXAMPLE = "relight render S --light 'directional:0.5,0.5,0.7;ambient=0.3' --light room --out pictures"

_ORBIT_S = 8.0
_DEFAULT_VIEWS = 5


class RenderError(RelightError):
    """What was asked for cannot be rendered."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The flags of `relight render`."""
    add_session(parser)
    parser.add_argument(
        "--light",
        action="append",
        default=[],
        metavar="SPEC",
        help="a light, such as room, flash, directional:0,0,1;ambient=0.5, point:0.3,0.4,0.6;color=1,.8,.6, "
        "env:studio.hdr;rotate=90 or room+flash; repeat it for more",
    )
    parser.add_argument("--lights", type=Path, metavar="FILE", help="lights.json with several lights")
    where = parser.add_mutually_exclusive_group()
    where.add_argument(
        "--cameras",
        type=Path,
        metavar="FILE",
        help="views to render, as cameras.json (default: some captured)",
    )
    where.add_argument("--orbit", action="store_true", help="a video around the head")
    parser.add_argument(
        "--maps",
        action="store_true",
        help="write albedo, normal, shading, mask, depth, and how far they can be believed",
    )
    parser.add_argument("--no-shadows", action="store_true", help="let new lights pass through the head")
    parser.add_argument(
        "--seconds",
        type=positive_number,
        default=_ORBIT_S,
        metavar="S",
        help="length of an orbit (default 8)",
    )
    add_portrait(parser)
    parser.add_argument(
        "--out",
        required=True,
        type=Path,
        metavar="DIR_OR_MP4",
        help="folder for pictures, or the .mp4 of an orbit",
    )
    add_device(parser)


def run(args: argparse.Namespace) -> None:
    """Renders, and says where the files are."""
    from capture.session import Session
    from capture.terminal import StageProgress
    from relight.devices import choose_device
    from relight.light_spec import load_lights, parse_lights
    from relight.portrait import load_portrait

    session = Session.open(args.session)
    lights = parse_lights(args.light, Path.cwd()) | (load_lights(args.lights) if args.lights else {})
    is_video = args.out.suffix.lower() == ".mp4"
    if is_video and (args.cameras or args.maps or len(lights) != 1):
        raise RenderError(f"{args.out} is a video: it takes one --light; give --out a folder for the rest.")
    if not lights and (args.orbit or not args.maps):
        raise RenderError("There is nothing to render: name a --light or --lights, or ask for --maps.")
    name = chosen_portrait(session.portraits_dir, args.portrait)
    portrait = load_portrait(session.portraits_dir / name, choose_device(args.device))
    with StageProgress() as progress:
        if is_video or args.orbit:
            videos = {light: args.out if is_video else args.out / f"orbit.{light}.mp4" for light in lights}
            _orbits(portrait, upright_cameras(session), lights, videos, args, progress)
            said = "\n".join(str(video) for video in videos.values())
        else:
            cameras = _cameras(session, args.cameras)
            captured = list(session.load_scene_cameras().values())
            said = _pictures(portrait, cameras, captured, lights, args, progress)
    print(said)


def upright_cameras(session: Session) -> list[Camera]:
    """The captured cameras as people look at their pictures, for an orbit."""
    from relight.upright import upright_camera

    rotation_deg = session.info["image"]["rotation_deg"]
    return [upright_camera(camera, rotation_deg) for camera in session.load_scene_cameras().values()]


def _orbits(
    portrait: Portrait,
    cameras: Sequence[Camera],
    lights: Mapping[str, Light],
    videos: Mapping[str, Path],
    args: argparse.Namespace,
    progress: Progress,
) -> None:
    from relight.render import render_orbit

    for name, light in lights.items():
        videos[name].parent.mkdir(parents=True, exist_ok=True)
        render_orbit(
            portrait,
            cameras,
            light,
            videos[name],
            seconds=args.seconds,
            shadows=not args.no_shadows,
            progress=progress,
        )


def _pictures(
    portrait: Portrait,
    cameras: Sequence[Camera],
    captured: Sequence[Camera],
    lights: Mapping[str, Light],
    args: argparse.Namespace,
    progress: Progress,
) -> str:
    from relight.render import render_files

    files = render_files(
        portrait,
        cameras,
        lights,
        args.out,
        maps=args.maps,
        captured=captured,
        shadows=not args.no_shadows,
        progress=progress,
    )
    return f"{len(files)} files of {len(cameras)} views in {args.out}"


def _cameras(session: Session, file: Path | None) -> list[Camera]:
    """Those of a cameras.json, or some of the session's own: held-out ones where there are any."""
    from capture.cameras import load_posed_set

    if file is not None:
        return [frame.camera for frame in load_posed_set(file).frames]
    poses = session.load_scene_cameras()
    records = [record for record in session.frames if record.usable and record.index in poses]
    records = [record for record in records if record.split == "val"] or records
    step = max(1, len(records) // _DEFAULT_VIEWS)
    return [replace(poses[record.index], name=f"{record.index:06d}") for record in records[::step]]
