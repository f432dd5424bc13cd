"""calibration.json: its schema, and the form that every measured value in it has.

    {"schema": "relight-calibration", "version": 1,
     "flash_offset_cam_m": {"value": [0.013, -0.007, 0.0], "unit": "m", "sigma": null, "source": "..."}, ...}

What the entries mean is said in `calib.calibration`; capture needs only to write one, and to read those that
make radiance of pixels (`capture.radiometry`). An entry may say under "made_with" which settings of the
camera it holds for (`capture.controls`).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capture.atomic import atomic_write
from capture.controls import MATTERING, Controls
from capture.errors import CalibrationError
from capture.json_fields import Fields, read_json

SCHEMA = "relight-calibration"
SCHEMA_VERSION = 1


@dataclass(frozen=True, eq=False)
class Quantity:
    """A value with its unit, uncertainty and provenance.

    Attributes:
        value: float64 of any shape, finite.
        unit: e.g. "m", "px", "1" (dimensionless).
        sigma: standard deviation, of the shape of `value` or one number for all of it; None = not known.
        source: where it comes from: the procedure and its input, or the file that stated it.
        made_with: settings of the camera that it holds for; None = not known, or none matter.
    """

    value: NDArray[np.float64]
    unit: str
    sigma: NDArray[np.float64] | None
    source: str
    made_with: Controls | None = None

    @classmethod
    def of(
        cls,
        value: ArrayLike,
        unit: str,
        source: str,
        sigma: ArrayLike | None = None,
        made_with: Controls | None = None,
    ) -> Quantity:
        """A quantity of anything that numpy takes as an array.

        Raises:
            ValueError: not finite, or a sigma that is negative or of another shape.
        """
        values = np.array(value, dtype=np.float64)
        sigmas = None if sigma is None else np.array(sigma, dtype=np.float64)
        if not np.isfinite(values).all():
            raise ValueError("a value is not finite")
        if sigmas is not None:
            if sigmas.shape not in ((), values.shape):
                raise ValueError(f"sigma has the shape {list(sigmas.shape)}, the value {list(values.shape)}")
            if not (np.isfinite(sigmas) & (sigmas >= 0)).all():
                raise ValueError("sigma must be finite and not negative")
        return cls(values, unit, sigmas, source, made_with)

    def to_json(self) -> dict[str, Any]:
        """The entry of calibration.json."""
        sigma = None if self.sigma is None else self.sigma.tolist()
        entry = {"value": self.value.tolist(), "unit": self.unit, "sigma": sigma, "source": self.source}
        if self.made_with is not None and (settings := self.made_with.to_json()):
            entry["made_with"] = settings
        return entry


def quantity_from_json(entry: Fields, unit: str, shape: tuple[int | None, ...]) -> Quantity:
    """The quantity of an entry.

    Args:
        entry: as `Quantity.to_json` gives it.
        unit: the one it must have.
        shape: the one it must have; None = any length.

    Raises:
        CalibrationError: another unit or shape, or values that are not finite.
    """
    stated = entry.text("unit")
    if stated != unit:
        raise entry.fail(f"the unit is {stated!r}; it must be {unit!r}.")
    value = entry.array("value", shape)
    raw = entry.values.get("sigma")
    sigma_shape = value.shape if isinstance(raw, list) else ()
    sigma = entry.array("sigma", sigma_shape, None)
    try:
        return Quantity.of(value, unit, entry.text("source", ""), sigma, made_with_of(entry))
    except ValueError as cause:
        raise entry.fail(f"{cause}.") from cause


def made_with_of(entry: Fields) -> Controls | None:
    """The settings that an entry holds for; None where it does not say."""
    said = entry.child("made_with", None)
    return None if said is None else Controls.from_json(said)


def applicable_entries(entries: Fields, live: Controls) -> tuple[Fields, str | None]:
    """The entries that hold for frames taken with the live settings, and a sentence on the others."""
    kept, notes = dict(entries.values), []
    for name, mattering in MATTERING.items():
        entry = entries.child(name, None)
        if entry is None:
            continue
        made_with = made_with_of(entry.child("pinhole") if name == "intrinsics" else entry)
        differences = [] if made_with is None else made_with.differences(live, mattering)
        if differences:
            del kept[name]
            notes.append(f"{name} ({', '.join(differences)})")
    warning = (
        f"Made with other settings and therefore not applied: {'; '.join(notes)}. Lock the camera as it was "
        "calibrated, or calibrate it as it is locked."
    )
    return Fields(kept, entries.place, entries.error), warning if notes else None


def read_calibration_entries(path: Path) -> Fields:
    """The entries of a calibration.json whose schema is ours.

    Raises:
        CalibrationError: missing, malformed, or of an unknown or newer schema.
    """
    entries = read_json(path, CalibrationError)
    schema = entries.text("schema", "")
    if schema != SCHEMA:
        raise entries.fail(f"the schema is {schema!r}, not {SCHEMA!r}.")
    version = entries.integer("version", low=1)
    if version > SCHEMA_VERSION:
        raise entries.fail(
            f"it was written by a newer program (schema version {version}; this one knows {SCHEMA_VERSION}); "
            "update the program."
        )
    return entries


def write_calibration_entries(path: Path, entries: Mapping[str, Any]) -> None:
    """Sets entries in a calibration.json and leaves the others as they are; the file is made when missing."""
    kept = dict(read_calibration_entries(path).values) if path.is_file() else {}
    content = {"schema": SCHEMA, "version": SCHEMA_VERSION, **kept, **entries}
    content = {key: value for key, value in content.items() if value is not None}
    atomic_write(path, json.dumps(content, indent=2, allow_nan=False).encode() + b"\n")
