"""`relight-capture`: records a session from a camera and a flash (exit codes: `capture.terminal`)."""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from capture.errors import CameraError, DeviceError, RelightError
from capture.terminal import run_guarded

if TYPE_CHECKING:
    from capture.controller.config import CaptureConfig
    from capture.controller.run import CaptureOutcome
    from capture.devices.camera import CameraProfile

_EXAMPLE = """examples:
  relight-capture --flash /dev/ttyUSB0 --out S
  relight-capture --flash litra: --camera /dev/video2 --exposure 0.005 --mains 50 --preview --out S
  relight-capture --flash sim: --out S           a simulated camera and flash
  relight-capture --list                         what is plugged in

cameras: /dev/video0, v4l2:PATH, uvc:VID:PID, opencv:N, replay:FILE_OR_FOLDER, sim:, fake-v4l2:
flashes: /dev/ttyUSB0, hwgrep://..., socket://..., hid-firmware:, litra:, hidrelay:, blink1:, manual:, sim:

The flash blinks once a second, at most three times. Do not show it to people who are photosensitive, and ask
before you film: docs/safety.md."""


class CaptureStoppedError(RelightError):
    """A capture ended before its time; all that was taken is kept."""


def main(argv: Sequence[str] | None = None) -> int:
    """Records; the exit code is for `sys.exit`.

    Args:
        argv: Arguments without the program; those of the process when None.
    """
    try:
        args = _parser().parse_args(argv)
        work = _list if args.list else _prepared(args)
    except SystemExit as usage:
        return int(usage.code or 0)
    logging.basicConfig(level=logging.WARNING, format="relight-capture: %(message)s")
    return run_guarded("relight-capture", work, debug=args.debug)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="relight-capture",
        description="Locks a camera, makes a flash blink once a second, and records every frame.",
        epilog=_EXAMPLE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--flash", metavar="URL", help="the flash (see below)")
    parser.add_argument(
        "--camera", metavar="URL", help="the camera; the first that is plugged in when left out"
    )
    parser.add_argument(
        "--duration", type=float, default=20.0, metavar="S", help="length of the recording (default 20)"
    )
    parser.add_argument(
        "--out", type=Path, metavar="SESSION", help="folder to make (default capture_DATE_TIME)"
    )
    parser.add_argument("--resume", action="store_true", help="go on with an interrupted capture in --out")
    parser.add_argument(
        "--list", action="store_true", help="say which cameras and flashes are there, and end"
    )
    parser.add_argument(
        "--preview",
        nargs="?",
        const=0,
        type=int,
        metavar="PORT",
        help="show the capture in a browser on this machine",
    )
    parser.add_argument("--quiet", action="store_true", help="no panel in the terminal, only what matters")
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
    flash = parser.add_argument_group("flash")
    flash.add_argument(
        "--period", type=float, default=1.0, metavar="S", help="from flash to flash (default 1)"
    )
    flash.add_argument(
        "--phase-step",
        type=float,
        default=0.382,
        metavar="SHARE",
        help="of a frame period, by which each flash comes later: so flashes meet all rows (default 0.382)",
    )
    flash.add_argument("--on", type=float, default=0.1, metavar="S", help="length of a flash (default 0.1)")
    flash.add_argument(
        "--level", type=float, default=1.0, metavar="0..1", help="of a lamp that dims (default 1)"
    )
    camera = parser.add_argument_group(
        "camera", "what is left out stays as the camera's automatic found it before it was turned off"
    )
    camera.add_argument("--size", type=_size, metavar="WxH", help="picture size")
    camera.add_argument("--fps", type=float, metavar="HZ", help="frame rate")
    camera.add_argument("--format", metavar="FOURCC", help="MJPG, YUYV, NV12, ...")
    camera.add_argument("--exposure", type=float, metavar="S", help="exposure time")
    camera.add_argument("--gain", type=float, metavar="G", help="in the camera's own units")
    camera.add_argument("--white-balance", type=float, metavar="K", help="colour temperature")
    camera.add_argument("--focus", type=float, metavar="F", help="in the camera's own units")
    camera.add_argument(
        "--mains", type=int, choices=(0, 50, 60), help="frequency of the mains where you are; 0 = daylight"
    )
    camera.add_argument(
        "--calibration",
        type=Path,
        metavar="FILE",
        help="calibration.json of camera and flash; told at once where the camera is set otherwise",
    )
    camera.add_argument("--restore", action="store_true", help="put the camera's controls back afterwards")
    kept = parser.add_argument_group("pictures that are kept: every lit one, and the sharpest unlit ones")
    kept.add_argument("--unlit-rate", type=float, default=6.0, metavar="HZ", help="unlit ones (default 6)")
    kept.add_argument("--keep-all", action="store_true", help="all of them")
    return parser


