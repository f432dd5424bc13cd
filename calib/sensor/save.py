"""What noise and flat field were made from, beside calibration.json: `NAME.noise.json`, `NAME.flat.json`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.sensor.flat_field import FlatFieldResult
from calib.sensor.noise import NoiseResult
from capture.atomic import atomic_write

NOISE_SCHEMA, FLAT_SCHEMA = "relight-noise-evidence", "relight-flat-evidence"
_VERSION = 1


def noise_evidence_path(calibration: Path) -> Path:
    """Where the evidence of a calibration.json's noise lies."""
    return calibration.with_suffix(".noise.json")


def flat_evidence_path(calibration: Path) -> Path:
    """Where the evidence of a calibration.json's flat field lies."""
    return calibration.with_suffix(".flat.json")


def save_noise_evidence(noise: NoiseResult, path: Path) -> None:
    """Writes the photon transfer beside a calibration.json; parts of pictures that did not count are null."""
    content = {
        "schema": NOISE_SCHEMA,
        "version": _VERSION,
        "read": noise.read.tolist(),
        "shot": noise.shot.tolist(),
        "pairs": noise.pairs,
        "misfit": noise.misfit.tolist(),
        "correlation": None if np.isnan(noise.correlation) else noise.correlation,
        "means": _rounded(noise.means),
        "variances": _rounded(noise.variances),
        "warnings": list(noise.warnings),
    }
    _write(noise_evidence_path(path), content)


def save_flat_evidence(flat: FlatFieldResult, path: Path) -> None:
    """Writes the covariance of the terms and what each flat was like beside a calibration.json."""
    content = {
        "schema": FLAT_SCHEMA,
        "version": _VERSION,
        "terms": flat.terms.tolist(),
        "covariance": flat.covariance.tolist(),
        "flats": [
            {
                "name": check.name,
                "slope": check.slope,
                "bowl": check.bowl,
                "texture": check.texture,
                "corner": check.corner,
            }
            for check in flat.flats
        ],
        "warnings": list(flat.warnings),
    }
    _write(flat_evidence_path(path), content)


def _write(path: Path, content: dict[str, Any]) -> None:
    atomic_write(path, json.dumps(content, allow_nan=False).encode() + b"\n")


def _rounded(values: NDArray[np.float64]) -> list[list[float | None]]:
    """Rows of numbers to ten digits; what is no number is null."""
    return [[float(f"{v:.10g}") if np.isfinite(v) else None for v in row] for row in values.tolist()]
