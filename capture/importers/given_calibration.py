"""A calibration.json that the user gives with a source, copied into the session."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from capture.calibration_file import Quantity, read_calibration_entries, write_calibration_entries
from capture.json_fields import Fields
from capture.response import load_response
from capture.session import Session

_HEADER = ("schema", "version")


def read_given_calibration(path: Path) -> dict[str, Any]:
    """The entries of a calibration, looked at as far as they can be without knowing what they mean.

    Raises:
        CalibrationError: missing, malformed, newer than this program, or with impossible values.
    """
    entries = read_calibration_entries(path)
    load_response(path)
    for name, value in entries.values.items():
        if isinstance(value, Mapping):
            _check_quantity(Fields(value, f"{entries.place}: {name}", entries.error))
    return {name: value for name, value in entries.values.items() if name not in _HEADER}


def save_given_calibration(entries: Mapping[str, Any], session: Session) -> None:
    """Sets a session's entries to the given ones; what only the source says stays."""
    write_calibration_entries(session.calibration_path, entries)


def _check_quantity(entry: Fields) -> None:
    """Refuses an entry whose value, or that of an entry in it, is no array of finite numbers."""
    for name, inner in entry.values.items():
        if isinstance(inner, Mapping):
            _check_quantity(Fields(inner, f"{entry.place}.{name}", entry.error))
    if "value" not in entry:
        return
    try:
        value, sigma = np.array(entry.values["value"], float), entry.values.get("sigma")
        Quantity.of(value, entry.text("unit"), entry.text("source", ""), sigma)
    except (TypeError, ValueError) as cause:
        raise entry.fail(f"{cause}.") from cause
