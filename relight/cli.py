"""`relight`: finds the command and runs it (exit codes: `capture.terminal`)."""

from __future__ import annotations

import argparse
import importlib
import logging
import os
import sys
from collections.abc import Sequence
from types import ModuleType

from capture.terminal import run_guarded

_COMMANDS = {
    "demo": (
        "relight.commands.demo",
        "simulated rig to relit pictures and a report, without hardware",
    ),
    "import": ("relight.commands.import_", "make a session from a video, posed images, COLMAP or nerfstudio"),
    "plan": ("relight.commands.plan", "what a fit of this session will run, what it skips, and why"),
    "fit": ("relight.commands.fit", "make a portrait of a session"),
    "render": ("relight.commands.render", "relit pictures, maps or an orbit video of a portrait"),
    "evaluate": ("relight.commands.evaluate", "measure a portrait against the truth"),
    "report": ("relight.commands.report", "write report.html of a portrait again"),
    "calibrate": (
        "relight.commands.calibrate",
        "what a camera and its lamp really do, part by part, and a page to judge it by",
    ),
    "doctor": (
        "relight.commands.doctor",
        "what is plugged in, what works, and what to do about what does not",
    ),
    "stress": ("relight.commands.stress", "every stage under hostile inputs: numerical stability as a table"),
}

_ABOUT = "From a blinking flash to a relightable head."
_EPILOG = "relight COMMAND --help shows the flags of a command and an example."


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command; the exit code is for `sys.exit`.

    Args:
        argv: Arguments without the program; those of the process when None.
    """
    # Threads of torch that wait by spinning slow a machine that does other things down many times. Read once,
    # when torch is imported: before any command is.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        args = _parser(arguments).parse_args(arguments)
    except SystemExit as usage:
        return int(usage.code or 0)
    logging.basicConfig(level=logging.WARNING, format="relight: %(message)s")
    return run_guarded("relight", lambda: args.run(args), debug=args.debug)


def _parser(arguments: Sequence[str]) -> argparse.ArgumentParser:
    """Knows all commands by name, but imports only the module of the one that the arguments name."""
    parser = argparse.ArgumentParser(prog="relight", description=_ABOUT, epilog=_EPILOG)
    parser.add_argument("-V", "--version", action=_Version)
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
    subparsers = parser.add_subparsers(metavar="COMMAND", required=True)
    for name, (module_name, summary) in _COMMANDS.items():
        command = subparsers.add_parser(
            name,
            help=summary,
            description=summary[0].upper() + summary[1:] + ".",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        if name in arguments:
            _add_command(command, importlib.import_module(module_name))
    return parser


def _add_command(parser: argparse.ArgumentParser, module: ModuleType) -> None:
    module.add_arguments(parser)
    parser.epilog = f"example:\n  {module.EXAMPLE}"
    parser.add_argument(
        "--debug", action="store_true", default=argparse.SUPPRESS, help="show the traceback of an error"
    )
    parser.set_defaults(run=module.run)


class _Version(argparse.Action):
    """Prints the installed version; it is looked up only when asked for."""

    def __init__(self, option_strings: Sequence[str], dest: str, **_: object) -> None:
        super().__init__(option_strings, argparse.SUPPRESS, nargs=0, help="show the version and exit")

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from relight.version import installed_version

        print(installed_version())
        parser.exit()


if __name__ == "__main__":
    sys.exit(main())
