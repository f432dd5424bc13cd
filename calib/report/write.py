"""The page: verdicts first, then what to know, then each part with its evidence, then what is assumed."""

from __future__ import annotations

from collections.abc import Callable
from html import escape
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calib.calibration import Calibration, load_calibration
from calib.colour.save import colour_evidence_path
from calib.errors import ReportError
from calib.flash.save import flash_evidence_path
from calib.lens.save import evidence_path
from calib.report import colour_part, flash_part, lens_part, response_part, sensor_part
from calib.report.page import page, section, table, warnings
from calib.report.part import UNKNOWN, Part, read_evidence
from calib.response.save import response_evidence_path
from calib.sensor.save import FLAT_SCHEMA, NOISE_SCHEMA, flat_evidence_path, noise_evidence_path
from capture.atomic import atomic_write
from capture.controls import MATTERING
from capture.json_fields import Fields

Floats = NDArray[np.float64]


def write_calibration_report(calibration: Path, out: Path) -> list[Part]:
    """Writes the page of a calibration.json, with the evidence that lies beside it.

    Args:
        calibration: the calibration.json.
        out: the .html file.

    Returns:
        What it says of each part.

    Raises:
        ReportError: there is no calibration.
        CalibrationError: it, or its evidence, is malformed.
    """
    if not calibration.is_file():
        raise ReportError(f"{calibration} does not exist; make one with `relight calibrate`.")
    known = load_calibration(calibration)
    parts = _parts(known, calibration)
    title = f"Calibration {calibration.resolve().parent.name}/{calibration.name}"
    said = [f"{part.name}: {sentence}" for part in parts for sentence in part.warnings]
    sections = [
        f"<h1>{escape(title)}</h1>",
        section(
            "At a glance",
            table(("part", "verdict", "why"), [(part.name, part.verdict, part.why) for part in parts]),
            "A verdict is a rule of thumb with its limit beside it; what it rests on is below.",
        ),
        warnings(said),
        *(section(part.name, part.body) for part in parts if part.verdict != UNKNOWN),
        section("What it holds for", _settings(known)),
        section("What is assumed", _list(known.assumptions()), "Because nothing is known of it."),
    ]
    out.parent.mkdir(parents=True, exist_ok=True)
    atomic_write(out, page(title, sections).encode())
    return parts


def _parts(known: Calibration, path: Path) -> list[Part]:
    lens, response, colour = known.intrinsics, known.response, known.colour
    flash = known.flash_offset_cam_m
    return [
        lens_part.lens_part(
            lens,
            _evidence(
                evidence_path(path),
                lens_part.SCHEMA,
                None if lens is None else lens.pinhole.value,
                lambda found: found.array("values", (None,))[:4],
            ),
        ),
        response_part.response_part(
            response,
            _evidence(
                response_evidence_path(path),
                response_part.SCHEMA,
                None if response is None else response.stored,
                lambda found: found.array("stored", (None,)),
            ),
        ),
        sensor_part.dark_part(known),
        sensor_part.noise_part(
            known,
            _evidence(
                noise_evidence_path(path),
                NOISE_SCHEMA,
                None if known.noise_shot is None else known.noise_shot.value,
                lambda found: found.array("shot", (3,)),
            ),
        ),
        sensor_part.flat_part(
            known,
            _evidence(
                flat_evidence_path(path),
                FLAT_SCHEMA,
                None if known.flat_field is None else known.flat_field.value,
                lambda found: found.array("terms", (None,)),
            ),
        ),
        colour_part.colour_part(
            known,
            _evidence(
                colour_evidence_path(path),
                colour_part.SCHEMA,
                None if colour is None else colour.value,
                lambda found: found.child("flash" if "flash" in found else "room").array("matrix", (3, 3)),
            ),
        ),
        flash_part.flash_part(
            known,
            _evidence(
                flash_evidence_path(path),
                flash_part.SCHEMA,
                None if flash is None else flash.value,
                lambda found: found.array("values", (None,))[:3],
            ),
        ),
    ]


def _evidence(
    path: Path, schema: str, value: Floats | None, found: Callable[[Fields], Floats]
) -> Fields | None:
    """The evidence beside a calibration, if it is that of the value which the calibration holds now."""
    evidence = read_evidence(path, schema)
    if evidence is None or value is None:
        return None
    other = found(evidence)
    same = other.shape == value.shape and np.allclose(other, value, rtol=1e-5, atol=1e-7)
    return evidence if same else None


def _settings(known: Calibration) -> str:
    """Which settings of the camera each entry was made with."""
    rows = []
    for name in MATTERING:
        entry = (
            known.intrinsics.pinhole if name == "intrinsics" and known.intrinsics else getattr(known, name)
        )
        if entry is None:
            continue
        made_with = entry.made_with
        settings = {} if made_with is None else made_with.to_json()
        told = ", ".join(f"{key} {value}" for key, value in settings.items())
        rows.append((name, told or "not told: it is applied to every session"))
    return table(("entry", "is applied where these are the same"), rows)


def _list(sentences: list[str]) -> str:
    return f"<ul>{''.join(f'<li>{escape(sentence)}</li>' for sentence in sentences)}</ul>"
