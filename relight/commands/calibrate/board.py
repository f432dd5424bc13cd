"""`relight calibrate board`: a ChArUco board to print at true scale."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from relight.commands.arguments import positive_number

if TYPE_CHECKING:
    from calib.board.charuco import Board


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The flags."""
    parser.add_argument(
        "--out", required=True, type=Path, metavar="FILE", help=".pdf or .png; its .json goes beside it"
    )
    add_board_flags(parser)
    parser.add_argument(
        "--paper", default="a4", metavar="NAME", help="a4, a3, letter or tabloid (default a4)"
    )
    parser.add_argument(
        "--dpi", type=positive_number, default=300.0, metavar="N", help="resolution of a .png (default 300)"
    )


def add_board_flags(parser: argparse.ArgumentParser) -> None:
    """Squares and markers of a board."""
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


def board_of(args: argparse.Namespace) -> Board:
    """The board of the flags, with the usual values where they are silent."""
    from calib.board.charuco import Board

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


def run(args: argparse.Namespace) -> None:
    """Writes the sheet and its description."""
    from calib.board.charuco import save_board
    from calib.board.printing import write_sheet

    board = board_of(args)
    write_sheet(board, args.out, args.paper, args.dpi)
    description = args.out.with_suffix(".json")
    save_board(board, description)
    print(board.describe())
    print(f"board     {args.out}  (print it at 100 %, measure its ruler, and glue it to a flat plate)")
    print(f"for       relight calibrate intrinsics VIDEO --board {description} --out calibration.json")


def _squares(text: str) -> tuple[int, int]:
    """7x10, for argparse."""
    across, _, down = text.lower().partition("x")
    return int(across), int(down)
