"""`relight calibrate response`: stored values to linear radiance, from an exposure sweep or by name."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from relight.commands.arguments import positive_integer, positive_number
from relight.commands.calibrate.flags import add_out

if TYPE_CHECKING:
    from collections.abc import Sequence

    from calib.response.check import OtherResponse
    from calib.response.fit import ResponseResult
    from calib.response.groups import SweepFrame


_STILL_S = 1e6  # the hand of a simulated camera takes so long around the head that it stands still


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The flags."""
    parser.add_argument(
        "source",
        nargs="*",
        type=Path,
        metavar="SWEEP",
        help="pictures of a still scene at four or more exposure times: a folder (times from Exif or "
        "exposures.csv), an exposures.csv, or a session",
    )
    parser.add_argument("--camera", metavar="URL", help="drive the sweep through this camera instead")
    parser.add_argument(
        "--name",
        metavar="CURVE",
        help="no sweep: srgb, rec709, gamma:G, log:A, or a profile of Open Camera (fine, low, medium, "
        "strong, extra_strong, jtvideo, jtlog, jtlog2)",
    )
    add_out(parser)
    live = parser.add_argument_group("with --camera")
    live.add_argument("--size", type=_size, metavar="WxH", help="of the pictures (default: the camera's)")
    live.add_argument("--gain", type=positive_number, metavar="N", help="as in the captures")
    live.add_argument("--white-balance", type=positive_number, metavar="K", help="kelvin, as in the captures")
    live.add_argument(
        "--shortest", type=positive_number, default=0.25e-3, metavar="S", help="seconds (default 0.00025)"
    )
    live.add_argument(
        "--longest", type=positive_number, default=32e-3, metavar="S", help="seconds (default 0.032)"
    )
    live.add_argument(
        "--steps", type=positive_integer, default=12, metavar="N", help="exposure times (default 12)"
    )
    live.add_argument(
        "--frames", type=positive_integer, default=2, metavar="N", help="pictures of each (default 2)"
    )
    live.add_argument("--keep", type=Path, metavar="DIR", help="keep the pictures there, with their times")


def run(args: argparse.Namespace) -> None:
    """Finds or names the response and saves it."""
    from calib.errors import ResponseError

    ways = [bool(args.source), args.camera is not None, args.name is not None]
    if sum(ways) != 1:
        raise ResponseError("Give a SWEEP, or --camera URL, or --name CURVE: one of the three.")
    if args.keep is not None and args.camera is None:
        raise ResponseError("--keep goes with --camera.")
    out = args.out / "calibration.json" if args.out.is_dir() else args.out
    if args.name is not None:
        _save_named(args.name, out)
        return
    if args.camera is not None:
        frames, source = _driven(args), f"exposure sweep of {args.camera}"
    else:
        frames = _read(args.source)
        source = f"exposure sweep {', '.join(path.name for path in args.source)}"
    _find(frames, source, out)


def _save_named(name: str, out: Path) -> None:
    from calib.calibration import Calibration, save_calibration
    from calib.errors import ResponseError
    from capture.errors import TransferError
    from capture.response import Response
    from capture.transfer import OPEN_CAMERA_PROFILES, canonical_transfer

    try:
        transfer = canonical_transfer(OPEN_CAMERA_PROFILES.get(name, name))
    except TransferError as cause:
        profiles = ", ".join(OPEN_CAMERA_PROFILES)
        raise ResponseError(f"{cause} Profiles of Open Camera: {profiles}.") from cause
    save_calibration(Calibration(response=Response(transfer, source=f"named by the user: {name}")), out)
    print(f"response    {transfer}, as named")
    print(f"saved       {out}")


def _read(sources: Sequence[Path]) -> list[SweepFrame]:
    from calib.errors import ResponseError
    from calib.response.groups import SweepFrame
    from calib.stills import EXPOSURE_LIST, read_stills

    frames = []
    for still in read_stills(sources):
        if still.exposure_s is None:
            raise ResponseError(
                f"{still.name} does not say its exposure time; put an {EXPOSURE_LIST} beside the pictures "
                "with lines as `a.png, 1/60`."
            )
        frames.append(SweepFrame(still.name, still.exposure_s, still.image))
    return frames


def _driven(args: argparse.Namespace) -> list[SweepFrame]:
    from capture.devices.camera import CameraProfile
    from capture.devices.table import open_bench, open_camera
    from capture.terminal import StageProgress
    from relight.commands.calibrate.sweep import SweepPlan, drive_sweep, keep_sweep

    width, height = args.size or (None, None)
    profile = CameraProfile(
        width=width, height=height, gain=args.gain, white_balance_k=args.white_balance, mains_hz=0
    )
    plan = SweepPlan(args.shortest, args.longest, args.steps, args.frames)
    bench = open_bench(args.camera, "sim:", _STILL_S)
    with open_camera(args.camera, bench) as camera, StageProgress() as progress:
        frames = list(drive_sweep(camera, profile, plan, progress))
    if args.keep is not None:
        keep_sweep(frames, args.keep)
        print(f"kept        {len(frames)} pictures in {args.keep}")
    return frames


def _find(frames: list[SweepFrame], source: str, out: Path) -> None:
    from calib.calibration import load_calibration
    from calib.response.check import compare_opencv, nearest_curve
    from calib.response.fit import fit_response
    from calib.response.groups import gather_groups
    from calib.response.save import response_evidence_path, save_response

    result = fit_response(gather_groups(frames), load_calibration(out).value("dark"))
    others = (nearest_curve(result), *compare_opencv(frames, result))
    print(_describe(result, others))
    save_response(result, out, source, others)
    print(f"saved       {out}, and what it was made from in {response_evidence_path(out).name}")


def _describe(result: ResponseResult, others: Sequence[OtherResponse]) -> str:
    """What was found, in a few lines for a person."""
    used = [frame for frame in result.frames if frame.used]
    times = [frame.claimed_s for frame in used]
    curves = "one curve for all channels" if result.linear.ndim == 1 else "a curve for each channel"
    lines = [
        f"sweep       {len(used)} of {len(result.frames)} pictures used, {min(times):.4g} to "
        f"{max(times):.4g} s",
        f"response    {curves}, measured from {result.covered[0]:.3f} to {result.covered[1]:.3f} of white, "
        f"± {result.sigma.max():.4f} of white at most",
        f"linearity   stored values are off a straight line by up to {result.bend:.1%} of white; after the "
        f"response exposures agree to {result.linearity:.2%}",
        f"scatter     {result.residual:.2%} of a part of the picture ({result.expected:.2%} expected), "
        f"{result.jitter:.2%} of the exposures",
        *(
            f"beside      {other.name}: {other.median:.1%} apart (median), {other.largest:.1%} at most"
            for other in others
        ),
        *(f"note        {sentence}" for sentence in result.warnings),
    ]
    return "\n".join(lines)


def _size(text: str) -> tuple[int, int]:
    """640x480, for argparse."""
    width, _, height = text.lower().partition("x")
    return int(width), int(height)
