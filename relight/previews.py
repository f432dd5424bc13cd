"""The pictures of a report: new lights, captured beside rendered, the maps, and views around the head.

Lights are placed in the axes of the view that is shown ("on the left"), so that they mean the same in any
world frame. Pictures are upright, display-referred and small: they are for looking.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from capture.atomic import atomic_write
from capture.cameras import Camera
from capture.frame_record import FrameRecord
from capture.images import write_jpeg
from capture.session import Session
from capture.transfer import to_display
from relight.lighting import CapturedLight, DirectionalLight, FlashLight, Light, RoomLight, SumLight
from relight.maps import Maps
from relight.portrait import Portrait
from relight.raster import NEAR_M, project
from relight.render import PortraitRenderer, display_picture, exposure_for, orbit_cameras
from relight.stages import Progress, no_progress
from relight.upright import upright_camera, upright_picture

_LONGEST_SIDE_PX = 420
_PAIRS = 4
_ORBIT_VIEWS = 7
_MASKS = 4
_OFF = 0.2  # of its light is left to what is off the subject

_MARGIN = 0.06  # about the head, in its own size
_RING, _RING_RAD = 6, 0.16  # a soft lamp: lights on its rim, and half its angle

Picture = NDArray[np.uint8]
Color = tuple[float, float, float]


@dataclass(frozen=True)
class Preview:
    """One picture of the report.

    Attributes:
        file: Name beside previews.json.
        group: Section: relit, captured, maps, orbit or masks.
        caption: For a person.
    """

    file: str
    group: str
    caption: str


def write_previews(
    portrait: Portrait, session: Session, out: Path, progress: Progress = no_progress
) -> list[Preview]:
    """Renders the pictures into `out`, with a previews.json that lists them in order."""
    out.mkdir(parents=True, exist_ok=True)
    gallery = _Gallery(portrait, session)
    previews = []
    for preview, picture in gallery.pictures():
        write_jpeg(out / preview.file, picture, quality=92)
        previews.append(preview)
        progress("previews", len(previews) / gallery.count)
    listing = {"previews": [asdict(preview) for preview in previews]}
    atomic_write(out / "previews.json", (json.dumps(listing, indent=1) + "\n").encode())
    return previews


def studio_lights(camera: Camera) -> dict[str, Light]:
    """Lights for looking, placed as the viewer of an upright camera sees them, by caption."""
    world_from_cam = camera.cam_from_world[:3, :3].T

    def lamp(right: float, up: float, front: float, color: Color, ambient: float = 0.0) -> SumLight:
        return soft_light(world_from_cam @ np.array([right, -up, -front]), color, ambient)

    warm, cold = lamp(-1.0, 0.1, 0.35, (1.0, 0.45, 0.18)), lamp(1.0, 0.15, 0.35, (0.2, 0.5, 1.0))
    return {
        "the room as it was": RoomLight(),
        "the flash alone": FlashLight(),
        "a window on the left": lamp(-1.0, 0.35, 0.45, (1.0, 0.98, 0.94), 0.08),
        "a low sun on the right": lamp(1.0, 0.25, 0.35, (1.0, 0.72, 0.42), 0.05),
        "a lamp above": lamp(0.1, 1.0, 0.8, (1.0, 0.93, 0.82), 0.06),
        "warm and cold": warm + cold,
    }


def soft_light(to_light: NDArray[np.float64], color: Color, ambient: float) -> SumLight:
    """A lamp as wide as a window: distant lights on a ring about a direction and one in its middle."""
    axis = to_light / np.linalg.norm(to_light)
    across = np.linalg.svd(axis[None])[2][1:]  # [2, 3], orthonormal, perpendicular to the axis
    angles = np.arange(_RING) * 2.0 * np.pi / _RING
    ring = axis + np.tan(_RING_RAD) * (
        np.cos(angles)[:, None] * across[0] + np.sin(angles)[:, None] * across[1]
    )
    directions = np.concatenate([axis[None], ring / np.linalg.norm(ring, axis=1, keepdims=True)])
    share = 1.0 / len(directions)
    red, green, blue = color
    return SumLight(
        tuple(
            DirectionalLight(
                (float(x), float(y), float(z)),
                ambient=ambient,
                color=(share * red, share * green, share * blue),
                shadows=True,
            )
            for x, y, z in directions
        )
    )


def framed(camera: Camera, points: torch.Tensor) -> Camera:
    """The camera cropped to the points that it sees, with a margin, at a size that suits a page."""
    uv_px, z_m = project(points, camera)
    uv = uv_px[z_m > NEAR_M].double().cpu().numpy()
    size = np.array([camera.width, camera.height])
    low, high = np.percentile(uv, [0.5, 99.5], axis=0) if len(uv) else (np.zeros(2), size)
    margin = _MARGIN * float((high - low).max())
    low = np.floor(np.clip(low - margin, 0, size - 16))
    high = np.ceil(np.clip(high + margin, low + 16, size))
    K = camera.K.copy()
    K[:2, 2] -= low
    width, height = (int(side) for side in high - low)
    cropped = replace(camera, width=width, height=height, K=K)
    return _small(cropped)


class _Gallery:
    """The pictures of one portrait of a session."""

    def __init__(self, portrait: Portrait, session: Session) -> None:
        self._portrait = portrait
        self._renderer = PortraitRenderer(portrait)
        self._session = session
        self._rotation_deg = session.info["image"]["rotation_deg"]
        poses = session.load_scene_cameras()
        self._shown = [record for record in session.frames if record.usable and record.index in poses]
        self._cameras = {
            record.index: upright_camera(poses[record.index], self._rotation_deg) for record in self._shown
        }
        self._front = framed(self._cameras[self._shown[len(self._shown) // 2].index], portrait.points)
        self._pairs = self._chosen_pairs()
        masked = [record for record in self._shown if session.mask_path(record.index).is_file()]
        self._masked = _evenly(masked, _MASKS)
        self.count = len(studio_lights(self._front)) + len(self._pairs) + 4 + 1 + len(self._masked)

    def pictures(self) -> Iterator[tuple[Preview, Picture]]:
        """All of them, in the order of the report."""
        yield from self._relit()
        for record in self._pairs:
            yield self._pair(record)
        yield from self._maps()
        yield self._orbit()
        for record in self._masked:
            yield self._mask(record)

    def _relit(self) -> Iterator[tuple[Preview, Picture]]:
        lights = studio_lights(self._front)
        maps, radiances = self._renderer.view(self._front, lights)
        for number, (caption, radiance) in enumerate(radiances.items()):
            picture = display_picture(radiance, maps.mask, exposure_for(radiance, maps.mask))
            yield Preview(f"relit_{number}.jpg", "relit", caption), picture

    def _chosen_pairs(self) -> list[FrameRecord]:
        """Lit and unlit frames spread over the capture, such as were not fitted where there are any."""
        held_out = [record for record in self._shown if record.split == "val"] or self._shown
        return [
            record
            for flash in (1, 0)
            for record in _evenly([record for record in held_out if record.flash == flash], _PAIRS // 2)
        ]

    def _pair(self, record: FrameRecord) -> tuple[Preview, Picture]:
        camera = _small(self._cameras[record.index])
        frame = upright_picture(self._session.load_radiance(record), self._rotation_deg)
        frame = cv2.resize(frame, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        maps, radiances = self._renderer.view(camera, {"captured": CapturedLight()}, record.flash)
        rendered = display_picture(radiances["captured"], maps.mask)
        flash = "flash" if record.flash == 1 else "no flash"
        held_out = ", not fitted" if record.split == "val" else ""
        caption = f"frame {record.index}, {flash}{held_out}"
        both = np.concatenate([_bytes(to_display(np.clip(frame, 0.0, 1.0))), rendered], axis=1)
        return Preview(f"frame_{record.index:06d}.jpg", "captured", caption), both

    def _maps(self) -> Iterator[tuple[Preview, Picture]]:
        maps, _ = self._renderer.view(self._front, {})
        shading = maps.shading[..., None] * maps.shading.new_tensor(self._portrait.c_room)
        white = torch.ones_like(maps.albedo)
        for name, caption, picture in (
            ("albedo", "albedo: what the skin reflects", display_picture(maps.albedo, maps.mask)),
            ("normals", "normals: which way it faces", _normal_colours(maps, self._front)),
            (
                "shading",
                "shading: what the room gives",
                display_picture(shading, maps.mask, exposure_for(shading, maps.mask)),
            ),
            ("mask", "mask: what is head", display_picture(white, maps.mask)),
        ):
            yield Preview(f"{name}.jpg", "maps", caption), picture

    def _mask(self, record: FrameRecord) -> tuple[Preview, Picture]:
        """A frame with what is off the subject darkened."""
        camera = _small(self._cameras[record.index])
        coverage = self._session.load_mask(record)
        assert coverage is not None
        mask = upright_picture(coverage, self._rotation_deg)
        frame = upright_picture(self._session.load_radiance(record), self._rotation_deg)
        size = (camera.width, camera.height)
        mask = cv2.resize(mask, size, interpolation=cv2.INTER_AREA).astype(np.float32) / 255.0
        shown = to_display(np.clip(cv2.resize(frame, size, interpolation=cv2.INTER_AREA), 0.0, 1.0))
        picture = _bytes(shown * (_OFF + (1.0 - _OFF) * mask[..., None]))
        return Preview(f"mask_{record.index:06d}.jpg", "masks", f"frame {record.index}"), picture

    def _orbit(self) -> tuple[Preview, Picture]:
        """One strip of views along the captured arc, under a light that stays where it is in the world."""
        centre = self._portrait.points.mean(dim=0).cpu().numpy()
        there_and_back = orbit_cameras(list(self._cameras.values()), centre, 2 * (_ORBIT_VIEWS - 1))
        light = studio_lights(self._front)["a window on the left"]
        strip = []
        exposure = None
        for camera in there_and_back[:_ORBIT_VIEWS]:
            maps, radiances = self._renderer.view(_small(camera).scaled(0.7), {"light": light})
            exposure = exposure or exposure_for(radiances["light"], maps.mask)
            strip.append(display_picture(radiances["light"], maps.mask, exposure))
        caption = "along the captured arc, the light staying where it is"
        return Preview("orbit.jpg", "orbit", caption), np.concatenate(strip, axis=1)


def _small(camera: Camera) -> Camera:
    return camera.scaled(min(1.0, _LONGEST_SIDE_PX / max(camera.width, camera.height)))


def _normal_colours(maps: Maps, camera: Camera) -> Picture:
    """[H, W, 3]: red to the right, green up, blue towards the viewer; black where there is no head."""
    cam_from_world = torch.as_tensor(camera.cam_from_world[:3, :3]).to(maps.normals_world)
    seen = maps.normals_world @ cam_from_world.T * maps.normals_world.new_tensor([1.0, -1.0, -1.0])
    return _bytes(((0.5 + 0.5 * seen) * maps.mask[..., None]).clamp(0.0, 1.0).cpu().numpy())


def _evenly(records: Sequence[FrameRecord], count: int) -> list[FrameRecord]:
    """`count` of the records at even distances, the ends left out where possible."""
    if len(records) <= count:
        return list(records)
    picks = ((np.arange(count) + 0.5) * len(records) / count).astype(int)
    return [records[pick] for pick in picks]


def _bytes(display: NDArray[Any]) -> Picture:
    picture: Picture = np.rint(255.0 * display).astype(np.uint8)
    return picture
