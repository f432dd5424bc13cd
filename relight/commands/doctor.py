"""`relight doctor`: what is plugged in, what works, and what to do about what does not."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

from capture.errors import RelightError

if TYPE_CHECKING:
    from capture.doctor.finding import Finding

EXAMPLE = "relight doctor --camera /dev/video0 --flash /dev/ttyUSB0"


class DoctorError(RelightError):
    """Something is wrong that keeps a capture from working."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The flags of `relight doctor`."""
    parser.add_argument("--camera", metavar="URL", help="rehearse a capture with this camera, and --flash")
    parser.add_argument("--flash", metavar="URL", help="and this flash, which blinks eight times")
    parser.add_argument("--on", type=float, default=0.1, metavar="S", help="length of a flash (default 0.1)")
    parser.add_argument("--exposure", type=float, metavar="S", help="exposure time of the rehearsal")
    parser.add_argument(
        "--out", type=Path, default=Path(), metavar="DIR", help="where captures will go (default: here)"
    )
    parser.add_argument("--udev", action="store_true", help="print the udev rules to add, and end")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the findings as JSON too")


def run(args: argparse.Namespace) -> None:
    """Looks at everything it may look at; something bad is an error after the table."""
    from capture.atomic import atomic_write
    from capture.doctor.permissions import udev_rules

    if args.udev:
        print(udev_rules(), end="")
        return
    _check(args)
    findings = _look(args)
    _print(findings)
    if args.json:
        content = json.dumps([finding.to_json() for finding in findings], indent=2, ensure_ascii=False) + "\n"
        try:
            atomic_write(args.json, content.encode())
        except OSError as cause:
            raise DoctorError(f"{args.json} cannot be written: {cause.strerror or cause}.") from cause
    bad = [finding for finding in findings if finding.level == "bad"]
    if bad:
        raise DoctorError(f"{len(bad)} of {len(findings)} findings are bad; the first: {bad[0].sentence}")


def _check(args: argparse.Namespace) -> None:
    """Whether the numbers can be, before anything is looked at."""
    from capture.controller.config import CaptureConfig
    from capture.devices.camera import CameraProfile

    try:
        CaptureConfig(on_s=args.on, profile=CameraProfile(exposure_s=args.exposure))
    except ValueError as wrong:
        raise DoctorError(f"{wrong}.") from wrong


def _look(args: argparse.Namespace) -> list[Finding]:
    from capture.doctor.devices import look_at_devices
    from capture.doctor.disk import look_at_disk
    from capture.doctor.finding import Finding, Level
    from capture.doctor.machine import look_at_machine
    from capture.doctor.permissions import look_at_permissions

    findings = [*look_at_machine(), *look_at_permissions(), *look_at_devices(), *look_at_disk(args.out)]
    if args.camera is None or args.flash is None:
        findings.append(
            Finding(
                "rehearsal",
                Level.SKIPPED,
                "Locks, latency and banding show only in a rehearsal.",
                "Point the camera at a thing half a metre away, keep it still; give --camera and --flash.",
            )
        )
        return findings
    from capture.devices.camera import CameraProfile
    from capture.doctor.rehearsal import rehearse

    return findings + rehearse(args.camera, args.flash, CameraProfile(exposure_s=args.exposure), args.on)


def _print(findings: list[Finding]) -> None:
    from rich.console import Console
    from rich.table import Table

    styles = {"good": "green", "note": "yellow", "bad": "bold red", "not looked at": "dim"}
    table = Table(box=None, pad_edge=False)
    for head in ("", "about", "found", "what to do"):
        table.add_column(head)
    for finding in findings:
        level = finding.level.value
        table.add_row(f"[{styles[level]}]{level}[/]", finding.topic, finding.sentence, finding.remedy)
    console = Console(soft_wrap=False)
    if not console.is_terminal:
        console.width = 160
    console.print(table, highlight=False)
