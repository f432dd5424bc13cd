"""Colours on the disk: the entries of calibration.json, and all that they were made from beside them.

Flash and room each have a matrix of their own, in which white in that light is grey. The one that is applied
is the flash's, because the albedo is found from what the flash adds; what white in the room's light is by it,
is the colour of the room. Where only the room is known, its matrix is applied, and the flash is taken for it.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.calibration import Calibration, Quantity, save_calibration
from calib.colour.fit import ColourFit
from capture.atomic import atomic_write
from capture.calibration_file import write_calibration_entries
from capture.controls import UNKNOWN, Controls

_SCHEMA, _SCHEMA_VERSION = "relight-colour-evidence", 1


def colour_of(
    flash: ColourFit | None, room: ColourFit | None, source: str, controls: Controls = UNKNOWN
) -> Calibration:
    """The entries of calibration.json.

    Args:
        flash: of the flash's light, if known.
        room: of the room's light, if known; one of the two is.
        source: what was photographed, for the provenance.
        controls: settings of the camera; colours hold for its white balance.
    """
    applied = flash or room
    if applied is None:
        raise ValueError("neither light is known")
    light = "flash" if flash is not None else "room"
    made_with = controls.mattering("colour")
    about = (
        f"{source}; ColorChecker {applied.reference.edition} under the {light}, CIEDE2000 "
        f"{applied.errors.describe()}"
    )
    white = None
    if flash is not None and room is not None:
        white = Quantity.of(room_white(flash, room), "1", about, None, made_with)
    return Calibration(
        colour=Quantity.of(applied.matrix, "1", about, applied.sigma, made_with), room_white=white
    )


def room_white(flash: ColourFit, room: ColourFit) -> NDArray[np.float64]:
    """[3] white under the room's light in the sRGB in which white under the flash is grey; its mean is 1."""
    white = flash.matrix @ room.white
    mean: NDArray[np.float64] = np.maximum(white, 0.0) / np.maximum(white, 0.0).mean()
    return mean


def colour_evidence_path(calibration: Path) -> Path:
    """Where the evidence of a calibration.json's colours lies."""
    return calibration.with_suffix(".colour.json")


def save_colour(
    flash: ColourFit | None, room: ColourFit | None, path: Path, source: str, controls: Controls = UNKNOWN
) -> None:
    """Sets the colours of a calibration.json, whose other entries stay, and writes the evidence beside it.

    A colour of the room that was known before and is not told now is taken out: it goes with the old matrix.

    Raises:
        CalibrationError: the file is there but malformed.
    """
    entries = colour_of(flash, room, source, controls)
    save_calibration(entries, path)
    if entries.room_white is None:
        write_calibration_entries(path, {"room_white": None})
    content = {
        "schema": _SCHEMA,
        "version": _SCHEMA_VERSION,
        "source": source,
        "flash": None if flash is None else _evidence(flash),
        "room": None if room is None else _evidence(room),
    }
    atomic_write(colour_evidence_path(path), json.dumps(content, allow_nan=False).encode() + b"\n")


def _evidence(fit: ColourFit) -> dict[str, Any]:
    return {
        "edition": fit.reference.edition,
        "names": list(fit.reference.names),
        "pictures": list(fit.names),
        "matrix": fit.matrix.tolist(),
        "sigma": fit.sigma.tolist(),
        "white": fit.white.tolist(),
        "patches": np.round(fit.patches, 6).tolist(),
        "reference": np.round(fit.reference.srgb, 6).tolist(),
        "corrected": np.round(fit.corrected, 6).tolist(),
        "slopes": np.round(fit.slopes, 4).tolist(),
        "delta_e": {
            "uncorrected": np.round(fit.uncorrected, 3).tolist(),
            "matrix": np.round(fit.errors.fitted, 3).tolist(),
            "matrix_left_out": np.round(fit.errors.left_out, 3).tolist(),
            "root_polynomial": np.round(fit.polynomial_errors.fitted, 3).tolist(),
            "root_polynomial_left_out": np.round(fit.polynomial_errors.left_out, 3).tolist(),
        },
        "warnings": list(fit.warnings),
    }
