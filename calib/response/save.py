"""A response on the disk: the table in calibration.json, and all that it was made from beside it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.calibration import Calibration, save_calibration
from calib.response.check import OtherResponse
from calib.response.fit import ResponseResult
from capture.atomic import atomic_write
from capture.response import Response

_SCHEMA, _SCHEMA_VERSION = "relight-response-evidence", 1


def response_of(result: ResponseResult, source: str) -> Response:
    """The entry of calibration.json."""
    used = sum(frame.used for frame in result.frames)
    sigma = float(np.max(result.sigma))
    about = (
        f"{source}; {used} of {len(result.frames)} exposures used, linear to {result.linearity:.2%}, "
        f"standard deviation at most {sigma:.4f} of white"
    )
    return Response(None, result.stored, result.linear, about)


def response_evidence_path(calibration: Path) -> Path:
    """Where the evidence of a calibration.json lies."""
    return calibration.with_suffix(".response.json")


def save_response(
    result: ResponseResult, path: Path, source: str, others: Sequence[OtherResponse] = ()
) -> None:
    """Sets the response of a calibration.json, whose other entries stay, and writes the evidence beside it.

    Raises:
        CalibrationError: the file is there but malformed.
    """
    save_calibration(Calibration(response=response_of(result, source)), path)
    content = json.dumps(evidence_of(result, source, others), allow_nan=False)
    atomic_write(response_evidence_path(path), content.encode() + b"\n")


def evidence_of(result: ResponseResult, source: str, others: Sequence[OtherResponse]) -> dict[str, Any]:
    """What the response was made from and found, as plain values."""
    return {
        "schema": _SCHEMA,
        "version": _SCHEMA_VERSION,
        "source": source,
        "dark": result.dark.tolist(),
        "stored": _rounded(result.stored),
        "linear": _rounded(result.linear),
        "sigma": _rounded(result.sigma),
        "covered": list(result.covered),
        "frames": [
            {
                "name": frame.name,
                "claimed_s": frame.claimed_s,
                "off": frame.off if np.isfinite(frame.off) else None,
                "sigma": frame.sigma,
                "used": frame.used,
            }
            for frame in result.frames
        ],
        "residual": result.residual,
        "expected": result.expected,
        "jitter": result.jitter,
        "moved": result.moved,
        "levels": _rounded(result.levels),
        "deviations": _rounded(result.deviations),
        "others": [
            {"name": other.name, "median": other.median, "largest": other.largest}
            for other in others
            if np.isfinite(other.largest)
        ],
        "warnings": list(result.warnings),
    }


def _rounded(values: NDArray[np.float64]) -> list[Any]:
    rounded: list[Any] = np.round(values, 8).tolist()
    return rounded
