"""The truth folder of a simulated capture, in the form of a posed image set with measured lights.

cameras.json, cameras_val.json, lights.json     cameras, flash flags, splits; the lights that were rendered
linear/NAME.exr, mask/NAME.png                  the noise-free frame; coverage 0..255
gt/albedo_NAME.exr, normal_, depth_NAME.png     reflectance; world normals; z in 0.05 mm (0 = no head)
relight/LIGHT_NAME.exr, relight/env1.exr        the sitter under novel lights; and the environments
points.ply, gt/surface.ply                      the noisy input cloud; exact points for measuring
gt/markers.json                                 corners of printed markers, in the room's axes, if any
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from capture.atomic import atomic_write
from capture.cameras import Camera
from capture.images import write_exr, write_png
from capture.ply import write_ply
from capture.sim.cloud import sample_surface, stereo_cloud
from capture.sim.environment import Environment
from capture.sim.markers import described
from capture.sim.rig import Rig
from capture.sim.shading import (
    draw_layer,
    draw_vertices,
    environment_diffuse,
    environment_gloss,
    facing_vertices,
    point_light,
)

DEPTH_UNITS_PER_M = 20_000
AMBIENT = 0.5
DIRECTIONS = {
    "dir1": (0.502518908, 0.502518908, 0.703526471),
    "dir2": (-0.852133002, 0.150376412, 0.501254707),
    "dir3": (0.0, 0.943858356, 0.330350425),
}
POINT_POSITION = (-0.55, 0.45, 0.55)
POINT_COLOR = (0.91, 0.77, 0.64)
_SAME_SURFACE_M = 0.005  # samples of a pixel this close behind its nearest one are averaged into its depth
_SURFACE_POINTS_PER_CLOUD_POINT = 1.5


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """What a camera would see of the sitter's own properties.

    Attributes:
        albedo: [H, W, 3] linear reflectance, 0 off the sitter.
        normals_world: [H, W, 3] unit, 0 off the sitter.
        depth: [H, W] metres along the optical axis, 0 off the sitter.
        mask: [H, W] coverage 0 .. 1.
    """

    albedo: np.ndarray
    normals_world: np.ndarray
    depth: np.ndarray
    mask: np.ndarray


def ground_truth(rig: Rig, camera: Camera) -> GroundTruth:
    """Properties of the sitter, averaged over each pixel's covered samples."""
    factor, size = rig.config.supersampling, (camera.width, camera.height)
    albedo = draw_layer(rig.bust, camera, rig.bust.albedo, factor)
    covered = albedo.coverage[..., None]
    raster = draw_vertices(rig.bust, camera.scaled(factor), rig.bust.normals)
    normals = cv2.resize(raster.values, size, interpolation=cv2.INTER_AREA)
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    blocks = raster.depth.reshape(camera.height, factor, camera.width, factor)
    nearest = blocks.min(axis=(1, 3), keepdims=True)
    close = blocks < nearest + _SAME_SURFACE_M
    depth = (blocks * close).sum(axis=(1, 3)) / close.sum(axis=(1, 3))
    return GroundTruth(
        albedo=albedo.radiance / np.maximum(covered, 1e-6),
        normals_world=normals / np.maximum(length, 1e-6),
        depth=np.where(covered[..., 0] > 0, depth, 0.0).astype(np.float32),
        mask=albedo.coverage,
    )


def relit(rig: Rig, camera: Camera, truth: GroundTruth) -> dict[str, np.ndarray]:
    """The sitter under each novel light: name to [H, W, 3] radiance.

    Directional ones follow L = A (ambient + (1 - ambient) max(0, <N, l>)); point light and environments
    have shadows and gloss and are premultiplied by coverage.
    """
    result = {}
    for name, to_light in DIRECTIONS.items():
        cosine = np.maximum(truth.normals_world @ np.array(to_light, np.float32), 0.0)
        result[name] = truth.albedo * (AMBIENT + (1 - AMBIENT) * cosine)[..., None]
    bust, eye = rig.bust, camera.centre_world
    chosen = facing_vertices(bust, eye)
    environments = {"env1": (rig.studio, rig.passed[1]), "env2": (rig.sunset, rig.passed[2])}
    for name, (environment, passed) in environments.items():
        radiance = environment_diffuse(bust, environment, passed)
        radiance[chosen] += environment_gloss(bust, environment, passed, eye, chosen)
        result[name] = draw_layer(bust, camera, radiance, rig.config.supersampling).radiance
    radiance = np.zeros_like(bust.albedo)
    radiance[chosen] = point_light(bust, np.array(POINT_POSITION), np.array(POINT_COLOR), chosen, eye)
    result["point"] = draw_layer(bust, camera, radiance, rig.config.supersampling).radiance
    return result


