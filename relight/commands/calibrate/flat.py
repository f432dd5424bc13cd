"""`relight calibrate flat`: how the lens falls off towards the corners, from pictures of an even surface."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from relight.commands.calibrate.flags import add_out, add_transfer, chosen_response

if TYPE_CHECKING:
    from calib.sensor.flat_field import FlatFieldResult


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The flags."""
    parser.add_argument(
        "source",
        nargs="+",
        type=Path,
        metavar="FLAT",
        help="pictures that a plain, evenly lit surface fills: three or more, each of another place of it or "
        "with the camera turned; a folder, single pictures or a session",
    )
    add_transfer(parser)
    add_out(parser)


def run(args: argparse.Namespace) -> None:
    """Finds the flat field and saves it."""
    from calib.calibration import Calibration, Quantity, load_calibration, save_calibration
    from calib.sensor.flat_field import fit_flat_field
    from calib.sensor.save import save_flat_evidence
    from calib.stills import read_stills
    from capture.controls import common_controls

    out = args.out / "calibration.json" if args.out.is_dir() else args.out
    known = load_calibration(out)
    response, named = chosen_response(known, args.transfer)
    stills = list(read_stills(args.source))
    result = fit_flat_field(stills, response, known.value("dark"))
    made_with = common_controls(still.controls for still in stills).mattering("flat_field")
    corner, sigma = _corner(result)
    about = (
        f"{len(result.flats)} flats of {', '.join(path.name for path in args.source)}, {result.size[0]} x "
        f"{result.size[1]}, linearised by {named}; the corner gets {corner:.3f} ± {sigma:.3f}"
    )
    print(_describe(result, named))
    flat = Quantity.of(result.terms, "1", about, result.sigma, made_with)
    save_calibration(Calibration(flat_field=flat), out)
    save_flat_evidence(result, out)
    print(f"saved       {out}")


def _corner(result: FlatFieldResult) -> tuple[float, float]:
    """What the lens passes in the corner, and its standard deviation."""
    import numpy as np

    passed, sigma = result.passed(np.ones(1))
    return float(passed[0]), float(sigma[0])


def _describe(result: FlatFieldResult, named: str) -> str:
    terms = ", ".join(
        f"a{number} {term:.4f} ± {sigma:.4f}"
        for number, (term, sigma) in enumerate(zip(result.terms, result.sigma, strict=True), start=1)
    )
    corner, sigma = _corner(result)
    flats = [
        f"flat        {flat.name}: corner {flat.corner:.3f}, light sloping by {flat.slope:.1%}, bowl "
        f"{flat.bowl:.1%}, texture {flat.texture:.2%}"
        for flat in result.flats
    ]
    notes = [f"note        {sentence}" for sentence in result.warnings]
    return "\n".join(
        [
            f"lens        passes {corner:.3f} ± {sigma:.3f} in the corner ({terms}); linearised by {named}",
            *flats,
            *notes,
        ]
    )
