"""`relight fit`: a portrait of a session."""

from __future__ import annotations

import argparse

from relight.commands.arguments import add_device, add_forced, add_max_seconds, add_session

EXAMPLE = "relight fit S --preset solve --max-seconds 60"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The flags of `relight fit`."""
    add_session(parser)
    parser.add_argument(
        "--preset",
        default="solve",
        metavar="NAME",
        help="how: solve, the photometric solve without a network (default, and the only one so far)",
    )
    parser.add_argument("--name", metavar="NAME", help="what to call the portrait (default: its preset)")
    add_max_seconds(parser)
    add_device(parser)
    add_forced(parser)


def run(args: argparse.Namespace) -> None:
    """Fits, and says where the portrait and its report are."""
    from capture.terminal import StageProgress
    from relight.fit import fit
    from relight.plan import parse_forced

    with StageProgress() as progress:
        folder = fit(
            args.session,
            args.preset,
            device=args.device,
            max_seconds=args.max_seconds,
            name=args.name,
            forced=parse_forced(args.force),
            progress=progress,
        )
    print(f"portrait  {folder}")
    print(f"report    {folder / 'report.html'}")
