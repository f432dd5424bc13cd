"""`relight calibrate intrinsics`: a lens from pictures of a board."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from relight.commands.arguments import positive_integer, positive_number
from relight.commands.calibrate.board import add_board_flags, board_of
from relight.commands.calibrate.flags import add_out

if TYPE_CHECKING:
    from calib.lens.intrinsics import IntrinsicsResult
    from capture.controls import Controls


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The flags."""
    from calib.lens.terms import LENS_MODELS

    parser.add_argument(
        "source",
        nargs="+",
        type=Path,
        metavar="SOURCE",
        help="videos, folders with stills, or sessions in which the board is seen",
    )
    parser.add_argument("--board", type=Path, metavar="FILE", help="the .json of the printed board, or:")
    add_board_flags(parser)
    add_out(parser)
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


def run(args: argparse.Namespace) -> None:
    """Finds the views, calibrates, saves and reports."""
    import numpy as np

    from calib.board.charuco import load_board
    from calib.board.pictures import board_pictures
    from calib.errors import BoardError
    from calib.lens.intrinsics import calibrate_intrinsics
    from calib.lens.report import write_intrinsics_report
    from calib.lens.save import evidence_path, save_intrinsics
    from calib.lens.views import collect_views
    from capture.terminal import StageProgress

    flags = (args.squares, args.square_mm, args.marker_mm, args.dictionary, args.legacy)
    if args.board and any(flag is not None for flag in flags):
        raise BoardError(f"{args.board} describes the board already; give it or the flags, not both.")
    board = load_board(args.board) if args.board else board_of(args)
    out = args.out / "calibration.json" if args.out.is_dir() else args.out
    with StageProgress() as progress:
        found = collect_views(board_pictures(args.source), board, args.views, progress)
        result = calibrate_intrinsics(found.views, board, args.model, progress)
    distance_m = args.distance_m or float(np.median(result.distances_m))
    source = ", ".join(path.name for path in args.source)
    save_intrinsics(result, out, source, distance_m, _controls(args.source))
    print(f"pictures    {found.describe()}")
    print(_describe(result, distance_m))
    print(f"saved       {out}, and what it was made from in {evidence_path(out).name}")
    if args.report:
        write_intrinsics_report(result, args.report, distance_m, found.describe(), f"Lens of {source}")
        print(f"report      {args.report}  (open it in a browser)")


def _controls(sources: list[Path]) -> Controls:
    """The settings of the camera, where all sources are sessions, which tell them."""
    from capture.controls import Controls, common_controls
    from capture.session import Session

    if not all((source / "session.json").is_file() for source in sources):
        return Controls()
    return common_controls(Session.open(source).controls for source in sources)


def _describe(result: IntrinsicsResult, distance_m: float) -> str:
    """What was found, in a few lines for a person."""
    import numpy as np

    from calib.lens.terms import LENS_MODELS, LENS_NAMES
    from calib.lens.uncertainty import pixel_grid, projection_sigma

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
