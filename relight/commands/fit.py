"""`relight fit`: a portrait of a session, or of a film or a folder of pictures in one go."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from capture.errors import RelightError
from relight.commands.arguments import (
    add_device,
    add_forced,
    add_geometry,
    add_max_seconds,
    add_refinement,
    chosen_geometry,
    chosen_settings,
)

if TYPE_CHECKING:
    from capture.session import Session
    from relight.stages import Progress

EXAMPLE = """relight fit VID_20261102_101530.mp4
  relight fit S --preset solve --max-seconds 60
  relight fit S --preset paper --max-seconds 3600 --set precision=bfloat16"""


class FitError(RelightError):
    """What was named cannot be fitted."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The flags of `relight fit`."""
    parser.add_argument(
        "source",
        nargs="+",
        type=Path,
        metavar="SESSION",
        help="session folder; or anything that `relight import` takes, which is imported first",
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="SESSION",
        help="session to import into (default: the source's name + .session)",
    )
    parser.add_argument(
        "--preset",
        default="solve",
        metavar="NAME",
        help="how: solve, the photometric solve without a network (default); fast and balanced, with a small "
        "network for what the solve leaves; paper, the paper's network, which takes hours",
    )
    parser.add_argument("--name", metavar="NAME", help="what to call the portrait (default: its preset)")
    parser.add_argument(
        "--fresh", action="store_true", help="do again what an earlier run left, though nothing has changed"
    )
    add_max_seconds(parser)
    add_device(parser)
    add_forced(parser)
    add_geometry(parser)
    add_refinement(parser)


def run(args: argparse.Namespace) -> None:
    """Imports if need be, fits, and says where the portrait and its report are."""
    from capture.session import Session
    from capture.terminal import StageProgress
    from relight.commands.summary import describe_geometry
    from relight.fit import fit
    from relight.plan import parse_forced

    forced, geometry, settings = parse_forced(args.force), chosen_geometry(args), chosen_settings(args)
    with StageProgress() as progress:
        session = session_of(args.source, args.out, progress)
        folder = fit(
            session,
            args.preset,
            device=args.device,
            max_seconds=args.max_seconds,
            name=args.name,
            forced=forced,
            geometry=geometry,
            settings=settings,
            seed=args.seed,
            fresh=args.fresh,
            progress=progress,
        )
    for line in describe_geometry(Session.open(session)):
        print(line)
    print(f"portrait  {folder}")
    print(f"report    {folder / 'report.html'}")


def session_of(source: Sequence[Path], out: Path | None, progress: Progress) -> Path:
    """The session that is named, or the one that what is named was imported into, now or before.

    Raises:
        FitError: It is neither, or both a session and a place to import into are named.
    """
    first = source[0]
    if (first / "session.json").is_file():
        if len(source) > 1 or out is not None:
            raise FitError(f"{first} is a session already; name it alone, without --out.")
        return first
    from capture.importers import ImportOptions, import_source
    from capture.session import Session

    target = out if out is not None else first.with_name(first.stem + ".session")
    if (target / "session.json").is_file():
        there = Session.open(target)
        named = {path.name for path in source} | {str(path) for path in source}
        if there.status == "complete" and _comes_from(there, named):
            return target  # imported before: a second run goes on from there
    import_source(source, target, ImportOptions(), progress)
    return target


def _comes_from(session: Session, names: set[str]) -> bool:
    """Whether a session's source names any of these files."""
    source = session.info["source"]
    files = {entry["name"] for entry in source.get("files", [])}
    return not names.isdisjoint(files | {source.get("path")})
