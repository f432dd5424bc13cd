"""What each part of a calibration is worth: fits of a simulated rig with all of it, less each part, and none.

    python -m benchmarks.calibration_worth --out benchmarks/results/calibration_worth.json

The sitter of the simulated rig is filmed by a camera and a lamp that are none of the things a fit assumes
when it knows nothing: the lamp sits beside the lens and shines in a beam, the lens bends and darkens its
corners, the channels see each other's colours, black is not 0, the curve is none of the named ones. The
calibration is the truth with the errors that `relight calibrate` states for such parts. Poses, cloud and
masks are given. What is left out falls back to what a session without it assumes.

The albedo is measured with one scale a channel for all views (PSNR), with one scale for all channels
("colour"), and without any ("absolute", median relative error).
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from benchmarks.record import write_record
from calib.calibration import Calibration, Quantity, save_calibration
from capture.cameras import Camera
from capture.images import write_png
from capture.ply import write_ply
from capture.response import Response
from capture.session import FrameRecord, Session
from capture.sim.camera_path import CameraPath
from capture.sim.cloud import stereo_cloud
from capture.sim.config import RigConfig
from capture.sim.rig import Rig
from capture.sim.truth import GroundTruth, ground_truth
from capture.transfer import to_display
from relight.evaluate import portrait_renderer
from relight.metrics import angles_deg, channel_scales, psnr_db
from relight.photometric import solve
from relight.scene import load_scene

RIG = RigConfig(
    width=300,
    height=400,
    focal_px=431.0,
    path=CameraPath(duration_s=10.0),
    cloud_points=40_000,
    strands=3000,
    flash_offset_cam_m=(0.07, -0.04, 0.01),
    flash_color=(0.30, 0.285, 0.255),
    room_level=0.4,
)
FRAMES, EVERY, VIEWS = 48, 4, 5
AXIS = np.array([-0.12, 0.06, 1.0]) / np.linalg.norm([-0.12, 0.06, 1.0])
FALLOFF = 8.0
DISTORTION = np.array([-0.18, 0.05, 0.0, 0.0])
FLAT = np.array([-0.45, 0.08])
DARK = np.full(3, 0.035)
CURVE = 1.0 / 1.8
CAMERA = np.array([[0.74, 0.22, 0.04], [0.16, 0.74, 0.10], [0.03, 0.24, 0.73]])  # linear sRGB -> camera RGB
READ, SHOT = 0.004, 1 / 2500

PARTS = {
    "response": ("response",),
    "dark level": ("dark",),
    "flat field": ("flat_field",),
    "noise": ("noise_read", "noise_shot"),
    "colour": ("colour",),
    "flash's place": ("flash_offset_cam_m",),
    "flash's beam": ("flash_axis", "flash_falloff"),
    "flash's strength": ("flash_strength",),
    "lens": (),
}


@dataclass(frozen=True, eq=False)
class Filmed:
    """A session on the disk without its calibration, and the truth.

    Attributes:
        session: the folder.
        cameras: by frame, with the lens's distortion.
        views: where it is measured, and what is true there.
    """

    session: Path
    cameras: dict[int, Camera]
    views: list[tuple[Camera, GroundTruth]]


def film(folder: Path, seed: int) -> Filmed:
    """Takes all frames."""
    rig = Rig.build(replace(RIG, path=replace(RIG.path, seed=seed)))
    rng = np.random.default_rng(seed)
    duration_s = RIG.path.duration_s
    with Session.create(folder, source={"kind": "simulated"}, width=RIG.width, height=RIG.height) as session:
        cameras = {}
        for number in range(FRAMES):
            flash = int(number % EVERY == 0)
            camera = rig.camera(duration_s * (number + 0.5) / FRAMES, f"{number:04d}", flash)
            radiance, coverage = seen(rig, camera)
            stored, mask = photographed(radiance, camera, rng), through_lens(coverage, camera)
            file = session.write_frame(number, stored)
            session.append_frame(
                FrameRecord(index=number, file=file, width=RIG.width, height=RIG.height, flash=flash)
            )
            session.masks_dir.mkdir(parents=True, exist_ok=True)
            write_png(session.mask_path(number), np.round(255 * mask).astype(np.uint8))
            cameras[number] = replace(camera, distortion=DISTORTION)
        stereo = [rig.camera(part * duration_s, "stereo") for part in np.linspace(0.03, 0.97, 9)]
        session.save_scene_cameras(cameras)
        write_ply(session.points_path, stereo_cloud(rig.bust, stereo, RIG.cloud_points, rng))
    views = [rig.camera(part * duration_s, "view") for part in np.linspace(0.08, 0.92, VIEWS)]
    return Filmed(folder, cameras, [(camera, ground_truth(rig, camera)) for camera in views])


def seen(rig: Rig, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Radiance [H, W, 3] in linear sRGB before the lens, and the sitter's coverage [H, W]."""
    layers = rig.layers(camera, bool(camera.flash))
    if layers.flash is None:
        return layers.room, layers.coverage
    depth = ground_truth(rig, camera).depth
    depth = np.where(depth > 0, depth, 1.5)  # the room behind
    v, u = np.mgrid[0 : camera.height, 0 : camera.width] + 0.5
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(camera.K).T
    from_lamp = rays * depth[..., None] - np.array(RIG.flash_offset_cam_m)
    cosine = (from_lamp @ AXIS) / np.linalg.norm(from_lamp, axis=-1)
    return layers.room + layers.flash * np.maximum(cosine, 0.0)[..., None] ** FALLOFF, layers.coverage


