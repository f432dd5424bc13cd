"""Flags that several parts of `relight calibrate` have, and what they choose."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from calib.calibration import Calibration
    from capture.response import Response


def add_out(parser: argparse.ArgumentParser) -> None:
    """Where what is found goes."""
    parser.add_argument(
        "--out",
        required=True,
        type=Path,
        metavar="FILE",
        help="calibration.json to write into, or the session whose it is",
    )


def add_transfer(parser: argparse.ArgumentParser) -> None:
    """The curve of pictures whose response is not known."""
    parser.add_argument(
        "--transfer",
        metavar="CURVE",
        help="curve of the pictures where calibration.json has no response (default srgb)",
    )


def chosen_response(known: Calibration, transfer: str | None) -> tuple[Response, str]:
    """The response to linearise with, and what it is."""
    from capture.response import Response
    from capture.transfer import canonical_transfer

    if known.response is not None and transfer is None:
        return known.response, "the response of calibration.json"
    name = canonical_transfer(transfer or "srgb")
    return Response(name), f"{name} ({'as named' if transfer else 'no response is known'})"
