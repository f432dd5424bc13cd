"""Flags that several commands share, and the checks that make a bad value a usage error."""

from __future__ import annotations

import argparse
import math
from pathlib import Path

from relight.errors import PortraitError


def add_session(parser: argparse.ArgumentParser) -> None:
    """The session folder."""
    parser.add_argument("session", type=Path, metavar="SESSION", help="session folder")


def add_portrait(parser: argparse.ArgumentParser) -> None:
    """Which of a session's portraits; see `chosen_portrait`."""
    parser.add_argument("--portrait", metavar="NAME", help="which portrait (default: the last one made)")


def add_device(parser: argparse.ArgumentParser) -> None:
    """Where tensors live."""
    parser.add_argument(
        "--device", choices=("cpu", "cuda"), help="where to compute (default: cuda where there is one)"
    )


def add_forced(parser: argparse.ArgumentParser) -> None:
    """Decisions of the plan to turn round."""
    parser.add_argument(
        "--force",
        action="append",
        default=[],
        metavar="NAME=run|skip",
        help="turn a decision of the plan round: undistortion, redundant_views or room_shading",
    )


def add_max_seconds(parser: argparse.ArgumentParser) -> None:
    """A limit on the time of a fit."""
    parser.add_argument(
        "--max-seconds",
        type=positive_number,
        metavar="S",
        help="leave out unlit frames until the fit should end within this time",
    )


def positive_number(text: str) -> float:
    """A finite number above zero, for argparse."""
    number = float(text)
    if not 0 < number < math.inf:
        raise argparse.ArgumentTypeError(f"{text} must be above zero")
    return number


def positive_integer(text: str) -> int:
    """A whole number above zero, for argparse."""
    number = int(text)
    if number <= 0:
        raise argparse.ArgumentTypeError(f"{text} must be above zero")
    return number


def chosen_portrait(portraits: Path, name: str | None) -> str:
    """The name of the portrait to use: the one asked for, or the last one made.

    Raises:
        PortraitError: There is none.
    """
    made = {path.parent.name: path.stat().st_mtime for path in portraits.glob("*/portrait.json")}
    session = portraits.parent
    if not made:
        raise PortraitError(f"{session} has no portrait yet; make one with `relight fit {session}`.")
    if name is None:
        return max(made, key=lambda known: made[known])
    if name not in made:
        raise PortraitError(f"{session} has no portrait {name!r}; it has {', '.join(sorted(made))}.")
    return name
