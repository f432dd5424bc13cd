"""`relight`: finds the command, runs it, and turns what went wrong into one sentence and an exit code.

    0    the work is done
    1    it is not, and the sentence on stderr says why and what to do next
    2    the command line was not understood
    70   an error that nobody foresaw; `--debug` shows where
    130  stopped by Ctrl-C
"""

from __future__ import annotations

import argparse
import importlib
import logging
import os
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from types import ModuleType

from capture.errors import RelightError

_COMMANDS = {
    "demo": ("relight.commands.demo", "simulated rig to relit pictures and a report, no hardware, no download"),
    "import": ("relight.commands.import_", "make a session from a video, posed images, COLMAP or nerfstudio"),
    "plan": ("relight.commands.plan", "what a fit of this session will run, what it skips, and why"),
    "fit": ("relight.commands.fit", "make a portrait of a session"),
    "render": ("relight.commands.render", "relit pictures, maps or an orbit video of a portrait"),
    "evaluate": ("relight.commands.evaluate", "measure a portrait against the truth"),
    "report": ("relight.commands.report", "write report.html of a portrait again"),
}

_EPILOG = "relight COMMAND --help shows the flags of a command and an example."


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command; the exit code is for `sys.exit`."""
    return run_command_line("relight", "From a blinking flash to a relightable head.", _COMMANDS, argv)


def run_command_line(
    program: str, about: str, commands: Mapping[str, tuple[str, str]], argv: Sequence[str] | None
) -> int:
    """Parses `argv` for a program of lazily imported commands and runs the one it names.

    Args:
        program: Name of the program in help and messages.
        about: First line of its help.
        commands: Per command its module (see `relight.commands`) and a summary.
        argv: Arguments without the program; those of the process when None.

    Returns:
        The exit code, as in this module's docstring.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        args = _parser(program, about, commands, arguments).parse_args(arguments)
    except SystemExit as usage:
        return int(usage.code or 0)
    logging.basicConfig(level=logging.WARNING, format=f"{program}: %(message)s")
    return run_guarded(program, lambda: args.run(args), debug=args.debug)


def run_guarded(program: str, work: Callable[[], None], *, debug: bool) -> int:
    """Does `work`; whatever it raises becomes one sentence on stderr and an exit code."""
    try:
        work()
        sys.stdout.flush()
    except RelightError as error:
        _complain(program, str(error), debug)
        return 1
    except KeyboardInterrupt:
        _complain(program, "stopped; what was written so far is whole.", debug)
        return 130
    except BrokenPipeError:
        # The reader of our output went away (`relight plan S | head`): nothing more to say, and nowhere to say it.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        _complain(program, f"{place}{error.strerror or error}.", debug)
        return 1
    except Exception as error:
        hint = "" if debug else " Run it again with --debug to see where, and report that."
        _complain(program, f"unforeseen {type(error).__name__}: {error}.{hint}", debug)
        return 70
    return 0


def _complain(program: str, sentence: str, debug: bool) -> None:
    if debug:
        traceback.print_exc()
    print(f"{program}: {sentence}", file=sys.stderr)


def _parser(
    program: str, about: str, commands: Mapping[str, tuple[str, str]], arguments: Sequence[str]
) -> argparse.ArgumentParser:
    """Knows all commands by name, but imports only the module of the one that the arguments name."""
    parser = argparse.ArgumentParser(prog=program, description=about, epilog=_EPILOG)
    parser.add_argument("--version", action=_Version)
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
    subparsers = parser.add_subparsers(metavar="COMMAND", required=True)
    for name, (module_name, summary) in commands.items():
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
        from importlib.metadata import version

        print(version("relightable-portrait-rig"))
        parser.exit()


if __name__ == "__main__":
    sys.exit(main())
