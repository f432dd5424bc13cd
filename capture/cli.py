"""`relight-capture`: records a session from a camera and a flash (exit codes: `capture.terminal`)."""

from __future__ import annotations

import argparse
import logging
import math
import sys
from collections.abc import Sequence
from pathlib import Path

from capture.terminal import StageProgress, run_guarded

_EXAMPLE = """example:
  relight-capture --camera sim: --flash sim: --duration 16 --out S
  relight fit S"""


def main(argv: Sequence[str] | None = None) -> int:
    """Records; the exit code is for `sys.exit`.

    Args:
        argv: Arguments without the program; those of the process when None.
    """
    try:
        args = _parser().parse_args(argv)
    except SystemExit as usage:
        return int(usage.code or 0)
    logging.basicConfig(level=logging.WARNING, format="relight-capture: %(message)s")
    return run_guarded("relight-capture", lambda: _capture(args), debug=args.debug)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="relight-capture",
        description="Records a session while the flash blinks once a second. Today there is the "
        "simulated rig, sim:; real cameras and flashes are to come.",
        epilog=_EXAMPLE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--camera", default="sim:", metavar="URL", help="camera: sim:, sim:seed=3 (default sim:)"
    )
    parser.add_argument("--flash", default="sim:", metavar="URL", help="flash: sim: (default)")
    parser.add_argument(
        "--duration", type=_seconds, default=16.0, metavar="S", help="length of the recording (default 16)"
    )
    parser.add_argument("--out", required=True, type=Path, metavar="SESSION", help="session folder to make")
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
    return parser


def _capture(args: argparse.Namespace) -> None:
    from capture.recorder import record
    from capture.rig_devices import open_rig

    with StageProgress() as progress:
        progress("open the rig", 0.0)
        rig = open_rig(args.camera, args.flash, args.duration)
        progress("open the rig", 1.0)
        source = {"camera": args.camera, "flash": args.flash}
        session = record(rig, args.out, source, progress)
    usable = [frame for frame in session.frames if frame.usable]
    lit = sum(frame.flash == 1 for frame in usable)
    print(f"{session.path}: {len(session.frames)} frames, {lit} lit and {len(usable) - lit} unlit ones kept")


def _seconds(text: str) -> float:
    number = float(text)
    if not 1.0 <= number < math.inf:
        raise argparse.ArgumentTypeError(f"{text} s is shorter than one period of the flash, 1 s")
    return number


if __name__ == "__main__":
    sys.exit(main())
