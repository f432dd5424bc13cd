"""A flash's calibration on the disk: its entries of calibration.json, and all that they were made from.

calibration.json holds value, standard deviation and source. `NAME.flash.json` beside it holds the rest: the
covariance of all numbers, the light of every square with its place, and every pulse's gain.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.board.charuco import Board
from calib.calibration import Calibration, Quantity, save_calibration
from calib.flash.geometry import FlashGeometry, poses_of
from calib.flash.model import FALLOFF, LIGHT_NAMES
from capture.atomic import atomic_write
from capture.calibration_file import write_calibration_entries
from capture.controls import UNKNOWN, Controls

_SCHEMA, _SCHEMA_VERSION = "relight-flash-evidence", 1


def flash_of(found: FlashGeometry, board: Board, source: str, controls: Controls = UNKNOWN) -> Calibration:
    """The entries of calibration.json; the axis is missing where it could not be told.

    Args:
        found: the calibration.
        board: that was lit.
        source: what was filmed, for the provenance.
        controls: settings of the camera; the strength holds for these.
    """
    about = (
        f"{source}; {board.describe()}; {len(found.boards)} boards in {poses_of(found)} poses, boards left "
        f"out predicted to {100 * found.held_out.rms:.2f} %"
    )
    strength = (
        f"{about}; paper taken as albedo {found.paper_albedo:g}, in units of these pictures' white clip"
    )
    fit = found.fit
    axis = None
    if found.axis_known:
        axis = Quantity.of(fit.light.axis, "1", about, _deviations(found.axis_covariance))
    return Calibration(
        flash_offset_cam_m=Quantity.of(fit.light.position_m, "m", about, found.position_sigma_m),
        flash_axis=axis,
        flash_falloff=Quantity.of(
            fit.light.vector[FALLOFF], "1", about, np.sqrt(fit.covariance[FALLOFF, FALLOFF])
        ),
        flash_strength=Quantity.of(
            found.strength,
            "m^2",
            strength,
            _deviations(found.strength_covariance),
            controls.mattering("flash_strength"),
        ),
    )


def flash_evidence_path(calibration: Path) -> Path:
    """Where the evidence of a calibration.json's flash lies."""
    return calibration.with_suffix(".flash.json")


def save_flash(
    found: FlashGeometry, board: Board, path: Path, source: str, controls: Controls = UNKNOWN
) -> None:
    """Sets the flash's entries of a calibration.json, whose others stay, and writes the evidence beside it.

    An axis that was known before and is not told now is taken out: it does not go with the new falloff.

    Raises:
        CalibrationError: the file is there but malformed.
    """
    save_calibration(flash_of(found, board, source, controls), path)
    if not found.axis_known:
        write_calibration_entries(path, {"flash_axis": None})
    content = json.dumps(flash_evidence(found, board, source), allow_nan=False)
    atomic_write(flash_evidence_path(path), content.encode() + b"\n")


def flash_evidence(found: FlashGeometry, board: Board, source: str) -> dict[str, Any]:
    """Everything that a calibration was made from and found, as plain values."""
    droop, droop_sigma = found.droop
    pulses = [
        {
            "name": lit.name,
            "time_s": lit.time_s,
            "gain": round(float(gain), 6),
            "gain_sigma": round(float(sigma), 6),
            "held_out": round(float(mean), 6),
            "normal_cam": _rounded(lit.normal_cam, 6),
            "squares": lit.squares.tolist(),
            "points_cam_m": _rounded(lit.points_cam, 6),
            "radiance": _rounded(lit.radiance, 7),
            "noise": _rounded(lit.noise, 7),
        }
        for lit, gain, sigma, mean in zip(
            found.boards, found.gains, found.gain_sigma, found.held_out.boards, strict=True
        )
    ]
    return {
        "schema": _SCHEMA,
        "version": _SCHEMA_VERSION,
        "source": source,
        "board": board.to_json(),
        "pairs": found.pairs,
        "parameters": list(LIGHT_NAMES),
        "values": found.fit.light.vector.tolist(),
        "covariance": found.fit.covariance.tolist(),
        "sought": [LIGHT_NAMES[number] for number in found.fit.free],
        "strength": found.strength.tolist(),
        "strength_covariance": found.strength_covariance.tolist(),
        "paper_albedo": found.paper_albedo,
        "texture": found.fit.spread.texture,
        "pulse_spread": found.fit.spread.pulse,
        "droop": {"change": droop, "sigma": droop_sigma},
        "left_out": {"squares": found.left_out[0], "pulses": found.left_out[1]},
        "held_out": {
            "rms": found.held_out.rms,
            "expected": found.held_out.expected,
            "shape_rms": found.held_out.shape_rms,
        },
        "light_exponent": {"value": found.exponent[0], "sigma": found.exponent[1]},
        "notes": found.notes,
        "pulses": pulses,
    }


def _deviations(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    deviations: NDArray[np.float64] = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return deviations


def _rounded(values: NDArray[np.float64], digits: int) -> list[Any]:
    rounded: list[Any] = np.round(values, digits).tolist()
    return rounded
