"""`relight evaluate`: a portrait against ground truth."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

from relight.commands.arguments import add_portrait, add_session, chosen_portrait

if TYPE_CHECKING:
    from relight.stages import Progress

EXAMPLE = "relight evaluate S --truth portrait_A --json measures.json"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The flags of `relight evaluate`."""
    add_session(parser)
    parser.add_argument(
        "--truth",
        required=True,
        type=Path,
        metavar="DIR",
        help="folder with cameras.json and whatever truth there is: albedo, normals, masks, relit pictures",
    )
    add_portrait(parser)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the measures as JSON too")


def run(args: argparse.Namespace) -> None:
    """Measures and prints the table; the portrait's report shows it from then on."""
    from capture.session import Session
    from capture.terminal import StageProgress

    portrait = chosen_portrait(Session.open(args.session).portraits_dir, args.portrait)
    with StageProgress() as progress:
        table = evaluate_portrait(args.session, args.truth, portrait, json_file=args.json, progress=progress)
    print(table)


def evaluate_portrait(
    session: Path, truth: Path, portrait: str, *, json_file: Path | None = None, progress: Progress
) -> str:
    """Measures a portrait, keeps the measures beside it and in its report, and returns them as a table."""
    from capture.atomic import atomic_write
    from relight.evaluate import evaluate
    from relight.measure_table import format_table
    from relight.report import write_report

    result = evaluate(session, truth, portrait, progress=progress)
    content = (json.dumps(result, indent=2) + "\n").encode()
    atomic_write(session / "portraits" / portrait / "evaluation.json", content)
    if json_file is not None:
        atomic_write(json_file, content)
    write_report(session, portrait)
    return format_table(result)