def _prepared(args: argparse.Namespace) -> Callable[[], None]:
    """The work, with the settings checked."""
    parser = _parser()
    if args.flash is None:
        parser.error(
            "name the flash: --flash /dev/ttyUSB0, litra:, manual:, sim: ... (--list shows what is there)"
        )
    if args.resume and args.out is None:
        parser.error("--resume needs --out, the session to go on with")
    try:
        config = _config(args)
    except ValueError as wrong:
        parser.error(str(wrong))
    return lambda: _capture(args, config)


def _config(args: argparse.Namespace) -> CaptureConfig:
    from capture.controller.config import CaptureConfig

    return CaptureConfig(
        duration_s=args.duration,
        period_s=args.period,
        phase_step=args.phase_step,
        on_s=args.on,
        level=args.level,
        profile=_profile(args),
        kept_rate_hz=args.unlit_rate,
        keep_all=args.keep_all,
        restore=args.restore,
        calibration=args.calibration,
    )


def _profile(args: argparse.Namespace) -> CameraProfile:
    from capture.devices.camera import CameraProfile

    width, height = args.size or (None, None)
    return CameraProfile(
        width=width,
        height=height,
        fps=args.fps,
        pixel_format=args.format,
        exposure_s=args.exposure,
        gain=args.gain,
        white_balance_k=args.white_balance,
        focus=args.focus,
        mains_hz=args.mains,
    )


def _capture(args: argparse.Namespace, config: CaptureConfig) -> None:
    from capture.controller.run import run_capture
    from capture.devices.table import open_bench, open_camera, open_flash

    camera_url = _first_camera(args.flash) if args.camera is None else args.camera
    out = args.out or Path(f"capture_{datetime.now():%Y%m%d_%H%M%S}")
    bench = open_bench(camera_url, args.flash, config.duration_s)
    with ExitStack() as stack:
        flash = stack.enter_context(open_flash(args.flash, bench))
        camera = stack.enter_context(open_camera(camera_url, bench))
        watch = None
        if args.preview is not None or not args.quiet:
            from capture.controller.showing import open_watch

            shown = open_watch(config.duration_s, config.period_s, preview=args.preview, panel=not args.quiet)
            watch = stack.enter_context(shown)
        outcome = run_capture(camera, flash, bench, out, config, watch=watch, resume=args.resume)
    if watch is None:
        for sentence in outcome.warnings:
            print(f"relight-capture: {sentence}", file=sys.stderr)
    _conclude(outcome)


def _conclude(outcome: CaptureOutcome) -> None:
    session = outcome.session
    usable = [frame for frame in session.frames if frame.usable]
    lit = sum(frame.flash == 1 for frame in usable)
    print(f"{session.path}: {len(session.frames)} frames, {lit} lit and {len(usable) - lit} unlit ones kept")
    report = session.info["capture"]
    if (light := report["light"]) is not None and light["pulses"]:
        print(", ".join(_told(report, light)))
    if outcome.stopped is not None:
        raise CaptureStoppedError(outcome.stopped)
    if outcome.signal is not None:
        raise KeyboardInterrupt


def _told(report: dict[str, Any], light: dict[str, Any]) -> list[str]:
    """What was measured of frames and flash, for a line."""
    told = [f"{report['lost']} frames lost", f"{light['pulses']} flashes seen"]
    if light["latency_s"] is not None:
        told.append(f"{1e3 * light['latency_s']:+.1f} ms after they were reported")
        told.append(f"varying by {1e3 * (light['latency_jitter_s'] or 0.0):.1f} ms")
    if light["droop_share"] is not None:
        told.append(f"dimmer by {light['droop_share']:.1%} at the end")
    told.append(f"{light['contradictions']} frames contradict the flash")
    return told


def _first_camera(flash_url: str) -> str:
    """The camera to take when none is named: the simulated flash's own, or the first that is plugged in."""
    from capture.devices.table import flash_scheme, list_cameras

    if flash_scheme(flash_url)[0] == "sim":
        return "sim:"
    found = list_cameras()
    if not found:
        raise CameraError("No camera is plugged in; plug one in, or name one with --camera.")
    return found[0]


def _list() -> None:
    from capture.devices.table import list_cameras, list_flashes

    for kind, list_devices in (("camera", list_cameras), ("flash", list_flashes)):
        try:
            found = list_devices()
        except DeviceError as error:
            print(f"{kind}: {error}")
            continue
        for url in found or ("none found",):
            print(f"{kind}: {url}")


def _size(text: str) -> tuple[int, int]:
    width, x, height = text.lower().partition("x")
    if not (x and width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise argparse.ArgumentTypeError(f"{text} is not a size such as 1280x720")
    return int(width), int(height)


if __name__ == "__main__":
    sys.exit(main())
