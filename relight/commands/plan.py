"""`relight plan`: what a fit would do, as a table."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from relight.commands.arguments import (
    add_forced,
    add_geometry,
    add_max_seconds,
    add_session,
    chosen_geometry,
)

if TYPE_CHECKING:
    from relight.plan import Plan

EXAMPLE = "relight plan S --force room_shading=run"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The flags of `relight plan`."""
    add_session(parser)
    add_forced(parser)
    add_max_seconds(parser)
    add_geometry(parser)
    parser.add_argument("--settings", action="store_true", help="show the settings of the steps that run")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the plan as JSON too")


def run(args: argparse.Namespace) -> None:
    """Prints the plan; a session that cannot be fitted is an error after its table."""
    from capture.atomic import atomic_write
    from capture.session import Session
    from relight.plan import parse_forced
    from relight.planning import make_plan

    plan = make_plan(
        Session.open(args.session), parse_forced(args.force), args.max_seconds, chosen_geometry(args)
    )
    print_plan(plan, args.settings)
    if args.json:
        atomic_write(args.json, (json.dumps(plan.as_json(), indent=2) + "\n").encode())
    plan.check()


def print_plan(plan: Plan, verbose: bool = False) -> None:
    """Prints the decisions, and on demand the settings of the steps that run."""
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    for head in ("step", "", "why", "takes", "saves"):
        table.add_column(head, style="dim" if head == "saves" else None)
    for decision in plan.decisions:
        action = f"{decision.action.value} (forced)" if decision.forced else decision.action.value
        takes = f"{decision.estimated_s:.0f} s" if decision.estimated_s >= 1.0 else ""
        table.add_row(decision.name, action, decision.reason, takes, decision.saving)
    # In a file or a pipe no terminal sets the width: the reasons should not be cut to 80 columns.
    console = Console(width=None if sys.stdout.isatty() else 140)
    console.print(table)
    if verbose:
        for decision in plan.decisions:
            if decision.settings:
                resolved = ", ".join(f"{name} {value}" for name, value in decision.settings.items())
                console.print(f"\n{decision.name}: {resolved}", highlight=False)
    console.print(f"\nabout {_duration(plan.estimated_s)} on two cores")


def _duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.0f} minutes"
