"""A face prior on the disk: face.safetensors for tensors, face.json for the rest; neither can run code."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save

from capture.atomic import atomic_write
from capture.cameras import Camera, check_intrinsics, check_rotation
from capture.json_fields import parse_json
from relight.errors import PlanError
from relight.face.plane import Plane
from relight.face.prior import FacePrior
from relight.face.surface import TEXELS, FaceSurface

VERSION = 1
TENSORS_FILE = "face.safetensors"
FIELDS_FILE = "face.json"

_SOURCES = ("cloud", "landmarks", "maps")


def save_face(prior: FacePrior, folder: Path) -> None:
    """Writes a prior into a folder, such as a session's scene/face; each file whole or not at all."""
    folder.mkdir(parents=True, exist_ok=True)
    surface = prior.surface
    tensors = {
        "points": surface.points,
        "normals_world": surface.normals_world,
        "valid": surface.valid.to(torch.uint8),
        "region": surface.region.to(torch.uint8),
        "cosines": prior.cosines,
    }
    if surface.albedo is not None:
        tensors["albedo"] = surface.albedo
    if prior.uv_px is not None:
        tensors["uv_px"] = prior.uv_px
    content = {
        "schema": "relight-face",
        "version": VERSION,
        "source": prior.source,
        "reason": prior.reason,
        "plane": {"normal": list(prior.plane.normal), "offset": prior.plane.offset},
        "cameras": [_camera_json(index, camera) for index, camera in prior.cameras.items()],
        "report": dict(prior.report),
    }
    text = json.dumps(content, indent=1, allow_nan=False) + "\n"  # before a file is touched: this can fail
    atomic_write(folder / TENSORS_FILE, save({name: t.cpu().contiguous() for name, t in tensors.items()}))
    atomic_write(folder / FIELDS_FILE, text.encode())


def load_face(folder: Path, device: torch.device | str = "cpu") -> FacePrior:
    """Reads a prior.

    Raises:
        PlanError: It is not there, not whole, of a newer version, or malformed.
    """
    folder = Path(folder)
    for file in (FIELDS_FILE, TENSORS_FILE):
        if not (folder / file).is_file():
            raise PlanError(f"There is no face prior in {folder} ({file} is missing); find it again.")
    try:
        content = parse_json((folder / FIELDS_FILE).read_bytes())
        if content["schema"] != "relight-face":
            raise ValueError("it is no face prior")
        version = content["version"]
    except (ValueError, KeyError, TypeError) as error:
        raise PlanError(f"{folder / FIELDS_FILE} cannot be read ({error}); find the face again.") from error
    if version != VERSION:
        raise PlanError(
            f"{folder / FIELDS_FILE} has version {version}, this program reads version {VERSION}; update the "
            "program or find the face again."
        )
    try:
        tensors = load_file(folder / TENSORS_FILE, device=str(device))
        cameras = dict(_camera(entry) for entry in content["cameras"])
        _check(tensors, len(cameras))
        if content["source"] not in _SOURCES:
            raise ValueError(f"the source {content['source']!r} is unknown")
        surface = FaceSurface(
            points=tensors["points"],
            normals_world=tensors["normals_world"],
            valid=tensors["valid"] > 0,
            region=tensors["region"] > 0,
            albedo=tensors.get("albedo"),
        )
        plane = Plane.of(np.array(content["plane"]["normal"], float), float(content["plane"]["offset"]))
        return FacePrior(
            source=str(content["source"]),
            reason=str(content["reason"]),
            surface=surface,
            plane=plane,
            cameras=cameras,
            cosines=tensors["cosines"],
            uv_px=tensors.get("uv_px"),
            report=dict(content["report"]),
        )
    except (SafetensorError, OSError, ValueError, KeyError, TypeError, OverflowError) as error:
        raise PlanError(f"The face prior in {folder} is damaged ({error}); find the face again.") from error


def _check(tensors: dict[str, torch.Tensor], frames: int) -> None:
    side = (TEXELS, TEXELS)
    expected = {
        "points": ((*side, 3), torch.float32),
        "normals_world": ((*side, 3), torch.float32),
        "valid": (side, torch.uint8),
        "region": (side, torch.uint8),
        "cosines": ((frames, *side), torch.uint8),
        "albedo": ((*side, 3), torch.float32),
        "uv_px": ((frames, *side, 2), torch.float32),
    }
    for name, (shape, kind) in expected.items():
        if name not in tensors and name in ("albedo", "uv_px"):
            continue
        values = tensors[name]
        if tuple(values.shape) != shape or values.dtype != kind:
            raise ValueError(f"{name} is not of shape {list(shape)} and {kind}")
        if values.is_floating_point() and not values.isfinite().all():
            raise ValueError(f"{name} is not finite")


def _camera_json(index: int, camera: Camera) -> dict[str, Any]:
    return {
        "index": index,
        "name": camera.name,
        "width": camera.width,
        "height": camera.height,
        "K": camera.K.tolist(),
        "cam_from_world": camera.cam_from_world.tolist(),
        "flash": camera.flash,
    }


def _camera(entry: dict[str, Any]) -> tuple[int, Camera]:
    intrinsics, pose = np.array(entry["K"], float), np.array(entry["cam_from_world"], float)
    if intrinsics.shape != (3, 3) or pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise ValueError(f"the camera of frame {entry['index']} is malformed")
    if complaint := check_intrinsics(intrinsics) or check_rotation(pose[:3, :3]):
        raise ValueError(complaint)
    width, height = int(entry["width"]), int(entry["height"])
    if min(width, height) < 1:
        raise ValueError(f"the camera of frame {entry['index']} has {width} x {height} pixels")
    camera = Camera(str(entry["name"]), width, height, intrinsics, pose, flash=entry["flash"])
    return int(entry["index"]), camera