def photographed(radiance: np.ndarray, camera: Camera, rng: np.random.Generator) -> np.ndarray:
    """What the camera stores [H, W, 3] uint8 of radiance before the lens."""
    height, width = radiance.shape[:2]
    v, u = np.mgrid[0:height, 0:width] + 0.5
    r2 = ((u - width / 2) ** 2 + (v - height / 2) ** 2) / (0.25 * (width**2 + height**2))
    passed = 1.0 + sum(term * r2 ** (k + 1) for k, term in enumerate(FLAT))
    exposure = through_lens(radiance, camera) @ CAMERA.T * passed[..., None]
    noise = np.sqrt(READ**2 + SHOT * np.maximum(exposure, 0.0))
    exposure = np.clip(exposure + rng.normal(size=exposure.shape) * noise, 0.0, 1.0)
    return np.round(255 * (DARK + (1 - DARK) * exposure**CURVE)).astype(np.uint8)


def through_lens(picture: np.ndarray, camera: Camera) -> np.ndarray:
    """A pinhole's picture as the lens draws it."""
    height, width = picture.shape[:2]
    v, u = np.mgrid[0:height, 0:width] + 0.5
    K = camera.K
    straight = cv2.undistortPoints(
        np.stack([u, v], axis=-1).reshape(-1, 1, 2), K, DISTORTION, P=K, criteria=(3, 30, 1e-9)
    ).reshape(height, width, 2)
    x, y = np.moveaxis(straight.astype(np.float32) - np.float32(0.5), -1, 0)
    return cv2.remap(picture.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def calibrated(rng: np.random.Generator) -> Calibration:
    """The truth, off by what such parts are calibrated to."""
    stored = np.linspace(0.0, 1.0 - DARK[0], 256)
    linear = (stored / (1.0 - DARK[0])) ** (1 / CURVE)
    axis = AXIS + rng.normal(0, np.radians(0.5), 3)
    white = CAMERA.sum(axis=1)  # of a white light
    matrix = np.linalg.inv(CAMERA) * white[1] + rng.normal(0, 0.01, (3, 3))
    strength = (CAMERA @ np.array(RIG.flash_color)) * (1 + rng.normal(0, 0.005, 3))

    def known(value: Any, unit: str = "1") -> Quantity:
        return Quantity.of(value, unit, "the truth with the errors of a calibration")

    return Calibration(
        response=Response(None, stored, linear, "the truth"),
        dark=known(DARK + rng.normal(0, 0.0005, 3)),
        noise_read=known(np.full(3, READ * 1.05)),
        noise_shot=known(np.full(3, SHOT * 0.95)),
        flat_field=known(FLAT + rng.normal(0, 0.005, 2)),
        colour=known(matrix),
        flash_offset_cam_m=known(np.array(RIG.flash_offset_cam_m) + rng.normal(0, 0.001, 3), "m"),
        flash_axis=known(axis / np.linalg.norm(axis)),
        flash_falloff=known(FALLOFF + rng.normal(0, 0.1)),
        flash_strength=known(strength, "m^2"),
    )


def fitted(filmed: Filmed, calibration: Calibration, lens: bool) -> dict[str, float]:
    """The errors of a fit with a calibration."""
    opened = Session.open(filmed.session)
    opened.calibration_path.unlink(missing_ok=True)
    save_calibration(calibration, opened.calibration_path)
    opened = Session.open(filmed.session)
    portrait = solve(load_scene(opened, frames=list(filmed.cameras), undistort=lens))
    render = portrait_renderer(portrait)
    albedos, truths, angles = [], [], []
    for camera, truth in filmed.views:
        maps = render(camera, {}, 0)
        full = (truth.mask > 0.99) & (maps.mask > 0.5)
        albedos.append(maps.albedo[full].astype(np.float64))
        truths.append(truth.albedo[full].astype(np.float64))
        angles.append(angles_deg(maps.normals_world[full], truth.normals_world[full]))
    found, true, off = np.concatenate(albedos), np.concatenate(truths), np.concatenate(angles)
    everywhere = np.ones(len(found), bool)
    scaled = found * channel_scales(found, true)
    grey = found * (found * true).sum() / (found * found).sum()
    return {
        "albedo_psnr_db": psnr_db(to_display(scaled), to_display(true), everywhere),
        "colour_psnr_db": psnr_db(to_display(grey), to_display(true), everywhere),
        "absolute_median_relative_error": float(np.median(np.abs(found - true) / true)),
        "normals_mean_deg": float(np.nanmean(off)),
        "normals_median_deg": float(np.nanmedian(off)),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    torch.set_num_threads(2)
    rows = {}
    with tempfile.TemporaryDirectory() as folder:
        filmed = film(Path(folder) / "S", args.seed)
        full = calibrated(np.random.default_rng(args.seed))
        trials = {"all": (full, True)}
        for name, entries in PARTS.items():
            trials[f"without {name}"] = (replace(full, **dict.fromkeys(entries)), name != "lens")
        trials["none"] = (Calibration(), False)
        for name, (calibration, lens) in trials.items():
            rows[name] = fitted(filmed, calibration, lens)
            print(name, {key: round(value, 4) for key, value in rows[name].items()}, flush=True)
    write_record(args.out, "calibration_worth", ("numpy", "torch"), {"seed": args.seed, "rows": rows})


if __name__ == "__main__":
    main()
