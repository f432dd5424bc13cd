"""`relight calibrate dark`: dark level, and with pairs of pictures the noise model."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from relight.commands.calibrate.flags import add_out, add_transfer, chosen_response

if TYPE_CHECKING:
    from calib.sensor.noise import DarkResult, NoiseResult


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The flags."""
    parser.add_argument(
        "source",
        nargs="*",
        type=Path,
        metavar="DARK",
        help="pictures with the lens covered: a folder, single pictures or a session",
    )
    parser.add_argument(
        "--flats",
        nargs="+",
        type=Path,
        default=[],
        metavar="PAIRS",
        help="two or more pictures at each of several exposures, nothing moving: flats, or a kept sweep",
    )
    add_transfer(parser)
    add_out(parser)


def run(args: argparse.Namespace) -> None:
    """Finds dark level and noise and saves them."""
    from calib.calibration import Calibration, Quantity, load_calibration, save_calibration
    from calib.errors import NoiseError
    from calib.sensor.noise import fit_dark, fit_noise
    from calib.sensor.save import save_noise_evidence
    from calib.stills import read_stills
    from capture.controls import common_controls

    if not args.source and not args.flats:
        raise NoiseError("Give pictures with the lens covered, or --flats, or both.")
    out = args.out / "calibration.json" if args.out.is_dir() else args.out
    known = load_calibration(out)
    response, named = chosen_response(known, args.transfer)
    darks = list(read_stills(args.source))
    dark = fit_dark(darks) if darks else None
    level = known.value("dark") if dark is None else dark.level
    found, noise = Calibration(), None
    if dark is not None:
        about = f"{dark.frames} dark pictures of {', '.join(path.name for path in args.source)}"
        made_with = common_controls(still.controls for still in darks).mattering("dark")
        found = Calibration(dark=Quantity.of(dark.level, "1", about, dark.sigma, made_with))
        print(_describe_dark(dark))
    if args.flats:
        flats = list(read_stills(args.flats))
        noise = fit_noise(flats, response, level, darks if dark is not None and not dark.cut else ())
        made_with = common_controls(still.controls for still in flats).mattering("noise_read")
        about = (
            f"photon transfer of {noise.pairs} pairs of {', '.join(path.name for path in args.flats)}, "
            f"linearised by {named}"
        )
        found = Calibration(
            dark=found.dark,
            noise_read=Quantity.of(noise.read, "1", about, noise.read_sigma, made_with),
            noise_shot=Quantity.of(noise.shot, "1", about, noise.shot_sigma, made_with),
        )
        print(_describe_noise(noise, named))
    save_calibration(found, out)
    if noise is not None:
        save_noise_evidence(noise, out)
    print(f"saved       {out}")
    if dark is not None and known.response is not None and known.dark is None and (dark.level > 0.002).any():
        print(
            "note        The response was found before the dark level was known; run `relight calibrate "
            "response` again, which takes it off."
        )


def _describe_dark(dark: DarkResult) -> str:
    values = ", ".join(
        f"{255 * level:.2f} ± {255 * sigma:.2f}" for level, sigma in zip(dark.level, dark.sigma, strict=True)
    )
    notes = [f"note        {sentence}" for sentence in dark.warnings]
    return "\n".join([f"dark level  {values} of 255, from {dark.frames} pictures", *notes])


def _describe_noise(noise: NoiseResult, named: str) -> str:
    read = ", ".join(
        f"{1e3 * value:.3f} ± {1e3 * sigma:.3f}"
        for value, sigma in zip(noise.read, noise.read_sigma, strict=True)
    )
    well = ", ".join(
        f"{1 / value:.0f} ± {sigma / value**2:.0f}" if value > 0 else "not found"
        for value, sigma in zip(noise.shot, noise.shot_sigma, strict=True)
    )
    notes = [f"note        {sentence}" for sentence in noise.warnings]
    return "\n".join(
        [
            f"noise       {read} thousandths of white at black, from {noise.pairs} pairs",
            f"gain        white is {well} electrons; linearised by {named}",
            *notes,
        ]
    )
