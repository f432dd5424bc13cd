"""Tests with real kernel drivers: cameras and flashes that a kernel in a small virtual machine believes in.

    python tests/vm/run.py [--folder build/vm] [--limit-s 600] [PART ...]

Each file `guest/check_PART.py` is run by pytest in the machine, in a process of its own, with the Python
that runs this. Exit code 0: all passed, or the machine cannot be had here, which the last line then says
(SKIPPED); 1: something failed. `FOLDER/results.json` has every test, `FOLDER/console.log` the kernel's last
words.
"""

import argparse
import json
import os
import sys
import time
from pathlib import Path

from chip import Chip
from events import Events
from machine import Machine
from packages import UnavailableError, fetch

GUEST = Path(__file__).parent / "guest"
ROOT = Path(__file__).parents[2]
#: A test that takes longer is stopped, with where it was; the slowest takes about a tenth of it.
TEST_LIMIT_S = 60


def main():
    arguments = _parser().parse_args()
    os.chdir(ROOT)
    folder = arguments.folder.resolve()
    parts = arguments.parts or _all_parts()
    if unknown := sorted(set(parts) - set(_all_parts())):
        sys.exit(f"no part {', '.join(unknown)}; there are {', '.join(_all_parts())}")
    start_s = time.monotonic()
    try:
        machine = Machine(fetch(folder), folder)
    except UnavailableError as error:
        print(f"SKIPPED: no tests with real kernel drivers: {error}.")
        return 0
    print(f"machine made in {time.monotonic() - start_s:.0f} s", flush=True)
    events = Events(machine.share)
    with Chip(folder, machine.share) as chip:
        while parts and (left_s := arguments.limit_s - (time.monotonic() - start_s)) > 0:
            outcome = machine.run(
                ["sh", GUEST / "run_parts.sh", *parts],
                _environment(machine.parts, chip),
                left_s,
                terminal=chip.terminal,
                watch=lambda: events.show(print),
            )
            print(f"machine ran {outcome.seconds:.0f} s", flush=True)
            parts = events.close_run(parts, outcome)
    events.lost(parts, f"no time was left of {arguments.limit_s:.0f} s")
    (folder / "results.json").write_text(json.dumps(events.results, indent=1))
    return events.summary(print, time.monotonic() - start_s)


def _parser():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "parts", nargs="*", metavar="PART", help=f"of {', '.join(_all_parts())}; without, all"
    )
    parser.add_argument("--folder", type=Path, default=Path("build/vm"), help="for packages, logs, results")
    parser.add_argument("--limit-s", type=float, default=600.0, help="longest time for all (default 600)")
    return parser


def _all_parts():
    return [path.stem.removeprefix("check_") for path in sorted(GUEST.glob("check_*.py"))]


def _environment(parts, chip):
    return {
        "PATH": "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin",
        "HOME": "/root",
        "LANG": "C.UTF-8",
        "PYTHON": sys.executable,
        "PYTHONDONTWRITEBYTECODE": "1",
        "PYTHONPATH": os.pathsep.join([str(GUEST), parts.python]),
        "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1",
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
        "TEST_LIMIT_S": str(TEST_LIMIT_S),
        "WHY_NO_CHIP": chip.why_not,
        "DOUBLE": str(chip.double or ""),
    }


if __name__ == "__main__":
    sys.exit(main())
