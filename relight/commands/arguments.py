"""Flags that several commands share, and the checks that make a bad value a usage error."""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from relight.errors import PlanError, PortraitError

if TYPE_CHECKING:
    from relight.geometry_plan import GeometryConfig


def add_session(parser: argparse.ArgumentParser) -> None:
    """The session folder."""
    parser.add_argument("session", type=Path, metavar="SESSION", help="session folder")


def add_portrait(parser: argparse.ArgumentParser) -> None:
    """Which of a session's portraits; see `chosen_portrait`."""
    parser.add_argument("--portrait", metavar="NAME", help="which portrait (default: the last one made)")


def add_device(parser: argparse.ArgumentParser) -> None:
    """Where tensors live."""
    parser.add_argument(
        "--device", choices=("cpu", "cuda"), help="where to compute (default: cuda where there is one)"
    )


def add_forced(parser: argparse.ArgumentParser) -> None:
    """Decisions of the plan to turn round."""
    parser.add_argument(
        "--force",
        action="append",
        default=[],
        metavar="NAME=run|skip",
        help="turn a decision of the plan round: undistortion, redundant_views, room_shading, masks or "
        "face_prior",
    )


def add_geometry(parser: argparse.ArgumentParser) -> None:
    """What helps to find poses, cloud and masks where the session does not bring them."""
    group = parser.add_argument_group("for poses, cloud and masks that are not given")
    group.add_argument(
        "--marker-side",
        type=positive_number,
        metavar="METRES",
        help="side of the printed ArUco markers about the head: gives the scene its unit of length",
    )
    group.add_argument(
        "--u2net",
        type=Path,
        metavar="FILE",
        help="weights of U2-Net as published (u2net.pth), to help with the masks; without, none are needed",
    )
    group.add_argument(
        "--face-landmarks",
        type=Path,
        metavar="FILE",
        help="MediaPipe's face landmarker task file, to find the face with (needs the package mediapipe)",
    )
    group.add_argument(
        "--position-maps",
        type=Path,
        metavar="DIR",
        help="position maps of the face as PRNet gives them, NNNNNN.npy by frame",
    )


def chosen_geometry(args: argparse.Namespace) -> GeometryConfig:
    """The settings that the flags of `add_geometry` ask for.

    Raises:
        PlanError: A file that a flag names is not there: said now, and not after minutes of work.
    """
    from relight.face import FaceConfig
    from relight.geometry_plan import GeometryConfig
    from relight.masks import MaskConfig
    from relight.sfm import SfmConfig

    for flag in ("u2net", "face_landmarks", "position_maps"):
        path = getattr(args, flag)
        if path is not None and not path.exists():
            raise PlanError(
                f"{path} does not exist; name what --{flag.replace('_', '-')} shall use, or leave it out."
            )
    sfm = SfmConfig() if args.marker_side is None else SfmConfig(marker_side_m=args.marker_side)
    masks = MaskConfig() if args.u2net is None else MaskConfig(u2net=str(args.u2net))
    face = FaceConfig(model=str(args.face_landmarks or ""), maps=str(args.position_maps or ""))
    return GeometryConfig(sfm=sfm, masks=masks, face=face)


def add_refinement(parser: argparse.ArgumentParser) -> None:
    """What can be set of a preset that refines the solve; see `chosen_settings`."""
    group = parser.add_argument_group("for presets that refine the solve")
    group.add_argument("--steps", type=positive_integer, metavar="N", help="of the optimiser")
    group.add_argument(
        "--vgg",
        type=Path,
        metavar="FILE",
        help="weights of VGG-16 (torchvision's state dict, or safetensors) to compare pictures with; "
        "without, a measure is taken that needs none",
    )
    group.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="any setting of the preset, such as crop=256 or precision=bfloat16",
    )
    group.add_argument(
        "--seed", type=int, default=0, metavar="N", help="of what is drawn by chance (default: 0)"
    )


def chosen_settings(args: argparse.Namespace) -> dict[str, Any]:
    """The settings that the flags of `add_refinement` ask for; the preset says which it has.

    Raises:
        PlanError: A flag is not of its form, or names a file that is not there.
    """
    settings: dict[str, Any] = {}
    for text in args.set:
        name, equals, value = text.partition("=")
        if not (name and equals):
            raise PlanError(f"--set {text} must be NAME=VALUE.")
        try:
            settings[name] = json.loads(value)
        except ValueError:
            settings[name] = value
    if args.steps is not None:
        settings["steps"] = args.steps
    if args.vgg is not None:
        if not args.vgg.is_file():
            raise PlanError(f"{args.vgg} does not exist; name what --vgg shall use, or leave it out.")
        settings["vgg"] = str(args.vgg)
    return settings


def add_max_seconds(parser: argparse.ArgumentParser) -> None:
    """A limit on the time of a fit."""
    parser.add_argument(
        "--max-seconds",
        type=positive_number,
        metavar="S",
        help="the fit should end within this time: unlit frames are left out until the solve does, and a "
        "refinement gives the best it has by then",
    )


def positive_number(text: str) -> float:
    """A finite number above zero, for argparse."""
    number = float(text)
    if not 0 < number < math.inf:
        raise argparse.ArgumentTypeError(f"{text} must be above zero")
    return number


def positive_integer(text: str) -> int:
    """A whole number above zero, for argparse."""
    number = int(text)
    if number <= 0:
        raise argparse.ArgumentTypeError(f"{text} must be above zero")
    return number


def chosen_portrait(portraits: Path, name: str | None) -> str:
    """The name of the portrait to use: the one asked for, or the last one made.

    Raises:
        PortraitError: There is none.
    """
    made = {path.parent.name: path.stat().st_mtime for path in portraits.glob("*/portrait.json")}
    session = portraits.parent
    if not made:
        raise PortraitError(f"{session} has no portrait yet; make one with `relight fit {session}`.")
    if name is None:
        return max(made, key=lambda known: made[known])
    if name not in made:
        raise PortraitError(f"{session} has no portrait {name!r}; it has {', '.join(sorted(made))}.")
    return name
