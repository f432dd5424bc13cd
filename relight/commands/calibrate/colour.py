"""`relight calibrate colour`: camera RGB to true colours, from a ColorChecker under flash and room."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from relight.commands.calibrate.flags import add_out, add_transfer, chosen_response

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from calib.calibration import Calibration
    from calib.colour.chart import ChartReading
    from calib.colour.collect import ChartLights
    from calib.colour.fit import ColourFit
    from calib.flash.pairs import LinearPicture
    from calib.stills import Still
    from capture.controls import Controls
    from capture.response import Response


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The flags."""
    parser.add_argument(
        "source",
        nargs="+",
        type=Path,
        metavar="SOURCE",
        help="a session of the chart with the flash blinking, or a folder with pairs NAME_flash and "
        "NAME_noflash; with --light: pictures, folders or sessions in one light",
    )
    parser.add_argument(
        "--light",
        choices=("flash", "room"),
        help="all pictures are in this light alone (the flash: in a dark room)",
    )
    parser.add_argument(
        "--chart",
        choices=("after 2014", "before 2014"),
        help="edition of the ColorChecker Classic (default: the one that fits better)",
    )
    add_transfer(parser)
    add_out(parser)


def run(args: argparse.Namespace) -> None:
    """Finds the charts, fits both lights, saves and reports."""
    from calib.calibration import load_calibration
    from calib.colour.fit import fit_colour
    from calib.colour.save import colour_evidence_path, room_white, save_colour
    from calib.errors import ColourError

    out = args.out / "calibration.json" if args.out.is_dir() else args.out
    known = load_calibration(out)
    if args.light is None and len(args.source) != 1:
        raise ColourError(
            "Give one session or folder of pairs, or say with --light which light the pictures are in."
        )
    lights, controls, named = _read(args, known)
    lights.check()

    def fit(readings: Sequence[ChartReading]) -> ColourFit | None:
        return fit_colour(readings, args.chart) if readings else None

    flash, room = fit(lights.flash), fit(lights.room)
    source = ", ".join(path.name for path in args.source)
    save_colour(flash, room, out, f"{source}, linearised by {named}", controls)
    print(f"pictures    {lights.describe()}; linearised by {named}")
    for light, found in (("flash", flash), ("room", room)):
        if found is not None:
            print(_describe(light, found))
    if flash is not None and room is not None:
        white = ", ".join(f"{value:.3f}" for value in room_white(flash, room))
        print(f"room        its white is {white} (R, G, B), taking the flash for white")
    if flash is None:
        print("note        The chart was not seen under the flash: its light is taken for that of the room.")
    if lights.dark_room:
        print(f"note        In {lights.dark_room} pairs the room is too dark to tell its colour.")
    print(f"saved       {out}, and what it was made from in {colour_evidence_path(out).name}")


def _read(args: argparse.Namespace, known: Calibration) -> tuple[ChartLights, Controls, str]:
    """The charts, the camera's settings, and what the pictures were linearised by."""
    from calib.colour.collect import charts_of_pairs, charts_of_pictures
    from calib.flash.pairs import open_pairs
    from calib.stills import read_stills
    from capture.controls import common_controls

    if args.light is None:
        pairs = open_pairs(args.source[0], known, args.transfer or "srgb")
        return charts_of_pairs(pairs.pairs(), known.value("flat_field")), pairs.controls, pairs.transfer
    response, named = chosen_response(known, args.transfer)
    stills = list(read_stills(args.source))
    pictures = _linear(stills, response, known)
    found = charts_of_pictures(pictures, args.light, known.value("flat_field"))
    return found, common_controls(still.controls for still in stills), named


def _linear(stills: Sequence[Still], response: Response, known: Calibration) -> Iterator[LinearPicture]:
    import numpy as np

    from calib.flash.pairs import linear_picture

    for still in stills:
        yield linear_picture(still.name, still.image, response, known.value("dark"), np.inf)


def _describe(light: str, found: ColourFit) -> str:
    rows = [
        "  ".join(f"{value:+.4f} ± {sigma:.4f}" for value, sigma in zip(row, sigmas, strict=True))
        for row, sigmas in zip(found.matrix, found.sigma, strict=True)
    ]
    notes = [f"note        {sentence}" for sentence in found.warnings]
    return "\n".join(
        [
            f"{light:<11} ColorChecker {found.reference.edition}, {len(found.names)} pictures; CIEDE2000 "
            f"{found.errors.describe()}",
            f"            without it {found.uncorrected.mean():.2f}; root-polynomial "
            f"{found.polynomial_errors.describe()}",
            *(f"{'matrix' if number == 0 else '':<11} {row}" for number, row in enumerate(rows)),
            *notes,
        ]
    )