def write_lights(rig: Rig, out: Path) -> None:
    """lights.json and the environment maps."""
    lights: list[dict[str, Any]] = [{"name": "captured", "kind": "captured"}]
    for name, to_light in DIRECTIONS.items():
        lights.append({"name": name, "kind": "directional", "to_light": list(to_light), "ambient": AMBIENT})
    environments: dict[str, Environment] = {"env1": rig.studio, "env2": rig.sunset}
    for name, environment in environments.items():
        write_exr(_made(out / "relight") / f"{name}.exr", environment.radiance, half=False)
        lights.append({"name": name, "kind": "environment", "map": f"relight/{name}.exr"})
    lights.append(
        {"name": "point", "kind": "point", "position": list(POINT_POSITION), "C": list(POINT_COLOR)}
    )
    _write_json(out / "lights.json", {"lights": lights})


def write_view(rig: Rig, camera: Camera, out: Path, *, relight: bool) -> None:
    """gt/ and, if wanted, relight/ of one view."""
    truth = ground_truth(rig, camera)
    gt, name = _made(out / "gt"), camera.name
    write_exr(gt / f"albedo_{name}.exr", truth.albedo)
    write_exr(gt / f"normal_{name}.exr", truth.normals_world)
    write_png(gt / f"depth_{name}.png", np.round(truth.depth * DEPTH_UNITS_PER_M).astype(np.uint16))
    if relight:
        for light, radiance in relit(rig, camera, truth).items():
            write_exr(_made(out / "relight") / f"{light}_{name}.exr", radiance)


def write_frame(rig: Rig, camera: Camera, out: Path, *, time_s: float, noise_index: int | None) -> None:
    """frames/, linear/ and mask/ of one view at a time of the recording.

    The 8-bit frame is noisy, with the shake and the exposure of its time, when it has a noise index; the
    linear one is always sharp and at the exposure of the beginning.
    """
    layers = rig.layers(camera, bool(camera.flash), rig.room_from_head(time_s))
    radiance = layers.room if layers.flash is None else layers.room + layers.flash
    if noise_index is None:
        rgb = rig.config.sensor.encode(radiance)
    else:
        rgb = rig.expose(radiance, camera, time_s, noise_index)
    write_png(_made(out / "frames") / f"{camera.name}.png", rgb)
    write_exr(_made(out / "linear") / f"{camera.name}.exr", radiance)
    write_png(_made(out / "mask") / f"{camera.name}.png", np.round(255 * layers.coverage).astype(np.uint8))


def write_clouds(rig: Rig, out: Path) -> None:
    """points.ply (input), gt/surface.ply (truth), and gt/markers.json where there are any."""
    rng = np.random.default_rng([rig.config.subject.seed, 404])
    duration_s = rig.config.path.duration_s
    cameras = [rig.camera(part * duration_s, "stereo") for part in np.linspace(0.03, 0.97, 9)]
    write_ply(out / "points.ply", stereo_cloud(rig.bust, cameras, rig.config.cloud_points, rng))
    exact = sample_surface(rig.bust, round(rig.config.cloud_points * _SURFACE_POINTS_PER_CLOUD_POINT), rng)
    write_ply(_made(out / "gt") / "surface.ply", exact)
    if rig.room.markers:
        markers = described(rig.room.markers, rig.config.decor.marker_side_m)
        _write_json(out / "gt" / "markers.json", markers)


def write_cameras(rig: Rig, path: Path, cameras: list[Camera], entries: list[dict[str, Any]]) -> None:
    """A cameras.json: one entry a camera, completed with pose and flash position."""
    first = cameras[0]
    frames = []
    for camera, entry in zip(cameras, entries, strict=True):
        pose = camera.cam_from_world
        frames.append(
            entry
            | {
                "R": pose[:3, :3].tolist(),
                "t": pose[:3, 3].tolist(),
                "camera_centre": camera.centre_world.tolist(),
                "flash_position": rig.flash_position(camera).tolist(),
            }
        )
    content = {
        "name": f"simulated rig, subject {rig.config.subject.seed}",
        "width": first.width,
        "height": first.height,
        "units": "metres",
        "world": "+Y up, +Z where the face looks, +X the subject's left; origin near the centre of the head"
        + ("" if rig.config.motion.still else "; it moves with the head, which moves in the room"),
        "camera_convention": "OpenCV, world-to-camera: x_cam = R x_world + t (x right, y down, z forward); "
        "u = fx x/z + cx; the CENTRE of the top-left pixel is (0.5, 0.5)",
        "K": first.K.tolist(),
        "distortion": [0, 0, 0, 0, 0],
        "transfer": rig.config.sensor.transfer,
        "flash": {
            "offset_cam": list(rig.config.flash_offset_cam_m),
            "C_flash": list(rig.config.flash_color),
            "model": "A * C_flash / d^2 * max(0, <N, l>) + gloss, with cast shadows; isotropic point",
        },
        "depth": "gt/depth_*.png: uint16, z along the optical axis in units of 0.05 mm, 0 = no head",
        "frames": frames,
    }
    _write_json(path, content)


def _made(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def _write_json(path: Path, content: dict[str, Any]) -> None:
    atomic_write(path, (json.dumps(content, indent=1, allow_nan=False) + "\n").encode())
