"""`relight calibrate`: a board to print, a lens from pictures of it, and files of other tools."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from relight.commands.arguments import positive_integer, positive_number

if TYPE_CHECKING:
    from calib.board import Board
    from calib.intrinsics import IntrinsicsResult

    Parts = argparse._SubParsersAction[argparse.ArgumentParser]

EXAMPLE = (
    "relight calibrate board --out board.pdf\n"
    "  relight calibrate intrinsics VID_20261102_101530.mp4 --board board.json --out calibration.json"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The parts of `relight calibrate` and their flags."""
    parts = parser.add_subparsers(metavar="WHAT", required=True)
    _add_board(_part(parts, "board", "a ChArUco board to print at true scale"))
    _add_intrinsics(
        _part(parts, "intrinsics", "focal length, centre and distortion from pictures of a board")
    )
    _add_convert(_part(parts, "convert", "intrinsics from or for OpenCV, ROS, COLMAP, Kalibr or mrcal"))


def run(args: argparse.Namespace) -> None:
    """Does the part that was asked for."""
    args.part(args)


def _part(parts: Parts, name: str, about: str) -> argparse.ArgumentParser:
    parser = parts.add_parser(name, help=about, description=about[0].upper() + about[1:] + ".")
    parser.add_argument(
        "--debug", action="store_true", default=argparse.SUPPRESS, help="show the traceback of an error"
    )
    return parser


def _add_board(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--out", required=True, type=Path, metavar="FILE", help=".pdf or .png; its .json goes beside it"
    )
    _add_board_flags(parser)
    parser.add_argument(
        "--paper", default="a4", metavar="NAME", help="a4, a3, letter or tabloid (default a4)"
    )
    parser.add_argument(
        "--dpi", type=positive_number, default=300.0, metavar="N", help="resolution of a .png (default 300)"
    )
    parser.set_defaults(part=_make_board)


def _add_board_flags(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--squares", type=_squares, metavar="WxH", help="squares across and down (default 7x10)"
    )
    parser.add_argument(
        "--square-mm", type=positive_number, metavar="MM", help="side of a square, mm (default 25)"
    )
    parser.add_argument(
        "--marker-mm",
        type=positive_number,
        metavar="MM",
        help="side of a marker, mm (default 0.72 of a square)",
    )
    parser.add_argument("--dictionary", metavar="NAME", help="family of the markers (default DICT_5X5_250)")
    parser.add_argument(
        "--legacy",
        action="store_true",
        default=None,
        help="layout of OpenCV before 4.6 and of calib.io (only how it is printed: both are looked for)",
    )


def _add_intrinsics(parser: argparse.ArgumentParser) -> None:
    from calib.lens_terms import LENS_MODELS

    parser.add_argument(
        "source",
        nargs="+",
        type=Path,
        metavar="SOURCE",
        help="videos, folders with stills, or sessions in which the board is seen",
    )
    parser.add_argument("--board", type=Path, metavar="FILE", help="the .json of the printed board, or:")
    _add_board_flags(parser)
    parser.add_argument(
        "--out",
        required=True,
        type=Path,
        metavar="FILE",
        help="calibration.json to write into, or the session whose it is",
    )
    parser.add_argument("--report", type=Path, metavar="FILE", help="an .html page to judge it by")
    parser.add_argument(
        "--model",
        choices=list(LENS_MODELS),
        help="distortion terms (default: those with the smallest error on pictures not used)",
    )
    parser.add_argument(
        "--views",
        type=positive_integer,
        default=60,
        metavar="N",
        help="most views that are used (default 60)",
    )
    parser.add_argument(
        "--distance-m",
        type=positive_number,
        metavar="M",
        help="distance at which projection uncertainty is stated (default: that of the boards)",
    )
    parser.set_defaults(part=_find_intrinsics)


def _add_convert(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "source",
        type=Path,
        metavar="IN",
        help="calibration.json, OpenCV or ROS YAML, COLMAP cameras.txt, Kalibr camchain, mrcal .cameramodel",
    )
    parser.add_argument("--out", required=True, type=Path, metavar="OUT", help="file to write")
    parser.add_argument(
        "--to",
        metavar="NAME",
        help="format of OUT: relight (.json), opencv (.yml), colmap (.txt), kalibr (.yaml) or mrcal "
        "(.cameramodel); by default its name tells",
    )
    parser.add_argument("--camera", metavar="NAME", help="which one, where IN has several")
    parser.set_defaults(part=_convert)


def _squares(text: str) -> tuple[int, int]:
    """7x10, for argparse."""
    across, _, down = text.lower().partition("x")
    return int(across), int(down)


