"""`relight report`: the report of a portrait, written again from what lies in its folder."""

from __future__ import annotations

import argparse

from relight.commands.arguments import add_portrait, add_session, chosen_portrait

EXAMPLE = "relight report S --portrait solve"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The flags of `relight report`."""
    add_session(parser)
    add_portrait(parser)


def run(args: argparse.Namespace) -> None:
    """Writes report.html and prints its path."""
    from capture.session import Session
    from relight.report import write_report

    portraits = Session.open(args.session).portraits_dir
    print(write_report(args.session, chosen_portrait(portraits, args.portrait)))
