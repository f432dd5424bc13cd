"""`relight calibrate flash`: where the flash is and how it shines, from a board with and without it."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from relight.commands.arguments import positive_number

if TYPE_CHECKING:
    from calib.flash.geometry import FlashGeometry


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The flags."""
    parser.add_argument(
        "source",
        type=Path,
        metavar="SOURCE",
        help="a session of the board with the flash blinking, or a folder with pairs NAME_flash and "
        "NAME_noflash",
    )
    parser.add_argument(
        "--board", required=True, type=Path, metavar="FILE", help="the .json of the printed board"
    )
    parser.add_argument(
        "--calibration",
        type=Path,
        metavar="FILE",
        help="calibration.json with the camera's intrinsics (default: the session's)",
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        help="calibration.json to write into, or the session whose it is (default: that of --calibration)",
    )
    parser.add_argument(
        "--paper-albedo",
        type=positive_number,
        default=1.0,
        metavar="RHO",
        help="albedo of the board's white (default 1: the strength is then that of this paper)",
    )
    parser.add_argument(
        "--flat",
        action="store_true",
        help="find the lens's fall-off to the corners from the same light, where no flat field is known: a "
        "flash some centimetres beside the lens and boards in all corners tell the two apart",
    )
    parser.add_argument(
        "--transfer",
        default="srgb",
        metavar="NAME",
        help="transfer function of a folder's pictures, where the calibration has no response (default srgb)",
    )


def run(args: argparse.Namespace) -> None:
    """Reads the pairs, finds the flash, saves and reports."""
    from calib.board.charuco import load_board
    from calib.calibration import Calibration, load_calibration, save_calibration
    from calib.errors import FlashGeometryError
    from calib.flash.geometry import calibrate_flash
    from calib.flash.lens_falloff import find_flat
    from calib.flash.model import LIGHT_SIZE
    from calib.flash.pairs import open_pairs
    from calib.flash.samples import collect_boards, lens_vector
    from calib.flash.save import flash_evidence_path, save_flash
    from capture.terminal import StageProgress

    board = load_board(args.board)
    known_at = _file_of(args.calibration) if args.calibration else args.source / "calibration.json"
    if args.source.exists() and not known_at.is_file():
        raise FlashGeometryError(
            f"{known_at} does not exist; name the calibration.json with the camera's intrinsics "
            "(--calibration)."
        )
    calibration = load_calibration(known_at)
    pairs = open_pairs(args.source, calibration, args.transfer)
    lens_vector(calibration.intrinsics)  # before the pictures are read, which takes long
    out = _file_of(args.out or known_at)
    if args.flat and calibration.flat_field is not None:
        raise FlashGeometryError(
            f"{known_at} has a flat field already, which is taken off; leave out --flat, or the flat field."
        )
    flat, joint = None, None
    with StageProgress() as progress:
        collected = collect_boards(pairs.pairs(), pairs.count, board, calibration, progress)
        if args.flat and calibration.intrinsics is not None:
            flat = find_flat(collected, calibration.intrinsics)
            collected = flat.evened
            calibration = replace(calibration, flat_field=flat.entry(args.source.name, pairs.controls))
            joint = flat.found.covariance[:LIGHT_SIZE, :LIGHT_SIZE]
        found = calibrate_flash(collected, calibration, args.paper_albedo, progress, joint)
    save_flash(found, board, out, args.source.name, pairs.controls)
    if flat is not None:
        save_calibration(Calibration(flat_field=calibration.flat_field), out)
    print(f"pictures    {'; '.join([found.pairs, *pairs.left_out])}; linear by {pairs.transfer}")
    print(_describe(found))
    if flat is not None:
        passed, sigma = flat.found.corner
        print(
            f"lens        passes {passed:.3f} ± {sigma:.3f} in the corner; squares reach "
            f"{flat.found.reach:.0%} of the way to it"
        )
    print(f"saved       {out}, and what it was made from in {flash_evidence_path(out).name}")


def _file_of(path: Path) -> Path:
    return path / "calibration.json" if path.is_dir() else path


def _describe(found: FlashGeometry) -> str:
    """What was found, in a few lines for a person."""
    import numpy as np

    from calib.flash.checks import axis_sigma, falloff_sigma
    from calib.flash.geometry import poses_of
    from calib.flash.model import FALLOFF

    light, check = found.fit.light, found.held_out
    place = ", ".join(
        f"{name} {1e3 * value:.1f} ± {1e3 * sigma:.1f}"
        for name, value, sigma in zip("xyz", light.position_m, found.position_sigma_m, strict=True)
    )
    axis = "along the optical axis (not determined)"
    if found.axis_known:
        right, down = np.degrees(np.arctan2(light.axis[:2], light.axis[2]))
        axis = f"{right:.1f} degrees to the right, {down:.1f} down, ± {np.degrees(axis_sigma(found.fit)):.1f}"
    strengths = ", ".join(
        f"{name} {value:.4g} ± {100 * sigma / value:.1f} %"
        for name, value, sigma in zip(
            "RGB", found.strength, np.sqrt(np.diag(found.strength_covariance)), strict=True
        )
    )
    squares, pulses = found.left_out
    droop, droop_sigma = found.droop
    lines = [
        f"light       {len(found.boards)} boards in {poses_of(found)} poses; left out: {squares} squares, "
        f"{pulses} pulses",
        f"place       {place} mm from the lens (right, down, forwards)",
        f"axis        {axis}",
        f"falloff     cos^{light.vector[FALLOFF]:.2f} ± {falloff_sigma(found.fit):.2f}",
        f"strength    {strengths} m^2 (paper taken as albedo {found.paper_albedo:g})",
        f"pulses      {100 * found.fit.spread.pulse:.2f} % from each other, {100 * droop:+.2f} ± "
        f"{100 * droop_sigma:.2f} % from first to last",
        f"held out    {100 * check.rms:.2f} % off ({100 * check.expected:.2f} % expected), "
        f"{100 * check.shape_rms:.2f} % within a board",
        *(f"note        {sentence}" for sentence in found.notes),
    ]
    return "\n".join(lines)
