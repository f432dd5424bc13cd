"""A lens calibration on the disk: the entry of calibration.json, and all that it was made from beside it.

calibration.json holds value, standard deviation and source. `NAME.intrinsics.json` holds the rest, so that a
calibration can be looked at again without its pictures: covariance of all parameters, corners, poses,
residuals, the models that were tried, the halves, and the projection uncertainty over the picture.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.calibration import Calibration, Intrinsics, Quantity, save_calibration
from calib.lens.intrinsics import IntrinsicsResult
from calib.lens.terms import LENS_MODELS, LENS_NAMES
from calib.lens.uncertainty import pixel_grid, projection_sigma
from capture.atomic import atomic_write
from capture.controls import UNKNOWN, Controls

_SCHEMA, _SCHEMA_VERSION = "relight-intrinsics-evidence", 1


def intrinsics_of(result: IntrinsicsResult, source: str, controls: Controls = UNKNOWN) -> Intrinsics:
    """The entry of calibration.json.

    Terms that the model does not have are zero; so is their standard deviation, unless they are in doubt.

    Args:
        result: the calibration.
        source: what was filmed, for the provenance.
        controls: settings of the camera; a lens holds for its focus.
    """
    about = (
        f"{source}; {result.board.describe()}; {len(result.views)} views, model {result.model}, corner noise "
        f"{result.uncertainty.noise_px:.3f} px"
    )
    sigma = result.sigma
    width, height = result.size
    terms = 0 if result.model == "none" else (5 if "k3" in LENS_MODELS[result.model] else 4)
    return Intrinsics(
        width,
        height,
        Quantity.of(result.lens[:4], "px", about, sigma[:4], controls.mattering("intrinsics")),
        Quantity.of(result.lens[4 : 4 + terms], "1", about, sigma[4 : 4 + terms]) if terms else None,
    )


def evidence_path(calibration: Path) -> Path:
    """Where the evidence of a calibration.json lies."""
    return calibration.with_suffix(".intrinsics.json")


def save_intrinsics(
    result: IntrinsicsResult, path: Path, source: str, distance_m: float, controls: Controls = UNKNOWN
) -> None:
    """Sets the intrinsics of a calibration.json, whose other entries stay, and writes the evidence beside it.

    Raises:
        CalibrationError: the file is there but malformed.
    """
    save_calibration(Calibration(intrinsics=intrinsics_of(result, source, controls)), path)
    content = json.dumps(evidence_of(result, source, distance_m), allow_nan=False)
    atomic_write(evidence_path(path), content.encode() + b"\n")


def evidence_of(result: IntrinsicsResult, source: str, distance_m: float) -> dict[str, Any]:
    """Everything that a calibration was made from and found, as plain values; null = not known."""
    grid, (columns, rows) = pixel_grid(result.size)
    sigma, _ = projection_sigma(result.lens, result.uncertainty, grid, distance_m)
    views = [
        {
            "name": name,
            "corners": np.nonzero(seen)[0].tolist(),
            "found_px": _rounded(pixels[seen], 4),
            "residuals_px": _rounded(residuals[seen], 4),
            "noise_px": round(float(noise), 4),
            "cam_from_board": np.column_stack([rotation, translation]).tolist(),
        }
        for name, seen, pixels, residuals, noise, rotation, translation in zip(
            result.views,
            result.observations.seen,
            result.observations.pixels,
            result.solution.residuals,
            result.uncertainty.view_noise_px,
            result.solution.rotations,
            result.solution.translations_m,
            strict=True,
        )
    ]
    return {
        "schema": _SCHEMA,
        "version": _SCHEMA_VERSION,
        "source": source,
        "board": result.board.to_json(),
        "width": result.size[0],
        "height": result.size[1],
        "model": result.model,
        "parameters": [*LENS_NAMES, "bend_width_m", "bend_height_m"],
        "values": result.solution.shared.tolist(),
        "covariance": result.uncertainty.covariance.tolist(),
        "corner_noise_px": result.uncertainty.noise_px,
        "correlation_factor": result.uncertainty.correlation_factor,
        "rms_px": result.rms_px,
        "left_out": {"corners": result.left_out[0], "views": result.left_out[1]},
        "covered_share": result.covered_share,
        "models": [
            {"model": trial.model, "bent_board": trial.bent, "held_out_px": trial.held_out_px}
            for trial in result.trials
        ],
        "halves": [
            {
                "split": check.split,
                "rms_px": check.rms_px,
                "expected_px": check.expected_px,
                "chance": check.chance,
            }
            for check in result.halves
        ],
        "projection": {
            "distance_m": distance_m,
            "columns": columns,
            "rows": rows,
            "sigma_px": [round(float(value), 5) if np.isfinite(value) else None for value in sigma],
        },
        "warnings": result.warnings,
        "views": views,
    }


def _rounded(values: NDArray[np.float64], digits: int) -> list[Any]:
    rounded: list[Any] = np.round(values, digits).tolist()
    return rounded
