"""`relight calibrate report`: a page that a person can judge a calibration from."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The flags."""
    parser.add_argument(
        "calibration",
        type=Path,
        metavar="CALIBRATION",
        help="calibration.json, or the session whose it is; the evidence is looked for beside it",
    )
    parser.add_argument(
        "--out", type=Path, metavar="FILE", help="the .html file (default: beside the calibration)"
    )


def run(args: argparse.Namespace) -> None:
    """Writes the page and says the verdicts."""
    from calib.report.write import write_calibration_report

    calibration = args.calibration
    if calibration.is_dir():
        calibration = calibration / "calibration.json"
    out = args.out or calibration.with_suffix(".html")
    for part in write_calibration_report(calibration, out):
        print(f"{part.name.lower():<11} {part.verdict}: {part.why}")
    print(f"report      {out}  (open it in a browser)")
