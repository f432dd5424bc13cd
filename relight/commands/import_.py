"""`relight import`: a session from what a camera, a tool or a data set left behind."""

from __future__ import annotations

import argparse
from pathlib import Path

from relight.commands.arguments import positive_number

EXAMPLE = "relight import VID_20261102_101530.mp4 --poses cameras.json --points points.ply --out S"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The flags of `relight import`."""
    parser.add_argument(
        "source",
        nargs="+",
        type=Path,
        metavar="SOURCE",
        help="videos of one capture, a folder of RAW files or of pictures, a folder or file of posed images "
        "(cameras.json), a COLMAP model, or a nerfstudio transforms.json",
    )
    parser.add_argument("--out", required=True, type=Path, metavar="SESSION", help="session folder to make")
    parser.add_argument(
        "--flash-list",
        type=Path,
        metavar="FILE",
        help="which frames are lit, for sources that do not say; videos and pictures show it themselves",
    )
    parser.add_argument("--poses", type=Path, metavar="FILE", help="cameras.json with the poses of a video")
    parser.add_argument("--points", type=Path, metavar="FILE", help="point cloud, .ply")
    parser.add_argument("--masks", type=Path, metavar="DIR", help="masks of the head, named like the frames")
    parser.add_argument(
        "--calibration",
        type=Path,
        metavar="FILE",
        help="calibration.json of this camera and flash; goes before what the source says of them",
    )
    parser.add_argument(
        "--without",
        type=source_parts,
        default=frozenset(),
        metavar="PARTS",
        help="what an image set brings and the session shall not have, so that it is found from the pictures:"
        " of poses, points, masks, flash, with commas between",
    )
    parser.add_argument(
        "--transfer",
        metavar="NAME",
        help="transfer function of the pictures where the source does not say it or is wrong: linear, srgb, "
        "rec709, gamma:2.2, log:100, jtvideo, jtlog, jtlog2",
    )
    parser.add_argument(
        "--keep-location", action="store_true", help="keep where it was filmed; by default it is left out"
    )
    parser.add_argument(
        "--rate",
        type=positive_number,
        default=6.0,
        metavar="HZ",
        help="frames kept of each second of a video beside the lit ones (default 6)",
    )


def source_parts(text: str) -> frozenset[str]:
    """An argparse type: names of what a source brings, with commas between."""
    from capture.importers.options import PARTS

    parts = [part.strip() for part in text.split(",")]
    if unknown := [part for part in parts if part not in PARTS]:
        raise argparse.ArgumentTypeError(f"{unknown[0]!r} is not one of {', '.join(PARTS)}")
    return frozenset(parts)


def run(args: argparse.Namespace) -> None:
    """Imports and says what came of it."""
    from capture.importers import ImportOptions, import_source
    from capture.terminal import StageProgress
    from relight.commands.summary import describe_session

    options = ImportOptions(
        flash_list=args.flash_list,
        poses=args.poses,
        points=args.points,
        masks=args.masks,
        transfer=args.transfer,
        calibration=args.calibration,
        without=args.without,
        keep_location=args.keep_location,
        kept_rate_hz=args.rate,
    )
    with StageProgress() as progress:
        session = import_source(args.source, args.out, options, progress)
    print(describe_session(session))
