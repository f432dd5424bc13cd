"""`relight calibrate`: what a camera and its lamp really do, each part into one calibration.json."""

from __future__ import annotations

import argparse
import importlib

#: Part -> its module, with `add_arguments` and `run`, and what it gives.
_PARTS = {
    "board": ("relight.commands.calibrate.board", "a ChArUco board to print at true scale"),
    "intrinsics": (
        "relight.commands.calibrate.intrinsics",
        "focal length, centre and distortion from pictures of a board",
    ),
    "response": (
        "relight.commands.calibrate.response",
        "stored values to linear radiance, from an exposure sweep",
    ),
    "dark": ("relight.commands.calibrate.dark", "dark level and noise, from dark pictures and from pairs"),
    "flat": ("relight.commands.calibrate.flat", "the lens' fall-off to the corners, from an even surface"),
    "colour": (
        "relight.commands.calibrate.colour",
        "camera RGB to true colours under flash and room, from a ColorChecker",
    ),
    "flash": ("relight.commands.calibrate.flash", "where the flash is and how it shines, from a lit board"),
    "readout": (
        "relight.commands.calibrate.readout",
        "how long a rolling shutter takes over its rows, from a blinking flash",
    ),
    "report": ("relight.commands.calibrate.report", "a page to judge a calibration by, in one file"),
    "convert": (
        "relight.commands.calibrate.convert",
        "lens, response or flat field from or for OpenCV, ROS, COLMAP, Kalibr, mrcal or TUM",
    ),
}

EXAMPLE = (
    "relight calibrate board --out board.pdf\n"
    "  relight calibrate intrinsics VID_20261102_101530.mp4 --board board.json --out calibration.json\n"
    "  relight calibrate response --camera /dev/video0 --out calibration.json\n"
    "  relight calibrate colour SESSION --out calibration.json\n"
    "  relight calibrate flash SESSION --board board.json --calibration calibration.json\n"
    "  relight calibrate report calibration.json"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The parts of `relight calibrate` and their flags."""
    parts = parser.add_subparsers(metavar="WHAT", required=True)
    for name, (module_name, about) in _PARTS.items():
        part = parts.add_parser(name, help=about, description=about[0].upper() + about[1:] + ".")
        part.add_argument(
            "--debug", action="store_true", default=argparse.SUPPRESS, help="show the traceback of an error"
        )
        module = importlib.import_module(module_name)
        module.add_arguments(part)
        part.set_defaults(part=module.run)


def run(args: argparse.Namespace) -> None:
    """Does the part that was asked for."""
    args.part(args)
