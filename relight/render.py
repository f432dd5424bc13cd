"""Pictures of a portrait: any view, under any light, as maps, linear pictures, display pictures and video.

    NAME.albedo.exr  NAME.normal.exr (world, unit)  NAME.shading.exr  NAME.mask.exr (0..1)  NAME.depth.exr
    NAME.albedo_sigma.exr, NAME.normal_sigma.exr, NAME.unobserved_flash.exr, NAME.unobserved_view.exr
                      how far these can be believed, see `relight.confidence`
    NAME.<light>.exr  linear, not premultiplied      NAME.<light>.png  for looking, on black

NAME is the name of the camera, the stem of its file. Pictures under the captured light, the room or the
flash are shown at the camera's own exposure. What a new light is worth in these units is anybody's choice,
so its PNGs are exposed such that the brightest half percent of the first view reaches `EXPOSED_TO`, the
same for all views.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from capture.cameras import Camera
from capture.images import decode_image, encode_image, write_exr, write_png
from capture.transfer import to_display
from capture.video.writer import VideoWriter
from relight.confidence import confidence_maps, seen_by_any
from relight.lamp import lamp_of_portrait
from relight.lighting import CapturedLight, FlashLight, Light, RoomLight, SumLight, shade
from relight.maps import Maps, render_maps
from relight.portrait import Portrait
from relight.shadows import ShadowCaster
from relight.stages import Progress, no_progress

EXPOSED_TO = 0.9
"""Linear display value of the brightest half percent under a new light."""

_ORBIT_HZ = 30.0
_CAPTURED = (CapturedLight, RoomLight, FlashLight)


class PortraitRenderer:
    """Renders one portrait; what does not depend on the view, such as depth maps from lights, is made
    once."""

    def __init__(self, portrait: Portrait, *, shadows: bool = True) -> None:
        """A renderer; without `shadows` new lights pass through the subject."""
        self.portrait = portrait
        self._caster = ShadowCaster(portrait) if shadows else None

    def view(
        self, camera: Camera, lights: Mapping[str, Light], flash: int | None = None
    ) -> tuple[Maps, dict[str, torch.Tensor]]:
        """Maps of a view and its radiance under each light.

        Args:
            camera: The view; lens distortion is not drawn.
            lights: By name.
            flash: Flag F for the captured light; by default the camera's own.

        Returns:
            The maps, and per light [H, W, 3] linear, not premultiplied, 0 where the mask is 0.
        """
        portrait = self.portrait
        maps = render_maps(portrait, camera)
        visibility = None if self._caster is None else self._caster.of_view(maps)
        radiances = {
            name: shade(
                light,
                maps,
                camera=camera,
                c_room=portrait.c_room,
                c_flash=portrait.c_flash,
                flash_offset_cam_m=portrait.flash_offset_cam_m,
                flash=flash,
                visibility=visibility,
                reflectance=portrait.reflectance,
                lamp=lamp_of_portrait(portrait.info),
            )
            for name, light in lights.items()
        }
        return maps, radiances


def render_view(
    portrait: Portrait,
    camera: Camera,
    lights: Mapping[str, Light],
    *,
    flash: int | None = None,
    shadows: bool = True,
) -> tuple[Maps, dict[str, torch.Tensor]]:
    """One view of a portrait; for several views make one `PortraitRenderer`, whose `view` this is."""
    return PortraitRenderer(portrait, shadows=shadows).view(camera, lights, flash)


def render_files(
    portrait: Portrait,
    cameras: Sequence[Camera],
    lights: Mapping[str, Light],
    out: Path,
    *,
    maps: bool = False,
    captured: Sequence[Camera] = (),
    shadows: bool = True,
    progress: Progress = no_progress,
) -> list[Path]:
    """Renders views into files named as the module says.

    Args:
        portrait: What to render.
        cameras: The views; their names become the files'.
        lights: By name.
        out: Folder; made if it is not there.
        maps: Whether to write the maps too.
        captured: Cameras of the capture, from which the maps tell what no frame saw.
        shadows: Whether new lights cast shadows.
        progress: Told ("render", fraction).

    Returns:
        The files, in the order in which they were written.
    """
    out.mkdir(parents=True, exist_ok=True)
    renderer = PortraitRenderer(portrait, shadows=shadows)
    written: list[Path] = []
    exposures: dict[str, float] = {}
    seen = seen_by_any(portrait, captured) if maps and captured else None
    for number, camera in enumerate(cameras):
        view, radiances = renderer.view(camera, lights)
        if maps:
            believed = confidence_maps(portrait, view, seen)
            written += _write_maps(view, believed, out, camera.name)
        for name, radiance in radiances.items():
            exposure = exposures.setdefault(name, _exposure(lights[name], radiance, view.mask))
            written.append(out / f"{camera.name}.{name}.exr")
            write_exr(written[-1], radiance.cpu().numpy())
            written.append(out / f"{camera.name}.{name}.png")
            write_png(written[-1], display_picture(radiance, view.mask, exposure))
        progress("render", (number + 1) / len(cameras))
    return written


def render_orbit(
    portrait: Portrait,
    cameras: Sequence[Camera],
    light: Light,
    out: Path,
    *,
    seconds: float = 8.0,
    rotation_deg: int = 0,
    shadows: bool = True,
    progress: Progress = no_progress,
) -> None:
    """A video that sweeps around the head along the captured arc and back, under one light.

    Args:
        portrait: What to render.
        cameras: Those of the capture: their arc, distance and lens are those of the orbit.
        light: Without a flash of its own flag: a captured light shines as without the flash.
        out: The .mp4 to write.
        seconds: Length.
        rotation_deg: Of the session: clockwise rotation that shows the pictures upright.
        shadows: Whether a new light casts shadows.
        progress: Told ("orbit", fraction).

    Raises:
        ValueError: There are no cameras.
    """
    path = orbit_cameras(
        cameras, portrait.points.mean(dim=0).cpu().numpy(), max(2, round(seconds * _ORBIT_HZ))
    )
    renderer = PortraitRenderer(portrait, shadows=shadows)
    exposure = 1.0
    turns = (rotation_deg // 90) % 4
    width, height = (path[0].width, path[0].height) if turns % 2 == 0 else (path[0].height, path[0].width)
    # H.264 in the common 4:2:0 form has no odd sides.
    half = len(path) // 2
    outward: list[bytes] = []  # the way back is the way there; compressed, for a long orbit is gigabytes
    with VideoWriter(out, width // 2 * 2, height // 2 * 2) as video:
        for number, camera in enumerate(path):
            if number <= half:
                view, radiances = renderer.view(camera, {"light": light}, 0)
                if number == 0:
                    exposure = _exposure(light, radiances["light"], view.mask)
                picture = np.rot90(display_picture(radiances["light"], view.mask, exposure), -turns)
                picture = np.ascontiguousarray(picture[: height // 2 * 2, : width // 2 * 2])
                outward.append(encode_image(picture, ".png", [cv2.IMWRITE_PNG_COMPRESSION, 1]))
            else:
                picture = decode_image(outward[len(path) - number], out)
            video.write(picture, number / _ORBIT_HZ)
            progress("orbit", (number + 1) / len(path))


def orbit_cameras(cameras: Sequence[Camera], centre: NDArray[np.floating], count: int) -> list[Camera]:
    """Cameras on a smooth arc about a centre, over the angles that were captured, there and back.

    The axis is the mean up direction of the captured cameras; height and distance are their medians.
    """
    if not cameras:
        raise ValueError("an orbit needs the captured cameras, and there are none")
    up = -np.mean([camera.cam_from_world[1, :3] for camera in cameras], axis=0)
    up = up / max(float(np.linalg.norm(up)), 1e-12)
    offsets = np.stack([camera.centre_world - centre for camera in cameras])
    heights = offsets @ up
    flat = offsets - heights[:, None] * up
    front = flat.mean(axis=0)
    if np.linalg.norm(front) < 1e-9:  # a full circle has no front; any will do
        front = flat[0]
    front = front / max(float(np.linalg.norm(front)), 1e-12)
    side = np.cross(up, front)
    azimuths = np.arctan2(flat @ side, flat @ front)
    low, high = np.percentile(azimuths, [5, 95])
    distance, height = float(np.median(np.linalg.norm(flat, axis=1))), float(np.median(heights))
    middle = cameras[len(cameras) // 2]
    path = []
    for step in range(count):
        swing = 0.5 - 0.5 * math.cos(2.0 * math.pi * step / count)
        azimuth = low + (high - low) * swing
        position = centre + distance * (math.cos(azimuth) * front + math.sin(azimuth) * side) + height * up
        path.append(
            replace(middle, name=f"{step:04d}", cam_from_world=_looking(position, centre, up), flash=None)
        )
    return path


def display_picture(radiance: torch.Tensor, mask: torch.Tensor, exposure: float = 1.0) -> NDArray[np.uint8]:
    """[H, W, 3] sRGB bytes of linear radiance [H, W, 3], on black by the mask [H, W]."""
    srgb = to_display((radiance * exposure).clamp(0.0, 1.0).cpu().numpy()) * mask[..., None].cpu().numpy()
    picture: NDArray[np.uint8] = np.rint(255.0 * srgb).astype(np.uint8)
    return picture


def exposure_for(radiance: torch.Tensor, mask: torch.Tensor) -> float:
    """Factor that brings the brightest half percent of the subject to `EXPOSED_TO`; 1 where all is dark."""
    lit = radiance.amax(dim=-1)[mask > 0.5]
    top = float(np.percentile(lit.cpu().numpy(), 99.5)) if len(lit) else 0.0
    return EXPOSED_TO / top if top > 0 else 1.0


def _exposure(light: Light, radiance: torch.Tensor, mask: torch.Tensor) -> float:
    """1 for the captured lights; for others what brings the brightest half percent to `EXPOSED_TO`."""
    parts = light.parts if isinstance(light, SumLight) else (light,)
    if any(isinstance(part, _CAPTURED) for part in parts):
        return 1.0
    return exposure_for(radiance, mask)


def _write_maps(view: Maps, believed: Mapping[str, torch.Tensor], out: Path, name: str) -> list[Path]:
    layers = {
        "albedo": view.albedo,
        "normal": view.normals_world,
        "shading": view.shading,
        "mask": view.mask,
        "depth": view.depth,
        **believed,
    }
    written = []
    for layer, values in layers.items():
        written.append(out / f"{name}.{layer}.exr")
        # Half floats hold depths to one part in 2048 only: a quarter of a millimetre at half a metre.
        write_exr(written[-1], values.cpu().numpy(), half=layer != "depth")
    return written


def _looking(
    position: NDArray[np.float64], target: NDArray[np.floating], up: NDArray[np.float64]
) -> NDArray[np.float64]:
    """cam_from_world [4, 4] of a camera at a position that looks at a target, its y axis downwards."""
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, up)
    right = right / max(float(np.linalg.norm(right)), 1e-12)
    cam_from_world = np.eye(4)
    cam_from_world[:3, :3] = [right, np.cross(forward, right), forward]
    cam_from_world[:3, 3] = -cam_from_world[:3, :3] @ position
    return cam_from_world