def _board_of(args: argparse.Namespace) -> Board:
    """The board of the flags, with the usual values where they are silent."""
    from calib.board import Board

    usual = Board()
    square_m = args.square_mm / 1e3 if args.square_mm else usual.square_m
    in_proportion_m = round(square_m * usual.marker_m / usual.square_m, 4)
    return Board(
        squares=args.squares or usual.squares,
        square_m=square_m,
        marker_m=args.marker_mm / 1e3 if args.marker_mm else in_proportion_m,
        dictionary=args.dictionary or usual.dictionary,
        layout="legacy" if args.legacy else "current",
    )


def _make_board(args: argparse.Namespace) -> None:
    from calib.board import save_board
    from calib.board_print import write_sheet

    board = _board_of(args)
    write_sheet(board, args.out, args.paper, args.dpi)
    description = args.out.with_suffix(".json")
    save_board(board, description)
    print(board.describe())
    print(f"board     {args.out}  (print it at 100 %, measure its ruler, and glue it to a flat plate)")
    print(f"for       relight calibrate intrinsics VIDEO --board {description} --out calibration.json")


def _find_intrinsics(args: argparse.Namespace) -> None:
    import numpy as np

    from calib.board import load_board
    from calib.board_pictures import board_pictures
    from calib.board_views import collect_views
    from calib.errors import BoardError
    from calib.intrinsics import calibrate_intrinsics
    from calib.intrinsics_report import write_intrinsics_report
    from calib.intrinsics_save import evidence_path, save_intrinsics
    from capture.terminal import StageProgress

    flags = (args.squares, args.square_mm, args.marker_mm, args.dictionary, args.legacy)
    if args.board and any(flag is not None for flag in flags):
        raise BoardError(f"{args.board} describes the board already; give it or the flags, not both.")
    board = load_board(args.board) if args.board else _board_of(args)
    out = args.out / "calibration.json" if args.out.is_dir() else args.out
    with StageProgress() as progress:
        found = collect_views(board_pictures(args.source), board, args.views, progress)
        result = calibrate_intrinsics(found.views, board, args.model, progress)
    distance_m = args.distance_m or float(np.median(result.distances_m))
    source = ", ".join(path.name for path in args.source)
    save_intrinsics(result, out, source, distance_m)
    print(f"pictures    {found.describe()}")
    print(_describe(result, distance_m))
    print(f"saved       {out}, and what it was made from in {evidence_path(out).name}")
    if args.report:
        write_intrinsics_report(result, args.report, distance_m, found.describe(), f"Lens of {source}")
        print(f"report      {args.report}  (open it in a browser)")


def _describe(result: IntrinsicsResult, distance_m: float) -> str:
    """What was found, in a few lines for a person."""
    import numpy as np

    from calib.lens_terms import LENS_MODELS, LENS_NAMES
    from calib.lens_uncertainty import pixel_grid, projection_sigma

    numbers = dict(zip(LENS_NAMES, zip(result.lens, result.sigma, strict=True), strict=True))
    pinhole = ", ".join(f"{name} {numbers[name][0]:.2f} ± {numbers[name][1]:.2f}" for name in LENS_NAMES[:4])
    terms = ", ".join(
        f"{name} {numbers[name][0]:.4f} ± {numbers[name][1]:.4f}" for name in LENS_MODELS[result.model]
    )
    sigma, _ = projection_sigma(result.lens, result.uncertainty, pixel_grid(result.size)[0], distance_m)
    lines = [
        f"board       {result.board.describe()}",
        f"lens        {pinhole} px in {result.size[0]} x {result.size[1]}",
        f"distortion  {terms or 'none'}",
        f"corners     {int(result.observations.seen.sum())} in {len(result.views)} views, noise "
        f"{result.uncertainty.noise_px:.3f} px",
        f"projection  off by {np.nanmedian(sigma):.3f} px (median), {np.nanmax(sigma):.3f} px at worst, at "
        f"{distance_m:.2f} m",
        *(
            f"halves      {check.split}: {check.rms_px:.3f} px apart, {check.expected_px:.3f} expected"
            for check in result.halves
        ),
        *(f"note        {sentence}" for sentence in result.warnings),
    ]
    return "\n".join(lines)


def _convert(args: argparse.Namespace) -> None:
    from calib.lens_files import read_lens, write_lens

    intrinsics = read_lens(args.source, args.camera)
    write_lens(intrinsics, args.out, args.to)
    print(f"{args.out}: the lens of {args.source}, {intrinsics.width} x {intrinsics.height} pixels")
