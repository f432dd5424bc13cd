"""The readout of a calibration.json, given to the tagger where it holds for the frames."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from capture.calibration_file import applicable_entries, quantity_from_json, read_calibration_entries
from capture.controls import Controls
from capture.tagging.config import TaggingConfig

# Rows are read once a frame, by stamps that jitter; without a known rate no film is slower than this.
_LONGEST_SHARE, _LONGEST_S = 1.05, 0.1


def with_given_readout(config: TaggingConfig, calibration: Path | None, live: Controls) -> TaggingConfig:
    """The settings with the calibrated readout and its doubt; where none holds they are as they were.

    Args:
        config: of the tagger.
        calibration: calibration.json of the camera; None = none is given.
        live: what the camera is set to: another size or rate reads the rows in another time.

    Raises:
        CalibrationError: missing or malformed, or no readout of such frames.
    """
    if calibration is None:
        return config
    entries, _ = applicable_entries(read_calibration_entries(calibration), live)
    if "readout_s" not in entries:
        return config
    entry = entries.child("readout_s")
    readout = quantity_from_json(entry, "s", ())
    readout_s, sigma_s = float(readout.value), 0.0 if readout.sigma is None else float(readout.sigma)
    longest_s = _LONGEST_S if live.rate_hz is None else _LONGEST_SHARE / live.rate_hz
    if abs(readout_s) > longest_s or sigma_s > longest_s:
        raise entry.fail(
            f"{1e3 * readout_s:g} ± {1e3 * sigma_s:g} ms is more than the {1e3 * longest_s:.1f} ms that a "
            "frame takes; measure it with `relight calibrate readout`."
        )
    return replace(config, readout_s=readout_s, readout_sigma_s=sigma_s)
