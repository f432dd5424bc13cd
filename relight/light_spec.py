"""Lights as text that a person can type, and as `lights.json`.

A spec is `kind`, `kind:value` or `kind:value;key=value;...`, and several of them joined by `+`:

    captured   room   flash   room+flash
    directional:0,0,1;ambient=0.5;color=1,1,1;shadows=on;angle=5
    point:0.5,0.3,0.8;color=1,.8,.6;radius=0.05
    environment:studio.hdr;rotate=90;gain=0.5;method=sh        (or env:)
    sh:coefficients.json;rotate=90;gain=2

A light with a size, `radius` in metres or `angle` in degrees across, has soft shadows; asking for an angle
asks for the shadows.

Any may end in `;name=NAME`, the light's name in file names; without it the spec itself is made into a name.

`lights.json` says the same: {"lights": [{"name": "lamp", "kind": "point", "position": [0.5, 0.3, 0.8]},
...]}, with the first value under its own key (`to_light`, `position`, `map`, `coefficients`) and {"kind":
"sum", "parts": [...]} for `+`. A point light's strength is its `C` or `color` (radiance times metre^2 of a
white surface) or its `intensity` (pi times that). Paths are relative to the file, those of a typed spec to a
folder that the caller names.

Coefficients of spherical harmonics are [B^2][3] numbers, RGB, of incident radiance, row l^2 + l + m,
normalised as in `spherical_harmonics`; they stand in the entry itself or in a file {"coefficients": [...]}.
"""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from capture.json_fields import Fields, read_json
from relight.errors import LightError
from relight.lighting import (
    CapturedLight,
    DirectionalLight,
    EnvironmentLight,
    FlashLight,
    Light,
    PointLight,
    RoomLight,
    SphericalHarmonicsLight,
    SumLight,
    Vector,
)
from relight.spherical_harmonics import rotate_sh, rotation_about_up

_LOG = logging.getLogger(__name__)

# The other files of a rendered view, NAME.albedo.exr beside NAME.<light>.exr: no light may be called so.
_TAKEN_NAMES = (
    *("albedo", "normal", "shading", "mask", "depth"),
    *("albedo_sigma", "normal_sigma", "unobserved_flash", "unobserved_view"),
)
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.+-]{0,79}")
# "+" joins two lights only before what could start one, so that 1e+3 and a+b.hdr stay whole.
_JOINT = re.compile(r"\+(?=\s*[A-Za-z_]+\s*(?:[:;+]|$))")


def parse_light(spec: str, base: Path = Path()) -> tuple[str, Light]:
    """Name and light of a typed spec.

    Args:
        spec: as in the module's head.
        base: folder that its paths are relative to.

    Raises:
        LightError: the spec, or a file that it names, cannot be used; the message lists what is known.
    """
    place = f'Light "{spec}"'
    name = name_of_spec(spec)
    lights = []
    for part in _JOINT.split(spec):
        entry = _entry_of_text(part, place)
        name = entry.pop("name", name)
        fields = Fields(entry, place, LightError)
        if unknown := _unknown_keys(fields):
            raise fields.fail(unknown)
        lights.append(_build(fields, base))
    return _checked_name(name, place), lights[0] if len(lights) == 1 else SumLight(tuple(lights))


def load_lights(path: Path) -> dict[str, Light]:
    """The lights of a `lights.json` by name, in the file's order; unknown keys are ignored with a warning.

    Raises:
        LightError: the file, one of its lights or a file that they name cannot be used.
    """
    lights: dict[str, Light] = {}
    for fields in read_json(path, LightError).children("lights", "light"):
        name = _checked_name(fields.text("name"), fields.place)
        if name in lights:
            raise LightError(f'{path}: two lights are called "{name}"; give each its own name.')
        named = Fields(fields.values, f'{path}: light "{name}"', LightError)
        parts = list(named.children("parts", "part")) if named.text("kind") == "sum" else [named]
        if not parts:
            raise named.fail('"parts" is empty; a sum needs at least one light.')
        for part in parts:
            if unknown := _unknown_keys(part):
                _LOG.warning("%s: %s", part.place, unknown)
        built = tuple(_build(part, path.parent) for part in parts)
        lights[name] = built[0] if len(built) == 1 else SumLight(built)
    if not lights:
        raise LightError(f'{path} has no lights; list at least one under "lights".')
    return lights


def parse_lights(specs: Iterable[str], base: Path = Path()) -> dict[str, Light]:
    """Lights of several specs by name; a spec that is just a .json file stands for all lights in it.

    Raises:
        LightError: as `parse_light` and `load_lights`, or two lights have the same name.
    """
    lights: dict[str, Light] = {}
    for spec in specs:
        is_file = re.fullmatch(r"(?!sh:)[^;=]+\.json", spec, re.IGNORECASE)
        found = load_lights(base / spec) if is_file else dict([parse_light(spec, base)])
        for name, light in found.items():
            if name in lights:
                raise LightError(f'Two lights are called "{name}"; name one of them with ";name=...".')
            lights[name] = light
    return lights


def name_of_spec(spec: str) -> str:
    """A spec as a name for files: letters, digits, "+", "-" and "_", folders left out, at most 80 long."""
    without_folders = re.sub(r"[^:;+]*[/\\]", "", spec)
    return re.sub(r"[^A-Za-z0-9+-]+", "_", without_folders).strip("_")[:80]


def _checked_name(name: str, place: str) -> str:
    if not _NAME.fullmatch(name):
        raise LightError(
            f'{place}: "{name}" is no name for files; use at most 80 letters, digits, "_", "-", "+" and ".".'
        )
    if name in _TAKEN_NAMES:
        raise LightError(f'{place}: "{name}" is the name of a map; choose another name for the light.')
    return name


