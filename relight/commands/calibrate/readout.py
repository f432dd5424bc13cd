"""`relight calibrate readout`: the time from a rolling shutter's first row to its last, by a flash."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from calib.sensor.readout import ReadoutResult
    from capture.controls import Controls


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The flags."""
    parser.add_argument(
        "source",
        type=Path,
        metavar="SOURCE",
        help="a film of half a minute, still, with the flash blinking; or a session that was captured or "
        "imported from one",
    )
    parser.add_argument(
        "--exposure-ms",
        type=float,
        metavar="MS",
        help="exposure time of the film, where it is known; the readout is then known better",
    )
    parser.add_argument(
        "--transfer", metavar="CURVE", help="curve of the film's pictures (default: what the film says)"
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("calibration.json"),
        metavar="FILE",
        help="calibration.json to write into, or the session whose it is (default calibration.json)",
    )


def run(args: argparse.Namespace) -> None:
    """Measures the readout and saves it."""
    from calib.calibration import Calibration, Quantity, load_calibration, save_calibration
    from calib.errors import ReadoutError

    out = args.out / "calibration.json" if args.out.is_dir() else args.out
    load_calibration(out)  # a file that cannot be added to is told before the work
    if args.exposure_ms is not None and not 0 < args.exposure_ms < 1000:
        raise ReadoutError(f"--exposure-ms is {args.exposure_ms:g}; it must be above 0 and below 1000.")
    if (args.source / "session.json").is_file():
        result, controls = _of_session(args.source)
    else:
        result, controls = _of_film(args)
    about = f"{result.flashes} flashes of {args.source.name}"
    made_with = controls.mattering("readout_s")
    entry = Quantity.of(result.readout_s, "s", about, result.sigma_s, made_with)
    save_calibration(Calibration(readout_s=entry), out)
    print(_describe(result, made_with))
    print(f"saved       {out}")


def _of_film(args: argparse.Namespace) -> tuple[ReadoutResult, Controls]:
    """Measured from every frame of a film."""
    from calib.sensor.readout import judge_readout
    from capture.controls import Controls
    from capture.importers.recording_parts import open_recording
    from capture.importers.video_survey import survey_recording
    from capture.tagging import TaggingConfig
    from capture.tagging.readout import measure_readout
    from capture.terminal import StageProgress
    from capture.transfer import canonical_transfer

    recording = open_recording([args.source])
    video = recording.parts[0].video
    transfer = canonical_transfer(args.transfer) if args.transfer else video.colour.transfer
    with StageProgress() as progress:
        survey = survey_recording(recording, transfer, progress)
    exposure_s = None if args.exposure_ms is None else 1e-3 * args.exposure_ms
    found = measure_readout(survey.profiles, TaggingConfig(exposure_s=exposure_s))
    result = judge_readout(
        found.readout_s, found.fit_sigma_s, found.exposure_s, found.interval_s, found.on_s, found.without_s
    )
    rate_hz = 1.0 / found.interval_s
    return result, Controls(width=video.width, height=video.height, rate_hz=rate_hz)


def _of_session(path: Path) -> tuple[ReadoutResult, Controls]:
    """As the tagging of a capture or an import found it; not every frame is in the session to look again."""
    from calib.errors import ReadoutError
    from calib.sensor.readout import judge_readout
    from capture.session import Session

    session = Session.open(path)
    light = session.info.get("tagging") or (session.info.get("capture") or {}).get("light") or {}
    controls = session.controls
    if not light.get("readout_s") or not light.get("readout_sigma_s") or controls.rate_hz is None:
        raise ReadoutError(
            f"{path} has no readout that was measured in it: no flash was seen to blink, or the readout was "
            "given or taken from the room's flicker; give the film itself."
        )
    pulses = light["pulses"]
    if isinstance(pulses, int):  # a capture records their number and period
        on_s = [number * (light["period_s"] or 0.0) for number in range(pulses)]
    else:
        on_s = [pulse["t_on_s"] for pulse in pulses]
    result = judge_readout(
        light["readout_s"], light["readout_sigma_s"], light["exposure_s"], 1.0 / controls.rate_hz, on_s, ()
    )
    return result, controls


def _describe(result: ReadoutResult, made_with: Controls) -> str:
    first = "top" if result.readout_s > 0 else "bottom"
    return (
        f"readout     {1e3 * abs(result.readout_s):.2f} ± {1e3 * result.sigma_s:.2f} ms, the {first} row "
        f"first, from {result.flashes} flashes; holds for {made_with.width} x {made_with.height} at "
        f"{made_with.rate_hz:.4g} frames a second"
    )
