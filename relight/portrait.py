"""A fitted portrait: points of the surface with what is known of each, and the lights it was captured in.

    portrait.safetensors     tensors, one row a point; those of its decoder, if it has one, under `decoder.`
    portrait.json            version, colours, reflectance, spacing, decoder, and where it came from

Nothing that is loaded can run code.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save

from capture.atomic import atomic_write
from capture.json_fields import parse_json
from relight.alignment import Similarity
from relight.decoder import Decoder, restored_decoder
from relight.errors import PortraitError
from relight.reflectance import Reflectance
from relight.room_gloss import RoomGloss

VERSION = 3
"""1 had no decoder, 2 no light that bounced under the flash; both are still read."""

TENSORS_FILE = "portrait.safetensors"
FIELDS_FILE = "portrait.json"

_READ = (1, 2, VERSION)
_DECODER = "decoder."  # before the names of its tensors

_TENSORS = {
    "points": 3,
    "normals_world": 3,
    "albedo": 3,
    "room_radiance": 3,
    "shading": 0,
    "gloss": 0,
    "flash_bounce": 0,
    "confidence": 0,
    "albedo_sigma": 0,
    "normal_sigma_rad": 0,
    "residual": 0,
}


@dataclass(frozen=True, eq=False)
class Portrait:
    """Points of the surface; P of them, all tensors float32 and finite.

    Attributes:
        points: [P, 3] world.
        normals_world: [P, 3] unit.
        albedo: [P, 3] linear. Its scale is a convention (see `relight.photometric`): only albedo * C is
            observable.
        room_radiance: [P, 3] linear radiance under the room's light, colour of the room's light included.
            The paper's A * C_room * s is its grey approximation.
        shading: [P] room shading s, 0..1.
        gloss: [P] factor on the reflectance's f0: cloth has less of it than skin.
        flash_bounce: [P] what came of the capture's flash by way of other parts of the subject, over what
            came from it straight, for an albedo of 1 (`relight.flash_bounces`).
        confidence: [P] 0..1, how well the flash observed the point; 0 = filled in from neighbours.
        albedo_sigma: [P] standard error of the albedo (mean of channels), infinite nowhere: 1 where unknown.
        normal_sigma_rad: [P] standard error of the normal, radians.
        residual: [P] root mean square of what the fit leaves in the flash frames, relative to the albedo.
        spacing: Typical distance between points, world units.
        c_room: [3] colour of the room's light: radiance of a white surface at s = 1.
        c_flash: [3] colour of the flash: radiance of a white surface that faces it from a distance of 1.
        flash_offset_cam_m: [3] lens to flash in camera axes.
        reflectance: Of the whole subject.
        bounce_scale: Factor on the albedo with which light bounces within the subject as strongly as the
            frames show; the albedo's own scale is a convention.
        info: Free-form facts: software, source, settings, warnings.
        decoder: What makes the maps of a view; None = the points are splatted.
        room_gloss: What a view adds to `room_radiance` for the gloss that moves with it; None = nothing.
    """

    points: torch.Tensor
    normals_world: torch.Tensor
    albedo: torch.Tensor
    room_radiance: torch.Tensor
    shading: torch.Tensor
    gloss: torch.Tensor
    flash_bounce: torch.Tensor
    confidence: torch.Tensor
    albedo_sigma: torch.Tensor
    normal_sigma_rad: torch.Tensor
    residual: torch.Tensor
    spacing: float
    c_room: tuple[float, float, float]
    c_flash: tuple[float, float, float]
    flash_offset_cam_m: tuple[float, float, float]
    reflectance: Reflectance
    bounce_scale: float
    info: Mapping[str, Any]
    decoder: Decoder | None = None
    room_gloss: RoomGloss | None = None

    def to(self, device: torch.device | str) -> Portrait:
        """The portrait with its tensors on a device."""
        decoder = None if self.decoder is None else self.decoder.to(device)
        return replace(self, decoder=decoder, **{name: getattr(self, name).to(device) for name in _TENSORS})

    def subset(self, keep: torch.Tensor) -> Portrait:
        """Some of the points: [P] bool, or their indices."""
        decoder = None if self.decoder is None else self.decoder.subset(keep)
        return replace(self, decoder=decoder, **{name: getattr(self, name)[keep] for name in _TENSORS})

    def transformed(self, similarity: Similarity) -> Portrait:
        """The portrait in another world; it looks the same to cameras that are taken along.

        Raises:
            PortraitError: It has a decoder that cannot be taken there.
        """
        turn = torch.as_tensor(similarity.rotation).to(self.points)
        scale = similarity.scale
        moved = scale * (self.points @ turn.T) + torch.as_tensor(similarity.translation).to(self.points)
        return replace(
            self,
            points=moved,
            normals_world=self.normals_world @ turn.T,
            spacing=scale * self.spacing,
            c_flash=_vector([scale**2 * value for value in self.c_flash]),  # it is divided by d^2
            flash_offset_cam_m=_vector([scale * value for value in self.flash_offset_cam_m]),
            decoder=None if self.decoder is None else self.decoder.transformed(similarity),
            room_gloss=None if self.room_gloss is None else self.room_gloss.turned(turn),
        )

    def save(self, folder: Path) -> None:
        """Writes the two files; each is there whole or not at all.

        Raises:
            PortraitError: A value is not finite; nothing is written, for it could not be read again.
        """
        folder.mkdir(parents=True, exist_ok=True)
        tensors = {name: getattr(self, name).detach().cpu().float().clone() for name in _TENSORS}
        content = {"schema": "relight-portrait", "version": VERSION, "points": len(self.points)}
        for field in fields(self):
            if field.name not in _TENSORS and field.name not in ("reflectance", "decoder", "room_gloss"):
                content[field.name] = getattr(self, field.name)
        content["reflectance"] = asdict(self.reflectance)
        content["room_gloss"] = None if self.room_gloss is None else self.room_gloss.coefficients.tolist()
        content["decoder"] = None
        if self.decoder is not None:
            content["decoder"] = {"kind": self.decoder.kind, "settings": self.decoder.settings()}
            for name, values in self.decoder.tensors().items():
                tensors[_DECODER + name] = values.detach().cpu().contiguous().clone()
        for name, values in tensors.items():
            if broken := int((~values.isfinite()).sum()):
                raise PortraitError(
                    f"The portrait is not written to {folder}, for {broken} of the {values.numel()} values "
                    f"of its {name} are not finite; a portrait that was there is untouched."
                )
        text = (
            json.dumps(content, indent=2, allow_nan=False) + "\n"
        )  # before a file is touched: this can fail
        atomic_write(folder / TENSORS_FILE, save(tensors))
        atomic_write(folder / FIELDS_FILE, text.encode())


def load_portrait(folder: Path, device: torch.device | str = "cpu") -> Portrait:
    """Reads a portrait.

    Raises:
        PortraitError: It is not there, not whole, of a newer version, or malformed.
    """
    folder = Path(folder)
    for file in (FIELDS_FILE, TENSORS_FILE):
        if not (folder / file).is_file():
            raise PortraitError(
                f"There is no portrait in {folder} ({file} is missing); run `relight fit` first."
            )
    try:
        content = parse_json((folder / FIELDS_FILE).read_bytes())
        if content["schema"] != "relight-portrait":
            raise ValueError("it is no portrait")
        version = content["version"]
    except (ValueError, KeyError, TypeError) as error:
        raise PortraitError(
            f"{folder / FIELDS_FILE} cannot be read ({error}); fit the portrait again."
        ) from error
    if version not in _READ:
        raise PortraitError(
            f"{folder / FIELDS_FILE} has version {version}, this program reads version {VERSION} and older; "
            "update the program or fit the portrait again."
        )
    try:
        tensors = load_file(folder / TENSORS_FILE, device=str(device))
        count = int(content["points"])
        if count < 1:
            raise ValueError("it has no points")
        if version < 3:
            tensors["flash_bounce"], content["bounce_scale"] = torch.zeros_like(tensors["gloss"]), 1.0
        for name, width in _TENSORS.items():
            shape, values = (count, width) if width else (count,), tensors[name]
            if tuple(values.shape) != shape or values.dtype != torch.float32 or not values.isfinite().all():
                raise ValueError(f"{name} is not a finite float32 array of shape {list(shape)}")
        return Portrait(
            **{name: tensors[name] for name in _TENSORS},
            spacing=_positive(content["spacing"]),
            c_room=_vector(content["c_room"]),
            c_flash=_vector(content["c_flash"]),
            flash_offset_cam_m=_vector(content["flash_offset_cam_m"]),
            reflectance=_reflectance(**content["reflectance"]),
            bounce_scale=_not_negative(content["bounce_scale"]),
            info=dict(content["info"]),
            decoder=_decoder(content["decoder"], tensors) if version > 1 else None,
            room_gloss=_room_gloss(content.get("room_gloss")),
        )
    except PortraitError as error:
        raise PortraitError(f"The portrait in {folder} cannot be read: {error}") from error
    except (SafetensorError, OSError, ValueError, KeyError, TypeError, OverflowError) as error:
        raise PortraitError(f"The portrait in {folder} is damaged ({error}); fit it again.") from error


def _decoder(content: Any, tensors: Mapping[str, torch.Tensor]) -> Decoder | None:
    if content is None:
        return None
    own = {
        name.removeprefix(_DECODER): values for name, values in tensors.items() if name.startswith(_DECODER)
    }
    for name, values in own.items():
        if values.is_floating_point() and not values.isfinite().all():
            raise ValueError(f"{_DECODER}{name} is not finite")
    return restored_decoder(content["kind"], dict(content["settings"]), own)


def _positive(value: Any) -> float:
    number = float(value)
    if not 0.0 < number < math.inf:
        raise ValueError(f"{number} is not a finite number above 0")
    return number


def _not_negative(value: Any) -> float:
    number = float(value)
    if not 0.0 <= number < math.inf:
        raise ValueError(f"{number} is not a finite number of at least 0")
    return number


def _reflectance(retro: Any, alpha: Any, f0: Any) -> Reflectance:
    retro, f0 = float(retro), float(f0)
    if not (0.0 <= retro < math.inf and 0.0 <= f0 < math.inf):
        raise ValueError(f"retro {retro} and f0 {f0} are not both finite and at least 0")
    return Reflectance(retro, _positive(alpha), f0)


def _room_gloss(rows: Any) -> RoomGloss | None:
    return None if rows is None else RoomGloss(torch.tensor([_vector(row) for row in rows]))


def _vector(values: Any) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    if not np.isfinite([x, y, z]).all():
        raise ValueError(f"{values} is not a finite vector")
    return x, y, z