def _entry_of_text(text: str, place: str) -> dict[str, Any]:
    """One part of a spec as the entry that `lights.json` would have."""
    head, *options = (piece.strip() for piece in text.split(";"))
    name, colon, value = (piece.strip() for piece in head.partition(":"))
    entry: dict[str, Any] = {"kind": name}
    kind = _kind(name, place)
    if colon and kind.first is None:
        raise LightError(f'{place}: "{name}" takes no value, but "{value}" is given.')
    if kind.first is not None:
        if not value:
            raise LightError(f'{place}: "{name}" needs a value, as in {kind.example}.')
        entry[kind.first] = _literal(value)
    for option in options:
        key, equals, value = (piece.strip() for piece in option.partition("="))
        if not (key and equals and value):
            raise LightError(f'{place}: "{option}" is no option; write key=value.')
        if key in entry:
            raise LightError(f'{place}: "{key}" is given twice.')
        entry[key] = value if key == "name" else _literal(value)
    return entry


def _literal(text: str) -> float | list[float] | bool | str:
    """A number, numbers between commas, on or off; anything else is text."""
    try:
        numbers = [float(piece) for piece in text.split(",")]
    except ValueError:
        return {"on": True, "off": False}.get(text.lower(), text)
    return numbers if len(numbers) > 1 else numbers[0]


@dataclass(frozen=True)
class _Kind:
    """One kind of light: how it is built, the key of the value after its colon, and its other keys."""

    build: Callable[[Fields, Path], Light]
    first: str | None = None
    options: tuple[str, ...] = ()
    example: str = ""


def _kind(name: str, place: str) -> _Kind:
    kind = _KINDS.get(_ALIASES.get(name, name))
    if kind is None:
        raise LightError(f'{place}: there is no light "{name}"; known are {", ".join(_KINDS)}.')
    return kind


def _unknown_keys(fields: Fields) -> str | None:
    """A complaint about keys that the entry's kind does not have, or None."""
    name = fields.text("kind")
    kind = _kind(name, fields.place)
    known = [*([kind.first] if kind.first else []), *kind.options]
    unknown = [key for key in fields.values if key not in ("kind", "name", *known)]
    if not unknown:
        return None
    return f'"{name}" has no "{unknown[0]}"; it has {", ".join(known) or "no options"}.'


def _build(fields: Fields, base: Path) -> Light:
    kind = _kind(fields.text("kind"), fields.place)
    try:
        return kind.build(fields, base)
    except ValueError as error:
        raise fields.fail(f"{error}.") from error


def _directional(fields: Fields, base: Path) -> Light:
    angle_deg = fields.number("angle", 0.0)
    return DirectionalLight(
        to_light=_vector(fields, "to_light"),
        ambient=fields.number("ambient", 0.0),
        color=_vector(fields, "color", (1.0, 1.0, 1.0)),
        shadows=_switch(fields, "shadows", angle_deg > 0),
        angle_deg=angle_deg,
    )


def _point(fields: Fields, base: Path) -> Light:
    given = [key for key in ("C", "color", "intensity") if key in fields]
    if len(given) > 1:
        raise fields.fail(f'"{given[0]}" and "{given[1]}" say the same thing; give one of them.')
    strength = _vector(fields, given[0]) if given else (1.0, 1.0, 1.0)
    if given == ["intensity"]:
        strength = (strength[0] / math.pi, strength[1] / math.pi, strength[2] / math.pi)
    return PointLight(
        _vector(fields, "position"),
        strength,
        _switch(fields, "shadows", True),
        fields.number("radius", 0.0),
    )


def _environment(fields: Fields, base: Path) -> Light:
    return EnvironmentLight.from_file(
        base / fields.text("map"),
        rotate_deg=fields.number("rotate", 0.0),
        gain=fields.number("gain", 1.0),
        method=fields.text("method", "exact"),
        shadows=_switch(fields, "shadows", True),
    )


def _spherical_harmonics(fields: Fields, base: Path) -> Light:
    source = fields
    if isinstance(fields.values.get("coefficients"), str):
        source = read_json(base / fields.text("coefficients"), LightError)
    light = SphericalHarmonicsLight(torch.from_numpy(source.array("coefficients", (None, 3))))
    rotation = rotation_about_up(fields.number("rotate", 0.0))
    return SphericalHarmonicsLight(rotate_sh(light.coefficients, rotation) * fields.number("gain", 1.0))


def _vector(fields: Fields, key: str, default: Vector | None = None) -> Vector:
    if default is not None and key not in fields:
        return default
    x, y, z = fields.array(key, (3,)).tolist()
    return x, y, z


def _switch(fields: Fields, key: str, default: bool) -> bool:
    return bool(fields.integer(key, default, low=0, high=1))


_KINDS = {
    "captured": _Kind(lambda fields, base: CapturedLight()),
    "room": _Kind(lambda fields, base: RoomLight()),
    "flash": _Kind(lambda fields, base: FlashLight()),
    "directional": _Kind(
        _directional, "to_light", ("ambient", "color", "shadows", "angle"), "directional:0,0,1;ambient=0.5"
    ),
    "point": _Kind(
        _point,
        "position",
        ("C", "color", "intensity", "shadows", "radius"),
        "point:0.5,0.3,0.8;color=1,.8,.6",
    ),
    "environment": _Kind(
        _environment, "map", ("rotate", "gain", "method", "shadows"), "environment:studio.hdr;rotate=90"
    ),
    "sh": _Kind(_spherical_harmonics, "coefficients", ("rotate", "gain"), "sh:coefficients.json"),
}
_ALIASES = {"env": "environment", "spherical_harmonics": "sh"}
