"""`relight calibrate convert`: intrinsics, response and flat field from or for other tools."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The flags."""
    parser.add_argument(
        "source",
        type=Path,
        metavar="IN",
        help="calibration.json, OpenCV or ROS YAML, COLMAP cameras.txt, Kalibr camchain, mrcal .cameramodel, "
        "TUM pcalib.txt (response) or vignette.png (flat field)",
    )
    parser.add_argument("--out", required=True, type=Path, metavar="OUT", help="file to write")
    parser.add_argument(
        "--to",
        metavar="NAME",
        help="format of OUT: relight (.json), opencv (.yml), colmap (.txt), kalibr (.yaml) or mrcal "
        "(.cameramodel); by default its name tells, as it does for TUM's files",
    )
    parser.add_argument("--camera", metavar="NAME", help="which one, where IN has several")


def run(args: argparse.Namespace) -> None:
    """Reads one file, writes the other."""
    from calib.lens.files import read_lens, write_lens
    from calib.tum import convert_tum, is_pcalib, is_vignette

    if args.to is None and any(is_pcalib(path) or is_vignette(path) for path in (args.source, args.out)):
        what = convert_tum(args.source, args.out)
        print(f"{args.out}: the {what} of {args.source}")
        return
    intrinsics = read_lens(args.source, args.camera)
    write_lens(intrinsics, args.out, args.to)
    print(f"{args.out}: the lens of {args.source}, {intrinsics.width} x {intrinsics.height} pixels")
