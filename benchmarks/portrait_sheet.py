"""A sheet of pictures of a portrait beside the truth, and of a view from where no frame was taken.

    python -m benchmarks.portrait_sheet S/portraits/balanced --out docs/images/fast.jpg

On portrait_A (skipped with a word where it is not there). In each pair the portrait is left and the truth
right: the captured frame, a directional light, a panorama, a point light, normals and albedo. Radiance under
new lights and albedo have one scale a channel, as in the measures. Below, a view lower than any frame.
"""

from __future__ import annotations

import argparse
import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.record import ROOT
from capture.cameras import Camera
from capture.transfer import to_display
from relight.lighting import CapturedLight, RoomLight
from relight.metrics import channel_scales
from relight.portrait import load_portrait
from relight.render import PortraitRenderer
from relight.truth import TruthView, load_truth

LIGHTS = ("dir1", "env2", "point")
LOWER_DEG, ASIDE_DEG = 15.0, 25.0
_BRIGHT = 99.5  # percentile of the truth that is white under a new light
_SMALL, _LARGE = 0.28, 0.56  # of a view's sides

Image = NDArray[np.floating]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    default = os.environ.get("RELIGHT_PORTRAIT_A", ROOT.parent / "shared" / "portrait_A")
    parser.add_argument("portrait", type=Path)
    parser.add_argument("--portrait-a", type=Path, default=Path(default))
    parser.add_argument("--views", nargs="+", default=["0010", "0050", "0090"])
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    if not (args.portrait_a / "cameras.json").is_file():
        print(f"skipped: there is no portrait_A in {args.portrait_a}")
        return
    truth = load_truth(args.portrait_a)
    portrait = load_portrait(args.portrait)
    renderer = PortraitRenderer(portrait)
    lights = {name: truth.lights[name] for name in LIGHTS}
    views = [view for view in truth.views if view.camera.name in args.views]
    rows = [np.hstack([_sized(image, _SMALL) for image in pairs(renderer, view, lights)]) for view in views]
    centre = portrait.points.median(dim=0).values.numpy()
    below = lower(views[len(views) // 2].camera, centre)
    maps, radiances = renderer.view(below, {"room": RoomLight(), **lights}, 0)
    shown = [_exposed(image.numpy()) for image in radiances.values()]
    shown += [0.5 * maps.normals_world.numpy() + 0.5, _exposed(maps.albedo.numpy())]
    on = maps.mask.numpy()[..., None] > 0.5
    rows.append(np.hstack([_sized(image * on, _LARGE) for image in shown]))
    width = max(row.shape[1] for row in rows)
    rows = [np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0))) for row in rows]
    sheet = np.rint(255.0 * np.vstack(rows).clip(0.0, 1.0)).astype(np.uint8)
    cv2.imwrite(str(args.out), np.ascontiguousarray(sheet[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 90])


def pairs(renderer: PortraitRenderer, view: TruthView, lights: dict[str, object]) -> list[Image]:
    """Pictures of a view in turn from the portrait and the truth, display values [H, W, 3]."""
    known = {name: light for name, light in lights.items() if view.has_light(name)}
    maps, radiances = renderer.view(view.camera, {"captured": CapturedLight(), **known}, view.frame.flash)
    coverage, region = maps.mask.numpy()[..., None], view.mask() >= 254 / 255
    result = [to_display(radiances["captured"].numpy().clip(0, 1)), view.captured_srgb()]
    for name in known:
        result += _alike(radiances[name].numpy(), view.radiance(name), region)
    result += [0.5 * maps.normals_world.numpy() + 0.5, 0.5 * view.normals_world() + 0.5]
    result += _alike(maps.albedo.numpy(), view.albedo(), region)
    return [
        image * (part > 0.5) for image, part in zip(result, [coverage, region[..., None]] * 6, strict=True)
    ]


def lower(camera: Camera, centre: NDArray[np.floating]) -> Camera:
    """A camera turned about a point, down and to the side; +Y is up."""
    down, aside = np.radians([LOWER_DEG, ASIDE_DEG])
    turn = np.eye(4)
    turn[:3, :3] = (
        cv2.Rodrigues(np.array([0.0, aside, 0.0]))[0] @ cv2.Rodrigues(-down * camera.cam_from_world[0, :3])[0]
    )
    to, back = np.eye(4), np.eye(4)
    to[:3, 3], back[:3, 3] = -centre, centre
    return replace(camera, cam_from_world=camera.cam_from_world @ back @ turn @ to)


def _alike(ours: Image, truth: Image, region: NDArray[np.bool_]) -> list[Image]:
    """Both as display values, ours with the scales that bring it nearest, the truth's bright parts white."""
    white = np.percentile(truth[region], _BRIGHT)
    scaled = ours * channel_scales(ours[region], truth[region])
    return [to_display((image / white).clip(0, 1)) for image in (scaled, truth)]


def _exposed(image: Image) -> Image:
    return np.asarray(to_display((image / np.percentile(image[image.sum(-1) > 0], _BRIGHT)).clip(0, 1)))


def _sized(image: Image, share: float) -> NDArray[np.float32]:
    return cv2.resize(image.astype(np.float32), (0, 0), fx=share, fy=share, interpolation=cv2.INTER_AREA)


if __name__ == "__main__":
    main()
