"""`relight stress`: every stage under hostile inputs, as a table."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

EXAMPLE = "relight stress --only lights --dtype float32 --json stress.json"

_DTYPES = ("float64", "float32", "bfloat16")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The flags of `relight stress`."""
    parser.add_argument(
        "--only",
        action="append",
        default=[],
        metavar="NAME",
        help='cases with this in their name, as "solve" or "NaN"; may be repeated (default: all)',
    )
    parser.add_argument(
        "--dtype",
        action="append",
        choices=_DTYPES,
        help="precision to run in; may be repeated (default: all that a stage is used in)",
    )
    parser.add_argument("--quick", action="store_true", help="without the cases of millions of points")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the verdicts as JSON too")


def run(args: argparse.Namespace) -> None:
    """Runs the cases and prints a line for each as it ends; one that fails is an error after the table."""
    import torch

    from capture.atomic import atomic_write
    from relight.errors import StressError
    from relight.stress.case import Case, Outcome, Verdict, judge
    from relight.stress.suite import chosen_cases
    from relight.stress.table import header, machine_facts, notes, row, summary, to_json, worst

    dtypes = [getattr(torch, name) for name in args.dtype or _DTYPES]
    found: dict[Case, list[Verdict]] = {}
    print(header())
    for case in chosen_cases(args.only, long=not args.quick):
        if verdicts := judge(case, dtypes):
            found[case] = verdicts
            print(row(verdicts), flush=True)
    print("", summary(found), "", *notes(list(found)), sep="\n")
    reasons = {v.note for verdicts in found.values() for v in verdicts if v.outcome == Outcome.NOT_RUN}
    for reason in sorted(reasons):
        print(f"not run: {reason}.")
    if args.json:
        content = json.dumps(to_json(found, machine_facts()), indent=1, allow_nan=False, ensure_ascii=False)
        atomic_write(args.json, (content + "\n").encode())
    failed = [case.name for case, verdicts in found.items() if worst(verdicts) == Outcome.FAILED]
    if failed:
        raise StressError(f'{len(failed)} of {len(found)} cases failed; the first is "{failed[0]}".')
